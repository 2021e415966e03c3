"""What the emulated hand's physics and its wire agree on.

`Plant` is the world: joints, motors, skin and object, in C MuJoCo. The wire (`dexsim_real.twin.wire.line`) turns
bytes into calls of it, at the pace of the wall clock, and knows nothing of physics.
"""

import dataclasses
from typing import Any, Protocol

import numpy as np

from dexsim_real.twin.plant.shapes import ObjectShape


@dataclasses.dataclass(frozen=True)
class MotorCommands:
    """What the palm board has been told; one entry a joint, in the wire's order and units."""

    position: np.ndarray  # [12] rad
    kp: np.ndarray  # [12]
    ki: np.ndarray  # [12]
    kd: np.ndarray  # [12]
    torque_max: np.ndarray  # [12] mA
    mode: np.ndarray  # [12] frames.Mode


@dataclasses.dataclass(frozen=True)
class PlantMeasurement:
    """What the hand's own sensors show at an instant, before the wire's quantisation."""

    time: float  # s since the plant began
    joint_position: np.ndarray  # [12] rad, of the encoders
    joint_velocity: np.ndarray  # [12] rad/s
    current: np.ndarray  # [12] mA
    temperature: np.ndarray  # [12] degC, of the motors
    taxel_force: np.ndarray  # [5, 120, 3] N along the wire's x, y, z; z presses into the tip
    object_quat: np.ndarray  # [4], of the object in the palm's frame
    object_position: np.ndarray  # [3] m, palm's frame
    object_acceleration: np.ndarray  # [3] m/s^2 as an IMU in it feels, its own frame


class Plant(Protocol):
    """A hand with an object, advanced in time by whoever owns it."""

    trial: int
    """Number of the trial under way."""
    shape: ObjectShape
    """The object of this trial."""
    up: np.ndarray
    """[3] the vertical in the palm's frame."""

    def drive(self, motors: MotorCommands) -> None:
        """New commands, effective from now."""
        ...

    def advance(self, seconds: float) -> None:
        """Let this much time pass."""
        ...

    def measure(self) -> PlantMeasurement: ...

    def measure_object(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Place [3] m as a camera has it, orientation [4] and acceleration [3] m/s^2 as an IMU in the object does:
        late, noisy and biased as those are."""
        ...

    def warm(self, joint: int, degrees: float) -> None:
        """Heat one motor (a fault); negative: let it cool."""
        ...

    def results(self) -> list[dict[str, Any]]:
        """The truth about every trial so far, the current one included."""
        ...
