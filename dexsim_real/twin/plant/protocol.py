"""The interface between the physics of an emulated hand and its wire.

`dexsim_real.twin.wire` translates bytes into calls of a `Plant`, in real time, and knows nothing of physics.
"""

import dataclasses
from typing import Any, Protocol

import numpy as np

from dexsim_real.twin.plant.shapes import ObjectShape


@dataclasses.dataclass(frozen=True)
class MotorCommands:
    """Commands that the palm board received; one entry per joint, in the order and units of the wire."""

    position: np.ndarray  # [12] rad
    kp: np.ndarray  # [12]
    ki: np.ndarray  # [12]
    kd: np.ndarray  # [12]
    torque_max: np.ndarray  # [12] mA
    mode: np.ndarray  # [12] frames.Mode


@dataclasses.dataclass(frozen=True)
class PlantMeasurement:
    """Readings of the emulated hand's sensors at one time, before the quantisation of the wire."""

    time: float  # s since the start of the plant
    joint_position: np.ndarray  # [12] rad, from the encoders
    joint_velocity: np.ndarray  # [12] rad/s
    current: np.ndarray  # [12] mA
    temperature: np.ndarray  # [12] degC, of the motors
    taxel_force: np.ndarray  # [5, 120, 3] N along x, y, z of the wire; z points into the tip


class Plant(Protocol):
    """A simulated hand with an object. The owner advances its time."""

    @property
    def trial(self) -> int:
        """Number of the current trial."""
        ...

    @property
    def shape(self) -> ObjectShape:
        """Object of the current trial."""
        ...

    @property
    def up(self) -> np.ndarray:
        """[3] the vertical in the palm frame."""
        ...

    def drive(self, motors: MotorCommands) -> None:
        """Set new motor commands, effective from now."""
        ...

    def advance(self, seconds: float) -> None:
        """Simulate this duration in s."""
        ...

    def measure(self) -> PlantMeasurement: ...

    def measure_object(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Position [3] m from a camera; orientation [4] and acceleration [3] m/s^2 from an IMU in the object.

        All with delay, noise and bias.
        """
        ...

    def results(self) -> list[dict[str, Any]]:
        """True results of all trials so far, including the current one."""
        ...
