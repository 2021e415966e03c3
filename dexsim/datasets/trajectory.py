"""An episode as data, of a simulation or of a hand. Shapes: T ticks, J joints, F fingers, N taxels a finger."""

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np


@dataclasses.dataclass(frozen=True, kw_only=True)
class Trajectory:
    """What was measured at each tick, and the joint targets that followed. NumPy."""

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
        fields = {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}
        picked: dict[str, Any] = {name: None if values is None else values[nearest] for name, values in fields.items()}
        return Trajectory(**picked | {"time": instants})


READINGS = ("joint_position", "joint_torque", "taxel_force", "object_position", "object_quat", "command")
"""Fields that a trajectory takes from the readings of a tick."""


def from_readings(time: np.ndarray, readings: Sequence[dict], target: np.ndarray) -> Trajectory:
    """A trajectory of T ticks' readings, as dictionaries, and joint targets [T, J] rad."""
    fields = {name: np.stack([np.asarray(now[name], np.float32) for now in readings]) for name in READINGS}
    return Trajectory(time=np.asarray(time, float), target=np.asarray(target, np.float32), **fields)
