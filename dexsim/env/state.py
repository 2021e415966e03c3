"""What an environment carries from tick to tick, and what holds for a whole episode."""

from typing import Any

import jax

from dexsim.core.pytree import pytree_dataclass
from dexsim.objects.params import ObjectParams
from dexsim.observation import Readings
from dexsim.physics.interface import PhysicsState
from dexsim.randomization import HandParams
from dexsim.sensing.imu import ImuParams
from dexsim.sensing.taxels import TaxelMemory, TaxelParams


@pytree_dataclass
class Start:
    """A start state of the pool; J joints, H hinges (`hand.kinematics.hinge_angles`)."""

    qpos: jax.Array  # [H + 7] rad; m and unit quaternion of the object
    qvel: jax.Array  # [H + 6] rad/s; m/s (palm frame) and rad/s (object frame)
    object: ObjectParams
    joint_target: jax.Array | None = None  # [J] rad; None: where the joints are


@pytree_dataclass
class Episode:
    """What is drawn once, when an episode begins."""

    hand: HandParams
    object: ObjectParams
    imu: ImuParams
    taxels: TaxelParams


@pytree_dataclass
class State:
    """One environment after a tick. J joints, F fingers, N taxels a finger."""

    key: jax.Array
    episode: Episode
    physics: PhysicsState
    joint_target: jax.Array  # [J] rad
    previous_target: jax.Array  # [J] rad, the one before
    action: jax.Array  # [J], the last one applied
    goal: Any  # the task's own pytree
    joint_torque: jax.Array  # [J] 1, true torque over its limit
    taxel_force: jax.Array  # [F, N] N, true forces on the taxels
    readings: Readings
    tip_stiffness: jax.Array  # [F] of the fingertips' springs over nominal, for the next tick
    finger_force: jax.Array  # [F] N, true resultant forces of the object on the finger tips
    tick: jax.Array  # [] int32 since the episode began (may begin at a random one)
    length: jax.Array  # [] int32 ticks lived
    episode_return: jax.Array  # []
    obs: dict[str, jax.Array]
    reward: jax.Array  # []
    terminated: jax.Array  # [] bool
    truncated: jax.Array  # [] bool
    metrics: dict[str, jax.Array]
    taxel_memory: TaxelMemory
    correction: jax.Array | None = None  # [] of the command, with a force loop
    scale: jax.Array | None = None  # [] of the ranges that the next episode is drawn from
