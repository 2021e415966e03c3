"""From what a hand can measure to what a policy sees: `Readings` and `observe`.

Simulation and hardware both end in `Readings` and both call `observe`; nothing after it can
know which world it is in. Shapes: J joints, F fingers, N taxels a finger.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from dexsim.core.config import Config, setting
from dexsim.core.layout import LayoutEntry
from dexsim.core.pytree import leaf, pytree_dataclass
from dexsim.errors import ConfigError
from dexsim.geometry import rotations
from dexsim.hand.description import Hand
from dexsim.hand.kinematics import HandPose, forward_kinematics, tip_twist
from dexsim.hand.mirror import AXIAL, POLAR, QUAT, mirror_hand
from dexsim.touch.reduce import estimate_force, reduce_touch_links


@pytree_dataclass
class Readings:
    """One tick of measurements, SI units, palm frame; the same on the hand and in simulation.

    `last_action` is the action that led to these measurements: the one before the action that
    the policy is about to choose. Both worlds must keep to that.
    """

    joint_position: jax.Array = leaf("[J] rad")
    joint_torque: jax.Array = leaf("[J] 1, torque over its calibrated maximum")
    taxel_force: jax.Array = leaf("[F, N] N")
    object_position: jax.Array = leaf("[3] m")
    object_velocity: jax.Array = leaf("[3] m/s")
    object_quat: jax.Array = leaf("[4] (w, x, y, z)")
    goal_quat: jax.Array = leaf("[4] target orientation of the object")
    command: jax.Array = leaf("[] grip command in [0, 1]")
    last_action: jax.Array = leaf("[J] in [-1, 1]")
    past_actions: Any = leaf("[2, J], the two before `last_action`, newest first", default=None)
    palm_gravity: Any = leaf("[3] unit vector; measured while the object lies flat, before the episode", default=None)


@pytree_dataclass
class Motion:
    """What only a simulator knows: the critic's part of an observation."""

    joint_velocity: jax.Array = leaf("[J] rad/s")
    object_spin: jax.Array = leaf("[3] rad/s, palm frame")


class Features(NamedTuple):
    """What the fields are made of."""

    hand: Hand
    readings: Readings
    config: "ObservationConfig"
    motion: Any  # `Motion`; None for an actor, whose fields do not ask for it
    pose: HandPose
    contact_force: jax.Array  # [F] N
    contact_centre: jax.Array  # [F, 3] m


class ObservationField(NamedTuple):
    """A named piece of an observation, a row of `_FIELDS`: all there is to know about it."""

    name: str
    source: str
    """Who measures it on a hand: "hand", "camera" or "imu"; "user", "policy", "mount" know it themselves; "simulator"
    alone knows the rest, which is for critics."""
    compute: Callable[[Features], jax.Array]
    """Its values, one axis."""
    scale: float | None = None
    """None for the running normaliser; a number divides the values instead. Touch has a fixed scale, since running
    statistics of a signal that is mostly zero explode at the first contact."""


def _encode(f: Features, quat: jax.Array) -> jax.Array:
    return quat if f.config.orientation == "quaternion" else rotations.matrix_to_6d(rotations.quat_to_matrix(quat))


def _relative_orientation(f: Features) -> jax.Array:
    """Rotation that takes the object to its goal, in the palm frame."""
    return _encode(f, rotations.quat_multiply(f.readings.goal_quat, rotations.quat_conjugate(f.readings.object_quat)))


def _finger_force(f: Features) -> jax.Array:
    return estimate_force(f.config.torque_share, f.hand, f.readings.taxel_force, f.readings.joint_torque)


def _fingertip_velocity(f: Features) -> jax.Array:
    return tip_twist(f.hand, f.readings.joint_position, f.motion.joint_velocity).ravel()


