"""From what a hand can measure to what a policy sees: `Readings` and `observe`.

Simulation and hardware both end in `Readings` and both call `observe`; nothing after it can
know which world it is in. Shapes: J joints, F fingers, N taxels a finger.
"""

import dataclasses
from collections.abc import Callable

import jax
import jax.numpy as jnp

from dexsim import rotations, tactile
from dexsim.config import setting, validate
from dexsim.hand import Hand, forward_kinematics, taxel_positions
from dexsim.pytree import pytree_dataclass


@pytree_dataclass
class Readings:
    """One tick of measurements, SI units, palm frame; the same on the hand and in simulation.

    `last_action` is the action that led to these measurements: the one before the action that
    the policy is about to choose. Both worlds must keep to that.
    """

    joint_position: jax.Array  # [J] rad
    joint_torque: jax.Array  # [J] 1, torque over its calibrated maximum
    taxel_force: jax.Array  # [F, N] N
    object_position: jax.Array  # [3] m
    object_velocity: jax.Array  # [3] m/s
    object_quat: jax.Array  # [4] (w, x, y, z)
    goal_quat: jax.Array  # [4] target orientation of the object
    command: jax.Array  # [] grip command in [0, 1]
    last_action: jax.Array  # [J] in [-1, 1]


@dataclasses.dataclass(frozen=True)
class Field:
    """A named piece of an observation.

    `scale`: None for the running normaliser; a number divides the values instead. Touch has a
    fixed scale, since running statistics of a signal that is mostly zero explode at the first
    contact.
    """

    name: str
    size: int
    scale: float | None = None


@dataclasses.dataclass(frozen=True, kw_only=True)
class ObservationConfig:
    """What of the touch and orientation signals the policy sees (the paper's ablations)."""

    weighting: str = setting("force", choices=("force", "none"))
    """Contact centre weighted by taxel force, or the plain mean of the active taxels."""
    orientation: str = setting("6d", choices=("6d", "quaternion"))
    """Encoding of the relative target orientation."""
    leave_out: tuple[str, ...] = setting((), choices=("contact_force", "contact_centre",
                                                      "relative_orientation"))
    """Observation fields to drop."""

    def __post_init__(self):
        validate(self)


@pytree_dataclass
class Features:
    """What the fields are made of, computed once from the readings."""

    readings: Readings
    tip_position: jax.Array  # [F, 3] m
    contact_force: jax.Array  # [F] N
    contact_centre: jax.Array  # [F, 3] m


def _relative_orientation(f: Features, encoding: str) -> jax.Array:
    """Rotation that takes the object to its goal, in the palm frame."""
    relative = rotations.quat_multiply(f.readings.goal_quat,
                                       rotations.quat_conjugate(f.readings.object_quat))
    if encoding == "quaternion":
        return relative
    return rotations.matrix_to_6d(rotations.quat_to_matrix(relative))


_TERMS: dict[str, Callable[[Features], jax.Array]] = {
    "joint_position": lambda f: f.readings.joint_position,
    "joint_torque": lambda f: f.readings.joint_torque,
    "object_position": lambda f: f.readings.object_position,
    "object_velocity": lambda f: f.readings.object_velocity,
    "contact_force": lambda f: f.contact_force,
    "contact_centre": lambda f: f.contact_centre.ravel(),
    "fingertip_position": lambda f: f.tip_position.ravel(),
    "command": lambda f: f.readings.command[None],
    "last_action": lambda f: f.readings.last_action,
}

GRASP = ("joint_position", "joint_torque", "object_position", "object_velocity",
         "contact_force", "contact_centre", "fingertip_position", "command")
ROTATE = ("joint_position", "relative_orientation", "last_action", "contact_centre",
          "contact_force", "fingertip_position")


def layout(hand: Hand, names: tuple[str, ...], config: ObservationConfig) -> tuple[Field, ...]:
    """Names, sizes and scales of an observation's fields, in order."""
    joints, fingers = hand.num_joints, hand.num_fingers
    size = {"joint_position": joints, "joint_torque": joints, "object_position": 3,
            "object_velocity": 3, "contact_force": fingers, "contact_centre": 3 * fingers,
            "fingertip_position": 3 * fingers, "command": 1, "last_action": joints,
            "relative_orientation": 4 if config.orientation == "quaternion" else 6}
    scale = {"contact_force": 5.0, "contact_centre": 0.1, "command": 0.5, "joint_torque": 0.3,
             "last_action": 1.0}
    return tuple(Field(name, size[name], scale.get(name)) for name in names
                 if name not in config.leave_out)


def observe(hand: Hand, readings: Readings, names: tuple[str, ...],
            config: ObservationConfig) -> jax.Array:
    """The observation vector: the only road from measurements to a policy.

    Args:
      hand: the hand's description (static).
      readings: one tick of measurements.
      names: the task's fields, `GRASP` (66 values for the shipped hand) or `ROTATE` (65).
      config: what to leave out and how to encode.

    Returns:
      [sum of the layout's sizes] float32, not normalised.
    """
    pose = forward_kinematics(hand, readings.joint_position)
    force, centre = tactile.reduce_touch(readings.taxel_force, taxel_positions(hand, pose),
                                         config.weighting)
    features = Features(readings, pose.tip_position, force, centre)
    parts = []
    for name in names:
        if name in config.leave_out:
            continue
        if name == "relative_orientation":
            parts.append(_relative_orientation(features, config.orientation))
        else:
            parts.append(_TERMS[name](features))
    return jnp.concatenate(parts).astype(jnp.float32)
