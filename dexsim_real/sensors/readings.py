"""From measurements on hardware to the `Readings` from which the observation is computed."""

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np

from dexsim.observation import FIELDS, Readings
from dexsim_real.core.errors import HandError
from dexsim_real.sensors.hand import HandMeasurement

SOURCES = ("hand", "camera", "imu", "user", "policy")
"""Who gives the bridge what a policy observes; see `ObservationField.source`."""

NEEDS = {
    "joint_torque": ("currents",),
    "contact_force": ("taxels",),
    "contact_centre": ("taxels",),
    "finger_force": ("taxels", "currents"),
}
"""What a hand must measure, besides its angles, for an observation field."""


@dataclasses.dataclass(frozen=True)
class ObjectEstimate:
    """Pose and velocity of the object from camera and IMU, palm frame."""

    position: np.ndarray  # [3] m
    velocity: np.ndarray  # [3] m/s
    quat: np.ndarray  # [4] (w, x, y, z)
    palm_gravity: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros(3))  # [3]; zeros without an IMU


def sources_of(names: Sequence[str]) -> set[str]:
    """The sensors ("hand", "camera", "imu", ...) for these observation fields. HandError: none measures one of them."""
    for name in names:
        if name not in FIELDS or FIELDS[name].source not in SOURCES:
            raise HandError(
                f"the policy observes {name!r:.80}, which no sensor measures on hardware; use a policy without it"
            )
    return {FIELDS[name].source for name in names}


def check_measured(names: Sequence[str], force_loop: bool, missing: Sequence[str]) -> None:
    """Check that a hand measures what a policy needs.

    Args:
      names: of the observation fields.
      force_loop: whether the policy's command follows the estimated force.
      missing: what the hand does not measure; names in `NEEDS`.

    Raises:
      HandError: it does not measure an observation field, or the force of the loop.
    """
    wanted = {f"observes {name!r}": NEEDS.get(name, ()) for name in names}
    if force_loop:
        wanted["corrects its command by the measured force"] = NEEDS["finger_force"]
    for what, needs in wanted.items():
        if lacking := [need for need in needs if need in missing]:
            raise HandError(
                f"the policy {what}, and the hand has no {' and no '.join(lacking)}; train one without it "
                "(--env.observation.leave-out, --env.control.force.gain 0)"
            )


def make_readings(
    measured: HandMeasurement, estimate: ObjectEstimate, goal_quat: np.ndarray, command: float, actions: np.ndarray
) -> Readings:
    """The `Readings` of one tick, float32 as in simulation; `goal_quat` [4] of the object, grip command in [0, 1].

    `actions` [3, J] are the one that led to these measurements and the two before it, newest first.
    """
    values = {
        "joint_position": measured.joint_position,
        "joint_torque": measured.joint_torque,
        "taxel_force": measured.taxel_force,
        "object_position": estimate.position,
        "object_velocity": estimate.velocity,
        "object_quat": estimate.quat,
        "goal_quat": goal_quat,
        "command": command,
        "last_action": actions[0],
        "past_actions": actions[1:],
        "palm_gravity": estimate.palm_gravity,
    }
    arrays: dict[str, Any] = {name: np.asarray(value, np.float32) for name, value in values.items()}
    return Readings(**arrays)
