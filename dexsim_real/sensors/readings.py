"""From measurements to `Readings`: the hardware's half of the one road to the policy."""

import dataclasses
from collections.abc import Sequence

import numpy as np

from dexsim.observation import FIELDS, Readings
from dexsim_real.core.errors import HandError
from dexsim_real.sensors.hand import Measured

SOURCES = ("hand", "camera", "imu", "user", "policy")
"""Who gives the bridge what a policy observes; see `ObservationField.source`."""


@dataclasses.dataclass(frozen=True)
class ObjectEstimate:
    """What camera and IMU say about the object, palm frame."""

    position: np.ndarray  # [3] m
    velocity: np.ndarray  # [3] m/s
    quat: np.ndarray  # [4]


def sources_of(names: Sequence[str]) -> set[str]:
    """Which of "hand", "camera", "imu", ... an observation with these fields needs.

    Raises:
      HandError: a field that no sensor of the bridge measures.
    """
    for name in names:
        if name not in FIELDS or FIELDS[name].source not in SOURCES:
            raise HandError(f"the policy observes {name!r}, which the hand cannot measure")
    return {FIELDS[name].source for name in names}


def make_readings(
    measured: Measured, seen: ObjectEstimate, goal_quat: np.ndarray, command: float, last_action: np.ndarray
) -> Readings:
    """One tick of measurements, filled by name; float32, as in simulation.

    `last_action` is the action that led to these measurements.
    """
    known = {
        "joint_position": measured.joint_position,
        "joint_torque": measured.joint_torque,
        "taxel_force": measured.taxel_force,
        "object_position": seen.position,
        "object_velocity": seen.velocity,
        "object_quat": seen.quat,
        "goal_quat": goal_quat,
        "command": command,
        "last_action": last_action,
    }
    return Readings(**{name: np.asarray(value, np.float32) for name, value in known.items()})
