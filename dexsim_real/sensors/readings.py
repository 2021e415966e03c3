"""From measurements to `Readings`: the hardware's half of the one road to the policy."""

import dataclasses
from collections.abc import Sequence

import numpy as np

from dexsim.observation import Readings
from dexsim_real.core.errors import HandError
from dexsim_real.sensors.hand import Measured

SOURCES = {
    "joint_position": "hand",
    "joint_torque": "hand",
    "contact_force": "hand",
    "contact_centre": "hand",
    "fingertip_position": "hand",
    "fingertip_rotation": "hand",
    "last_action": "policy",
    "command": "user",
    "object_position": "camera",
    "object_velocity": "camera",
    "relative_orientation": "imu",
    "object_orientation": "imu",
}
"""Who measures each field of an observation on hardware."""


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
        if name not in SOURCES:
            raise HandError(f"the policy observes {name!r}, which the hand cannot measure")
    return {SOURCES[name] for name in names}


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
    return Readings(**{field.name: np.asarray(known[field.name], np.float32) for field in dataclasses.fields(Readings)})