_FIELDS = (
    ("joint_position", "hand", lambda f: f.readings.joint_position, None),
    ("joint_torque", "hand", lambda f: f.readings.joint_torque, 0.3),
    ("object_position", "camera", lambda f: f.readings.object_position, None),
    ("object_velocity", "camera", lambda f: f.readings.object_velocity, None),
    ("contact_force", "hand", lambda f: f.contact_force, 5.0),
    ("contact_centre", "hand", lambda f: f.contact_centre.ravel(), 0.1),
    ("finger_force", "hand", _finger_force, 5.0),
    ("fingertip_position", "hand", lambda f: f.pose.tip_position.ravel(), None),
    ("fingertip_rotation", "hand", lambda f: rotations.matrix_to_6d(f.pose.tip_rotation).ravel(), None),
    ("command", "user", lambda f: f.readings.command[None], 0.5),
    ("last_action", "policy", lambda f: f.readings.last_action, 1.0),
    ("past_actions", "policy", lambda f: f.readings.past_actions.ravel(), 1.0),
    ("palm_gravity", "mount", lambda f: f.readings.palm_gravity, 1.0),
    ("relative_orientation", "imu", _relative_orientation, None),
    ("object_orientation", "imu", lambda f: _encode(f, f.readings.object_quat), None),
    ("fingertip_velocity", "simulator", _fingertip_velocity, None),
    ("joint_velocity", "simulator", lambda f: f.motion.joint_velocity, None),
    ("object_spin", "simulator", lambda f: f.motion.object_spin, None),
)
FIELDS = {row[0]: ObservationField(*row) for row in _FIELDS}
"""Every field by name; a row of `_FIELDS` each."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class ObservationConfig(Config):
    """What of the touch and orientation signals the policy sees (the paper's ablations)."""

    weighting: str = setting("force", choices=("force", "none"))
    """Contact centre weighted by taxel force, or the plain mean of the active taxels."""
    orientation: str = setting("6d", choices=("6d", "quaternion"))
    """Encoding of the relative target orientation."""
    leave_out: tuple[str, ...] = setting(
        (), choices=("joint_torque", "contact_force", "contact_centre", "relative_orientation")
    )
    """Observation fields that the actor goes without."""
    add: tuple[str, ...] = setting((), choices=FIELDS)
    """Measured fields beyond the task's own, for actor and critic."""
    torque_share: float = setting(0.4, unit="1", low=0.0, high=1.0)
    """Share in the force estimate (`finger_force`, `Control.force`) of what a finger's root torque tells beyond its
    taxels; 0 for the taxels alone."""

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in self.add:
            if FIELDS[name].source == "simulator":
                raise ConfigError(f"ObservationConfig.add = {name!r}: no sensor measures it")


GRASP = (
    "joint_position",
    "joint_torque",
    "object_position",
    "object_velocity",
    "contact_force",
    "contact_centre",
    "fingertip_position",
    "command",
)
ROTATE = (
    "joint_position",
    "relative_orientation",
    "last_action",
    "contact_centre",
    "contact_force",
    "fingertip_position",
)
ROTATE_CRITIC = (
    *ROTATE,
    "object_orientation",
    "fingertip_velocity",
    "fingertip_rotation",
    "joint_velocity",
    "object_velocity",
    "object_spin",
)


def mirror_readings(readings: Readings) -> Readings:
    """What the mirror image of a hand measures in the mirrored scene: joints, taxels and actions are the same."""
    gravity = readings.palm_gravity
    return dataclasses.replace(
        readings,
        object_position=readings.object_position * POLAR,
        object_velocity=readings.object_velocity * POLAR,
        object_quat=readings.object_quat * QUAT,
        goal_quat=readings.goal_quat * QUAT,
        palm_gravity=None if gravity is None else gravity * POLAR,
    )


def layout(hand: Hand, names: tuple[str, ...], config: ObservationConfig) -> tuple[LayoutEntry, ...]:
    """Names, sizes and scales of an observation's fields, in order."""
    joints, vector, quat = (jnp.zeros(size) for size in (hand.num_joints, 3, 4))
    past, taxels, command = jnp.stack([joints] * 2), jnp.zeros(hand.taxel_area.shape), jnp.zeros(())
    readings = Readings(joints, joints, taxels, vector, vector, quat, quat, command, joints, past, vector)
    motion, alone = Motion(joints, vector), dataclasses.replace(config, leave_out=(), add=())
    entries = []
    for name in select_fields(names, config):
        part = jax.eval_shape(functools.partial(observe, hand, readings, (name,), alone, motion))
        entries.append(LayoutEntry(name, part.size, FIELDS[name].scale))
    return tuple(entries)


def select_fields(names: tuple[str, ...], config: ObservationConfig) -> tuple[str, ...]:
    """The task's fields `names` as configured: those left out gone, those added behind them."""
    names = tuple(name for name in names if name not in config.leave_out)
    return (*names, *(name for name in dict.fromkeys(config.add) if name not in names))


def observe(
    hand: Hand,
    readings: Readings,
    names: tuple[str, ...],
    config: ObservationConfig,
    motion: Motion | None = None,
    pose: HandPose | None = None,
) -> jax.Array:
    """The observation vector: the only road from measurements to a policy.

    A left hand is observed as its mirror image, so that a policy of a right hand moves it, and the other way round.

    Args:
      names: the task's fields, such as `GRASP` (66 values for the shipped hand) or `ROTATE` (65).
      motion: for a critic whose fields ask for it.
      pose: of the hand at the readings' joint angles, where it is known already.

    Returns:
      [sum of the layout's sizes] float32, not normalised.
    """
    if hand.side == "left":
        motion = motion and Motion(motion.joint_velocity, motion.object_spin * AXIAL)
        return observe(mirror_hand(hand), mirror_readings(readings), names, config, motion)
    pose = forward_kinematics(hand, readings.joint_position) if pose is None else pose
    contact = reduce_touch_links(readings.taxel_force, hand, pose, config.weighting)
    features = Features(hand, readings, config, motion, pose, *contact)
    parts = [FIELDS[name].compute(features) for name in select_fields(names, config)]
    return jnp.concatenate(parts).astype(jnp.float32)
