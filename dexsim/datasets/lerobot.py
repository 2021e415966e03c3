"""Trajectories of a simulation or of a hand, and the LeRobot dataset format, version 3.0, without torch and LeRobot.

Touch is laid out as LeRobot's open proposal for tactile sensors has it (huggingface/lerobot, pull request 4469, in its
state of August 2026): a feature `observation.tactile.NAME` for each sensor, a set of points with a force vector each,
[N, 3] in N. Vectors are in the fingertip's frame; ours have only the part along the normal. Where the points are, m in
that frame, is in `meta/tactile.json`, which is our own addition. LeRobot's ACT and Diffusion need the object's state,
`observation.environment_state`, or pictures, which are PNG files in the table.
"""

import dataclasses
import io
import json
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from dexsim.core.files import temporary_beside
from dexsim.core.install import require
from dexsim.errors import DexsimError
from dexsim.hand.description import Hand

VERSION = "v3.0"
FPS = 30
"""Frames a second: the format knows whole numbers only, so the nearest tick of each instant is taken."""
_PICTURE = "observation.images.scene"
_SAMPLED = 20  # pictures of an episode, at most, of which its statistics are
_FILE = "chunk-000/file-000.parquet"
_QUANTILES = {"q01": 0.01, "q10": 0.10, "q50": 0.50, "q90": 0.90, "q99": 0.99}


@dataclasses.dataclass(frozen=True, kw_only=True)
class Trajectory:
    """What was measured at each of T ticks, and the joint targets that followed; F fingers of N taxels. NumPy."""

    time: np.ndarray  # [T] s since the first tick
    joint_position: np.ndarray  # [T, J] rad
    joint_torque: np.ndarray  # [T, J] 1, over the torque limit
    taxel_force: np.ndarray  # [T, F, N] N, along the inward normal
    object_position: np.ndarray  # [T, 3] m, palm frame, as estimated
    object_quat: np.ndarray  # [T, 4] (w, x, y, z), as estimated
    command: np.ndarray  # [T] in [0, 1]
    target: np.ndarray  # [T, J] rad
    picture: np.ndarray | None = None  # [T] of a camera, each a PNG file's bytes

    def at_rate(self, rate: float) -> "Trajectory":
        """The same at another rate, Hz: of each instant the nearest tick."""
        instants = np.arange(int(self.time[-1] * rate) + 1) / rate
        nearest = np.rint(np.interp(instants, self.time, np.arange(len(self.time)))).astype(int)
        picked: dict[str, Any] = {name: None if x is None else x[nearest] for name, x in vars(self).items()}
        return Trajectory(**picked | {"time": instants})


READINGS = ("joint_position", "joint_torque", "taxel_force", "object_position", "object_quat", "command")
"""Fields that a trajectory takes from the readings of a tick."""


def from_readings(time: np.ndarray, readings: Sequence[dict], target: np.ndarray) -> Trajectory:
    """A trajectory of T ticks' readings, as dictionaries, and joint targets [T, J] rad."""
    fields = {name: np.stack([np.asarray(now[name], np.float32) for now in readings]) for name in READINGS}
    return Trajectory(time=np.asarray(time, float), target=np.asarray(target, np.float32), **fields)


def check_lerobot(folder: Path) -> None:
    """Whether a dataset can be written into `folder`.

    Raises:
      DexsimError: pyarrow or pandas is not installed, or the folder exists.
      OSError: its parent is no folder, or cannot be made.
    """
    for module in ("pyarrow", "pandas"):
        require(module, "lerobot", "the LeRobot format")
    if folder.exists() or folder.is_symlink():
        raise DexsimError(f"{folder}: exists already; name another folder")
    folder.parent.mkdir(parents=True, exist_ok=True)


def write_lerobot(folder: Path, hand: Hand, task: str, trajectories: Sequence[Trajectory]) -> Path:
    """Write a dataset of a `task`, which is a phrase, one episode for each trajectory, whole or not at all; returns its
    folder, which must not exist yet (`check_lerobot`)."""
    columns: dict[str, list[np.ndarray]] = {}
    episodes, begin = [], 0
    for number, trajectory in enumerate(trajectories):
        frames = features_of(hand, trajectory.at_rate(FPS))
        length = len(frames["timestamp"])
        frames |= {
            "episode_index": np.full(length, number, np.int64),
            "index": np.arange(begin, begin + length, dtype=np.int64),
            "task_index": np.zeros(length, np.int64),
        }
        for name, values in frames.items():
            columns.setdefault(name, []).append(values)
        episodes.append(_episode(number, begin, length, task, frames))
        begin += length
    whole = {name: np.concatenate(parts) for name, parts in columns.items()}
    # A part of a dataset would look like one, and be in the way of the next attempt: also after a kill.
    part = temporary_beside(folder)
    part.mkdir()
    try:
        _write(part, hand, task, whole, episodes)
        part.rename(folder)
    except BaseException:
        shutil.rmtree(part, ignore_errors=True)
        raise
    return folder


def _write(folder: Path, hand: Hand, task: str, whole: dict[str, np.ndarray], episodes: list[dict[str, Any]]) -> None:
    import pandas
    import pyarrow
    import pyarrow.parquet as parquet

    for part in ("data/chunk-000", "meta/episodes/chunk-000"):
        (folder / part).mkdir(parents=True)
    columns = {name: _column(values) for name, values in whole.items()}
    table = pyarrow.table({name: column for name, (column, _) in columns.items()})
    parquet.write_table(table, folder / "data" / _FILE)
    parquet.write_table(pyarrow.Table.from_pylist(episodes), folder / "meta" / "episodes" / _FILE)
    pandas.DataFrame({"task_index": [0]}, index=[task]).to_parquet(folder / "meta" / "tasks.parquet")
    for name, content in {
        "info": _info(hand, {name: feature for name, (_, feature) in columns.items()}, table.num_rows, len(episodes)),
        "stats": {name: _statistics(values) for name, values in whole.items()},
        "tactile": _tactile(hand),
    }.items():
        (folder / "meta" / f"{name}.json").write_text(json.dumps(content, indent=1) + "\n")


