"""What an environment carries from tick to tick, and what holds for a whole episode."""

from typing import Any

import jax

from dexsim.actuator.gear_play import GearState
from dexsim.core.pytree import pytree_dataclass
from dexsim.objects.params import ObjectParams
from dexsim.observation import Readings
from dexsim.physics.seam import PhysicsState
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
class SensorInput:
    """What the sensors see at one instant, before latency, noise and counts."""

    joint_position: jax.Array  # [J] rad
    joint_torque: jax.Array  # [J] 1, torque over its limit
    taxel_force: jax.Array  # [F, N] N
    object_position: jax.Array  # [3] m
    object_quat: jax.Array  # [4]
    tangential_force: jax.Array | None = None  # [F, 3] N, with three-axis taxels


@pytree_dataclass
class State:
    """One environment after a tick. J joints, F fingers, N taxels a finger."""

    key: jax.Array
    episode: Episode
    physics: PhysicsState
    joint_target: jax.Array  # [J] rad
    action: jax.Array  # [J], the last one applied
    goal: Any  # the task's own pytree
    sensor_input: SensorInput
    readings: Readings
    finger_force: jax.Array  # [F] N, true resultant forces of the object on the finger tips
    tick: jax.Array  # [] int32 since the episode began (may begin staggered)
    length: jax.Array  # [] int32 ticks lived
    episode_return: jax.Array  # []
    obs: dict[str, jax.Array]
    reward: jax.Array  # []
    terminated: jax.Array  # [] bool
    truncated: jax.Array  # [] bool
    metrics: dict[str, jax.Array]
    taxel_memory: TaxelMemory
    gear: GearState | None = None  # of the joints, with gear play
    correction: jax.Array | None = None  # [] of the command, with a force loop
    reflex: jax.Array | None = None  # [F] rad in the joint targets, with a grip reflex
    scale: jax.Array | None = None  # [] of the ranges that the next episode is drawn from


@pytree_dataclass
class Perception:
    """What is known of a tick."""

    sensor_input: SensorInput
    readings: Readings
    taxel_memory: TaxelMemory
    obs: dict[str, jax.Array]
    correction: jax.Array | None


@pytree_dataclass
class Outcome:
    """What a tick was worth, and whether it ended the episode; see `State`."""

    reward: jax.Array  # []
    terminated: jax.Array  # [] bool
    truncated: jax.Array  # [] bool
    tick: jax.Array  # [] int32
    length: jax.Array  # [] int32
    episode_return: jax.Array  # []
    metrics: dict[str, jax.Array]  # the task's
