"""Frames, videos and taxel maps: the hand, the object and what 600 taxels feel, drawn without OpenGL."""

import dataclasses
import io
import tempfile
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from dexsim.core.files import write_atomic
from dexsim.hand.description import Hand
from dexsim.hand.load import load_hand
from dexsim.hand.mjcf import Pose, hand_poses
from dexsim.render.panel import draw_panel, taxel_image
from dexsim.render.picture import Camera, draw_scene
from dexsim.render.snapshot import Snapshot

CAMERAS = {
    "grasp": Camera(azimuth=100.0, elevation=8.0, distance=0.43, target=(0.048, 0.010, 0.092), up=(-1.0, 0.0, 0.0)),
    "rotate": Camera(azimuth=95.0, elevation=30.0, distance=0.50, target=(0.045, 0.010, 0.085), up=(1.0, 0.0, 0.0)),
}
"""The hand held palm down, and palm up from the side on which fingers and thumb are both in sight."""

_GRASP_CENTRE = (0.055, -0.005, 0.090)  # m, of the hand that the presets are aimed at


def render_frame(
    hand: Hand,
    kinds: tuple[str, ...],
    snapshot: Snapshot,
    *,
    camera: Camera | str = "grasp",
    size: tuple[int, int] = (640, 480),
    force_range: float | None = None,
) -> np.ndarray:
    """One picture, uint8 [H, W, 3]: the scene at the left, the taxel maps in a panel of half the height's width.

    Args:
      kinds: the kinds of the object's K primitives.
      camera: a `Camera`, or the name of a task (`camera_of`).
      size: (width, height) in pixels, even, wider than half the height.
      force_range: force of the hottest taxel colour [N]; the snapshot's largest taxel force when left out.

    Raises:
      ValueError: a size without room for the scene.
    """
    frame = _finite(snapshot)
    finger_range = float(np.nanmax(np.append(frame.finger_force, frame.target_force)))
    draw = _painter(hand, tuple(kinds), frame, camera, size, force_range, finger_range)
    return draw(frame, hand_poses(hand, frame.joint_position[None])[0])


def render_episode(
    env: Any,
    snapshots: Snapshot,
    path: str | Path,
    fps: float,
    *,
    size: tuple[int, int] = (640, 480),
    rate: float | None = None,
) -> Path:
    """Write snapshots stacked along T, `fps` of them a second, as a video as long as they last; return its path.

    MP4 where imageio-ffmpeg (extra `video`) can be imported, else GIF with the suffix changed; a path that ends in .gif
    is always a GIF. `rate` is the video's own number of frames a second, each the nearest snapshot; None shows every
    snapshot.

    Raises:
      ValueError: no snapshots, or see `render_frame`.
      OSError: the file cannot be written.
    """
    snapshots = _finite(snapshots)
    total = len(snapshots.joint_position)
    if total == 0:
        raise ValueError("render_episode: no snapshots to draw")
    rate = rate or fps
    nearest = np.minimum(np.round(np.arange(max(round(total * rate / fps), 1)) * fps / rate).astype(int), total - 1)
    snapshots = snapshots.map(lambda x: x[nearest])
    hand = getattr(env, "hand", None) or load_hand()
    # One scale for the whole video, so that colours compare across frames; single spikes may saturate.
    loaded = snapshots.taxel_force[snapshots.taxel_force > 0]
    force_range = float(np.quantile(loaded, 0.995)) if loaded.size else None
    targets = snapshots.target_force[np.isfinite(snapshots.target_force)]
    finger_range = max(float(np.quantile(snapshots.finger_force, 0.995)), float(targets.max(initial=0)))
    draw = _painter(hand, tuple(env.primitive_kinds), snapshots, env.name, size, force_range, finger_range)
    poses = hand_poses(hand, snapshots.joint_position)

    def frame(t: int) -> np.ndarray:
        return draw(snapshots.map(lambda x: x[t]), poses[t])

    return _write_video(frame, len(poses), Path(path), rate, size)


