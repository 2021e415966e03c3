"""The renderer: geometry against the pinhole formula, colours, where heat-map cells lie, and readable video files."""

import dataclasses
import operator
import sys
import warnings
from types import SimpleNamespace

import jax
import numpy as np
import pytest

from dexsim.core.assets import asset_path
from dexsim.datasets.episodes import read_episodes
from dexsim.geometry import sdf
from dexsim.render import picture, render
from dexsim.render.picture import Camera, Canvas, Primitives, look

KINDS = ("sphere", "box", "cylinder", "capsule")
SIZES = {"sphere": [0.03, 0, 0], "box": [0.02, 0.03, 0.025], "cylinder": [0.02, 0.03, 0], "capsule": [0.015, 0.02, 0]}
SMALL = (320, 240)


@pytest.fixture(scope="module")
def recorded():
    """Episodes of a grasp, as the live view shows them."""
    return read_episodes(asset_path("episodes") / "grasp.npz")


@pytest.mark.parametrize("kind", KINDS)
def test_rays_hit_the_surface_with_outward_normals(kind):
    """Sizes, poses and the projection are MuJoCo's: by the distance functions that the taxels use."""
    size, place = np.array([SIZES[kind]], float), np.array([[0.01, -0.02, 0.03]])
    turn = np.linalg.qr(np.random.default_rng(3).normal(size=(3, 3)))[0]
    canvas = Canvas(Camera(azimuth=40, elevation=30, distance=0.3), (60, 60))
    view, rays, color = canvas.view, canvas.rays, np.full((1, 6, 3), 0.5, np.float32)
    depth, _, normal = canvas.cast(Primitives((kind,), size, place, turn[None], color))
    seen = depth < 1e6
    assert seen.sum() > 300
    seen &= np.cumsum(seen).reshape(seen.shape) <= 300  # as many of every kind: one compilation
    points = view.origin + depth[seen][:, None] * rays[seen]
    shape = sdf.Shape((kind,), *map(np.float32, (size, place, turn[None])), np.ones(1, bool))
    for away in (0.0, 1e-3):  # along the normal distance grows as fast as it can
        distance = jax.jit(sdf.signed_distance)(np.float32(points + away * normal[seen]), shape)
        np.testing.assert_allclose(distance, away, atol=2e-5)
    assert np.all(np.sum(normal[seen] * rays[seen], -1) < 1e-9)
    rows, columns = np.nonzero(seen)
    pixels, away = view.project(points)
    np.testing.assert_allclose(pixels, np.stack([columns, rows], -1) + 0.5, atol=1e-3)
    np.testing.assert_allclose(away, depth[seen], rtol=1e-6)


def test_a_loaded_taxel_shows_on_the_finger(hand, recorded):
    """Of two pictures of a loosely closed hand without an object, which differ in one taxel's force, the pixels around
    that taxel differ and turn hot."""
    first = recorded.snapshots[0].map(operator.itemgetter(0))
    joints = np.float32([1.4, 0.2, 0.3, 0.0] + [0.8, 0.5] * 4)
    nothing = {name: np.zeros_like(getattr(first, name)) for name in ("primitive_active", "taxel_force")}
    loose = dataclasses.replace(first, joint_position=joints, **nothing)
    pose = render.hand_poses(hand, loose.joint_position[None])[0]
    size = (640, 480)
    view = look(render.CAMERAS["grasp"], (400, 480))
    facing = np.sum(pose.taxel_normal * (view.origin - pose.taxel_position), -1)
    finger, taxel = np.unravel_index(np.argmax(np.where(np.arange(5)[:, None] == 0, facing, -1)), facing.shape)
    force = np.zeros_like(loose.taxel_force)
    force[finger, taxel] = 2.0
    frames = [
        render.render_frame(hand, recorded.kinds, s, size=size, force_range=2.0)[:, :400].astype(int)
        for s in (loose, dataclasses.replace(loose, taxel_force=force))
    ]
    rows, columns = np.nonzero(np.any(frames[0] != frames[1], -1))
    assert 3 <= len(rows) < 200
    pixel, _ = view.project(pose.taxel_position[finger, taxel])
    np.testing.assert_allclose([columns.mean() + 0.5, rows.mean() + 0.5], pixel, atol=2)
    assert frames[1][rows, columns].sum() > frames[0][rows, columns].sum()


def test_the_goal_is_shown_in_its_orientation_and_only_where_there_is_one(hand):
    recorded = read_episodes(asset_path("episodes") / "rotate.npz")
    first = recorded.snapshots[0].map(operator.itemgetter(0))
    view = look(render.CAMERAS["rotate"], (200, 240))
    x, y = view.project(picture.goal_position(render.CAMERAS["rotate"]))[0].astype(int)
    frames = [
        render.render_frame(
            hand, recorded.kinds, dataclasses.replace(first, goal_rotation=turn), size=SMALL, camera="rotate"
        )
        for turn in (None, np.eye(3), np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]], np.float32))
    ]
    frames = [frame[y - 4 : y + 4, x - 4 : x + 4].mean((0, 1)) for frame in frames]
    assert np.ptp(frames[0]) < 20, "the backdrop is grey"
    assert np.abs(frames[1] - frames[0]).max() > 60 and np.abs(frames[2] - frames[1]).max() > 60


def episode(recorded, length):
    env = SimpleNamespace(name="grasp", hand=recorded.hand, primitive_kinds=recorded.kinds)
    return env, recorded.snapshots[0].map(operator.itemgetter(slice(length)))


def test_mp4_is_written_and_readable(recorded, tmp_path):
    ffmpeg = pytest.importorskip("imageio_ffmpeg")
    env, steps = episode(recorded, 5)
    path = render.render_episode(env, steps, tmp_path / "video.mp4", fps=25, size=SMALL)
    assert path.suffix == ".mp4"
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "os.fork", RuntimeWarning)
        frames, seconds = ffmpeg.count_frames_and_secs(str(path))
        reader = ffmpeg.read_frames(str(path))
        assert next(reader)["size"] == SMALL
    assert frames == 5 and abs(seconds - 0.2) < 0.05
    first = np.frombuffer(next(reader), np.uint8).reshape(240, 320, 3).astype(int)
    reader.close()
    drawn = render.render_frame(
        env.hand, recorded.kinds, steps.map(operator.itemgetter(0)), size=SMALL, force_range=1.0
    )
    assert np.abs(first[:, :200] - drawn[:, :200]).mean() < 4  # what lossy compression leaves


def test_a_film_of_another_rate_keeps_its_duration(recorded, tmp_path, monkeypatch):
    from PIL import Image

    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)  # as if not installed
    env, steps = episode(recorded, 9)
    for rate, frames, duration in ((10, 3, 100), (60, 18, 20)):
        path = render.render_episode(env, steps, tmp_path / "new" / "video.mp4", fps=30, size=(160, 120), rate=rate)
        assert path == tmp_path / "new" / "video.gif"
        with Image.open(path) as image:
            assert image.n_frames <= frames and image.info["duration"] >= duration - 4
            total = sum(image.seek(k) or image.info["duration"] for k in range(image.n_frames))
        assert total == pytest.approx(300, abs=30 + 60 * (rate == 60))  # a GIF counts hundredths, and merges twins
    empty = steps.map(operator.itemgetter(slice(0)))
    with pytest.raises(ValueError, match="no snapshots"):
        render.render_episode(env, empty, tmp_path / "none.gif", fps=30)