def features_of(hand: Hand, trajectory: Trajectory) -> dict[str, np.ndarray]:
    """The features of each frame [T, ...] by their names in the format; `action` is the joint targets, rad, and the
    state of the environment the object's pose and the force command."""
    force = trajectory.taxel_force[..., None] * -hand.taxel_normal
    count = len(trajectory.time)
    return {
        "observation.state": trajectory.joint_position,
        "observation.joint_torque": trajectory.joint_torque,
        **{f"observation.tactile.{name}": force[:, i].astype(np.float32) for i, name in enumerate(hand.finger_names)},
        "observation.environment_state": np.concatenate(
            [trajectory.object_position, trajectory.object_quat, trajectory.command[:, None]], -1
        ),
        **({} if trajectory.picture is None else {_PICTURE: trajectory.picture}),
        "action": trajectory.target,
        "timestamp": (np.arange(count) / FPS).astype(np.float32),
        "frame_index": np.arange(count, dtype=np.int64),
    }


def _info(hand: Hand, features: dict[str, dict[str, Any]], frames: int, episodes: int) -> dict[str, Any]:
    joints, force = list(hand.joint_names), ["Fx", "Fy", "Fz"]
    names = {
        "observation.state": joints,
        "observation.joint_torque": joints,
        "action": joints,
        "observation.environment_state": [
            *(f"object_position_{axis}" for axis in "xyz"),
            *(f"object_quat_{part}" for part in "wxyz"),
            "command",
        ],
        _PICTURE: ["height", "width", "channels"],
        **{f"observation.tactile.{name}": force for name in hand.finger_names},
    }
    return {
        "codebase_version": VERSION,
        "robot_type": hand.name,
        "total_episodes": episodes,
        "total_frames": frames,
        "total_tasks": 1,
        "chunks_size": 1000,
        "data_files_size_in_mb": 100,
        "video_files_size_in_mb": 500,
        "fps": FPS,
        "splits": {"train": f"0:{episodes}"},
        "data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
        "video_path": None,
        "features": {name: feature | {"names": names.get(name)} for name, feature in features.items()},
    }


def _tactile(hand: Hand) -> dict[str, Any]:
    """Where the points of each tactile feature are."""
    return {
        "unit": {"position": "m", "force": "N"},
        "frame": "of the link that carries the fingertip's taxels",
        "sensors": {
            f"observation.tactile.{name}": {
                "link": hand.body_names[hand.tip_body[i]],
                "position": np.round(hand.taxel_position[i], 6).tolist(),
                "normal": np.round(hand.taxel_normal[i], 6).tolist(),
            }
            for i, name in enumerate(hand.finger_names)
        },
    }


def _episode(number: int, begin: int, length: int, task: str, frames: dict[str, np.ndarray]) -> dict[str, Any]:
    """A row of `meta/episodes`."""
    return {
        "episode_index": number,
        "tasks": [task],
        "length": length,
        "data/chunk_index": 0,
        "data/file_index": 0,
        "dataset_from_index": begin,
        "dataset_to_index": begin + length,
        "meta/episodes/chunk_index": 0,
        "meta/episodes/file_index": 0,
        **{
            f"stats/{name}/{which}": value
            for name, values in frames.items()
            for which, value in _statistics(values).items()
        },
    }


def _statistics(values: np.ndarray) -> dict[str, Any]:
    """Minimum, maximum, mean, deviation and quantiles over frames; scalars are lists of one number. Those of
    pictures are [3, 1, 1], of each channel in [0, 1]."""
    if values.dtype == object:
        some = values[np.linspace(0, len(values) - 1, min(len(values), _SAMPLED)).astype(int)]
        pixels = np.concatenate([_pixels(picture).reshape(-1, 3) for picture in some]) / 255
        channels = _statistics(pixels) | {"count": [len(some)]}
        return {name: x if name == "count" else np.reshape(x, (3, 1, 1)).tolist() for name, x in channels.items()}
    values = np.asarray(values, float)
    values = values[:, None] if values.ndim == 1 else values
    summary = {"min": values.min(0), "max": values.max(0), "mean": values.mean(0), "std": values.std(0)}
    summary |= {name: np.quantile(values, at, axis=0) for name, at in _QUANTILES.items()}
    return {name: value.tolist() for name, value in summary.items()} | {"count": [len(values)]}


def _pixels(picture: bytes) -> np.ndarray:
    """uint8 [H, W, 3]."""
    from PIL import Image

    return np.asarray(Image.open(io.BytesIO(picture)))


def _column(values: np.ndarray) -> tuple[Any, dict[str, Any]]:
    """A column of the table, and type and shape of the feature: nested lists of the array's own number type, or a
    picture's file as Hugging Face's data sets have it."""
    import pyarrow

    if values.dtype == object:
        kind = pyarrow.struct([("bytes", pyarrow.binary()), ("path", pyarrow.string())])
        shape = list(_pixels(values[0]).shape)
        return pyarrow.array([{"bytes": picture} for picture in values], kind), {"dtype": "image", "shape": shape}
    kind = pyarrow.from_numpy_dtype(values.dtype)
    for _ in values.shape[1:]:
        kind = pyarrow.list_(kind)
    return pyarrow.array(values.tolist(), kind), {"dtype": values.dtype.name, "shape": list(values.shape[1:]) or [1]}
