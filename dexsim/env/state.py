"""What an environment carries from tick to tick, and what holds for a whole episode."""

from typing import Any

import jax

from dexsim.core.pytree import leaf, pytree_dataclass
from dexsim.objects.params import ObjectParams
from dexsim.observation import Readings
from dexsim.physics.interface import PhysicsState
from dexsim.randomization import HandParams
from dexsim.sensing.imu import ImuParams
from dexsim.sensing.taxels import TaxelMemory, TaxelParams


@pytree_dataclass
class Start:
    """A start state of the pool; J joints, H hinges (`hand.kinematics.hinge_angles`)."""

    qpos: jax.Array = leaf("[H + 7] rad; m and unit quaternion of the object")
    qvel: jax.Array = leaf("[H + 6] rad/s; m/s (palm frame) and rad/s (object frame)")
    object: ObjectParams = leaf("[K] primitives, mass, friction")
    joint_target: jax.Array | None = leaf("[J] rad; None: where the joints are", default=None)


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

    key: jax.Array = leaf("[] random key")
    episode: Episode = leaf("what was drawn when the episode began")
    physics: PhysicsState = leaf("qpos [H + 7] rad, m; qvel [H + 6] rad/s, m/s; as in `Start`")
    joint_target: jax.Array = leaf("[J] rad")
    previous_target: jax.Array = leaf("[J] rad, the one before")
    action: jax.Array = leaf("[J], the last one applied")
    goal: Any = leaf("the task's own pytree")
    joint_torque: jax.Array = leaf("[J] 1, true torque over its limit")
    taxel_force: jax.Array = leaf("[F, N] N, true forces on the taxels")
    readings: Readings = leaf("what the host has read, SI units")
    tip_stiffness: jax.Array = leaf("[F] 1, of the fingertips' springs over nominal, for the next tick")
    finger_force: jax.Array = leaf("[F] N, true resultant forces of the object on the finger tips")
    tick: jax.Array = leaf("[] int32 since the episode began (may begin at a random one)")
    length: jax.Array = leaf("[] int32 ticks lived")
    episode_return: jax.Array = leaf("[] sum of the rewards so far")
    obs: dict[str, jax.Array] = leaf('"actor" [n] and "critic" [m], SI units')
    reward: jax.Array = leaf("[] of this tick")
    terminated: jax.Array = leaf("[] bool")
    truncated: jax.Array = leaf("[] bool")
    metrics: dict[str, jax.Array] = leaf("[] by name")
    taxel_memory: TaxelMemory = leaf("[F, N] N, what the taxels remember")
    correction: jax.Array | None = leaf("[] of the command, with a force loop", default=None)
    scale: jax.Array | None = leaf("[] of the ranges that the next episode is drawn from", default=None)