def draw_taxels(hand: Hand, taxel_force: np.ndarray) -> Any:
    """A matplotlib figure of the unrolled taxel maps of forces [F, N] N: one per finger, tip at the top, one colour
    scale."""
    import matplotlib.pyplot as plt

    force = np.asarray(taxel_force)
    figure, axes = plt.subplots(1, len(hand.finger_names), figsize=(9, 2.9), layout="constrained", squeeze=False)
    plt.close(figure)  # a notebook shows what the cell returns; left open it would be shown twice
    top = float(force.max()) or 1.0
    columns, rows = hand.taxel_grid
    for axis, name, values in zip(axes[0], hand.finger_names, force, strict=True):
        extent = (-0.5, columns - 0.5, -0.5, rows - 0.5)
        image = axis.imshow(
            taxel_image(values, hand.taxel_grid), cmap="inferno", vmin=0, vmax=top, extent=extent, aspect="equal"
        )
        axis.set(title=f"{name}  {values.sum():.2f} N", xlabel="column")
    axes[0, 0].set_ylabel("row (tip at the top)")
    figure.colorbar(image, ax=list(axes[0]), label="force per taxel [N]", shrink=0.85)
    return figure


def _painter(hand, kinds, snapshot, camera, size, force_range, finger_range) -> Callable[[Snapshot, Pose], np.ndarray]:
    """A function that draws frames of one size from one camera, with what stays the same computed once."""
    width, height = size
    panel_width = height // 2
    if width % 2 or height % 2 or width - panel_width < height // 4 or height < 120:
        raise ValueError(f"size: {width}x{height} must be even, at least 120 high and 0.75 times as wide as high")
    camera = camera_of(camera, hand) if isinstance(camera, str) else camera
    force_range = force_range or float(np.max(snapshot.taxel_force)) or 1.0
    finger_range = finger_range or 1.0

    def draw(frame: Snapshot, pose: Pose) -> np.ndarray:
        scene = draw_scene(hand, kinds, frame, pose, camera, (width - panel_width, height), force_range)
        panel = draw_panel(hand, (panel_width, height), frame, force_range, finger_range)
        return np.concatenate([scene, panel], 1)

    return draw


def camera_of(task: str, hand: Hand) -> Camera:
    """The preset of a task, or the grasp's, moved as far as this hand grasps away from where the shipped one does."""
    camera = CAMERAS.get(task, CAMERAS["grasp"])
    if not hand.grasp_centre:
        return camera
    moved = np.asarray(camera.target) + np.asarray(hand.grasp_centre) - _GRASP_CENTRE
    return dataclasses.replace(camera, target=tuple(moved.tolist()))


def _finite(snapshot: Snapshot) -> Snapshot:
    """NumPy arrays with zeros for what is not finite (a broken simulation must still be shown), but for the target."""
    arrays = snapshot.map(np.asarray)
    clean = arrays.map(lambda x: np.nan_to_num(x, posinf=0, neginf=0) if x.dtype.kind == "f" else x)
    return dataclasses.replace(clean, target_force=arrays.target_force)


def _write_video(frame: Callable[[int], np.ndarray], count: int, path: Path, fps: float, size: tuple[int, int]) -> Path:
    try:
        if path.suffix == ".gif":
            raise ImportError
        import imageio_ffmpeg

        imageio_ffmpeg.get_ffmpeg_exe()
    except (ImportError, RuntimeError):  # the wheel of some platforms comes without the program
        return _write_gif([frame(t) for t in range(count)], path.with_suffix(".gif"), fps)
    path = path.with_suffix(".mp4")
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
        # The encoder is started by a fork that executes another program at once, which JAX's threads survive.
        warnings.filterwarnings("ignore", "os.fork", RuntimeWarning)
        film = Path(folder) / "film.mp4"
        writer = imageio_ffmpeg.write_frames(
            str(film), size, fps=fps, codec="libx264", pix_fmt_out="yuv420p", macro_block_size=2,
            output_params=["-crf", "20", "-preset", "veryfast", "-movflags", "+faststart"], ffmpeg_log_level="quiet",
        )  # fmt: skip
        try:
            writer.send(None)
            for t in range(count):
                writer.send(np.ascontiguousarray(frame(t)))
            writer.close()
            imageio_ffmpeg.count_frames_and_secs(str(film))  # the encoder ends in the same way on a full disk
        except (OSError, RuntimeError):  # their text is the encoder's whole command
            raise OSError(f"{path}: the film cannot be encoded in {folder} (is the disk full?)") from None
        finally:
            writer.close()
        write_atomic(path, [film.read_bytes()])
    return path


def _write_gif(frames: list[np.ndarray], path: Path, fps: float) -> Path:
    from PIL import Image

    # One palette for all frames, so that nothing flickers.
    some = np.concatenate(frames[:: -(-len(frames) // 5)])
    palette = Image.fromarray(some).quantize(256)
    images = [Image.fromarray(frame).quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames]
    buffer = io.BytesIO()
    images[0].save(buffer, "GIF", save_all=True, append_images=images[1:], duration=round(1000 / fps), loop=0)
    write_atomic(path, [buffer.getvalue()])
    return path
