"""What an environment carries from tick to tick."""

from typing import Any

import jax

from dexsim.actuator.gear_play import GearState
from dexsim.core.pytree import pytree_dataclass
from dexsim.objects.params import ObjectParams
from dexsim.observation import Readings
from dexsim.physics.seam import PhysicsState
from dexsim.randomization import Draw
from dexsim.sensing.imu import SensorDraw
from dexsim.sensing.taxels import TaxelMemory, TaxelParams


@pytree_dataclass
class Start:
    """A start state of the pool."""

    qpos: jax.Array
    qvel: jax.Array
    target: ObjectParams
    joint_target: jax.Array | None = None  # [J] rad; None: where the joints are


@pytree_dataclass
class Sample:
    """What the sensors see at one instant, before latency, noise and counts."""

    joint_position: jax.Array  # [J] rad
    joint_torque: jax.Array  # [J] 1
    taxel_force: jax.Array  # [F, N] N
    object_position: jax.Array  # [3] m
    object_quat: jax.Array  # [4]
    tangential_force: jax.Array | None = None  # [F, 3] N, with `Sensing.three_axis`


@pytree_dataclass
class State:
    """Everything that an environment carries from tick to tick."""

    key: jax.Array
    physics: PhysicsState
    target: ObjectParams
    draw: Draw
    orientation_sensor: SensorDraw
    goal: Any  # the task's own pytree
    joint_target: jax.Array  # [J] rad
    action: jax.Array  # [J], the last one applied
    sample: Sample
    object_velocity: jax.Array  # [3] m/s, filtered estimate of the readings
    readings: Readings
    finger_force: jax.Array  # [F] N, true resultant forces
    tick: jax.Array  # [] int32 since the episode began (may begin staggered)
    length: jax.Array  # [] int32 ticks lived
    episode_return: jax.Array  # []
    obs: dict[str, jax.Array]
    reward: jax.Array  # []
    terminated: jax.Array  # [] bool
    truncated: jax.Array  # [] bool
    metrics: dict[str, jax.Array]
    array_params: TaxelParams | None = None  # of the taxels
    array: TaxelMemory | None = None
    gear: GearState | None = None  # of the joints, with gear play
    tangential_force: jax.Array | None = None  # [F, 3] N, true, with `Sensing.three_axis`
    scale: jax.Array | None = None  # [] of the ranges that the next episode is drawn from
