"""What an environment carries and what it hands to a task: start states, moments, the state, the task's rules."""

from typing import Any, Protocol

import jax
import jax.numpy as jnp
import numpy as np

from dexsim import tactile
from dexsim.backlash import GearState
from dexsim.hand import HandPose
from dexsim.objects import ObjectParams
from dexsim.observation import Readings
from dexsim.orientation_sensor import SensorDraw
from dexsim.physics import PhysicsState
from dexsim.pytree import pytree_dataclass
from dexsim.randomization import Draw
from dexsim.sensor_noise import SensorParams, SensorState


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
class Moment:
    """The truth after a tick: what reward, termination and the critic may look at."""

    target: ObjectParams
    joint_position: jax.Array  # [J] rad
    joint_velocity: jax.Array  # [J] rad/s
    joint_torque: jax.Array  # [J] Nm
    pose: HandPose
    finger_force: jax.Array  # [F, 3] N, of the object on the finger tips
    touch: tactile.Touch
    object_position: jax.Array  # [3] m
    object_quat: jax.Array  # [4]
    object_velocity: jax.Array  # [3] m/s
    object_spin: jax.Array  # [3] rad/s
    action: jax.Array  # [J]
    last_action: jax.Array  # [J]
    tangential_force: jax.Array | None = None  # [F, 3] N of `finger_force`, along the taxels


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
    array_params: SensorParams | None = None  # of the taxels, where `Sensing.array` is on
    array: SensorState | None = None
    gear: GearState | None = None  # of the joints, with gear play
    tangential_force: jax.Array | None = None  # [F, 3] N, true, with `Sensing.three_axis`
    scale: jax.Array | None = None  # [] of the ranges that the next episode is drawn from


class Task(Protocol):
    """What a task adds. All methods are pure and written for one environment."""

    name: str
    config: Any
    fields: dict[str, tuple[str, ...]]  # observation fields of "actor" and "critic"
    gravity: tuple[float, float, float]  # m/s^2, palm frame
    reference: tuple[float, float, float]  # m, where the object belongs
    episode_ticks: int
    slots: tuple[str, ...]
    largest: np.ndarray  # [K, 3] m, upper bound of each slot's size
    evaluation_ticks: int
    evaluation: str  # "series" or "totals": what `summarize` is given, see `Env.summarize`
    object_ranges: tuple[str, ...]  # paths in `config` of what is drawn for every object

    def draw_object(self, key: jax.Array, config: Any, shape_index: jax.Array | None = None) -> ObjectParams: ...
    def make_pool(self, key: jax.Array) -> Start: ...
    def plain_inertia(self, target: ObjectParams) -> jax.Array: ...
    def begin(self, key: jax.Array, start: Start) -> Any: ...
    def update(self, key: jax.Array, goal: Any, moment: Moment) -> Any: ...
    def goal_readings(self, goal: Any) -> tuple[jax.Array, jax.Array]: ...
    def push(self, key: jax.Array, target: ObjectParams) -> jax.Array: ...
    def reward(self, goal: Any, moment: Moment, dropped: jax.Array) -> tuple[jax.Array, dict[str, jax.Array]]: ...
    def dropped(self, goal: Any, moment: Moment) -> jax.Array: ...
    def target_force(self, goal: Any) -> jax.Array: ...
    def evaluation_plan(self, count: int, shape_index: np.ndarray) -> tuple[np.ndarray, Any]: ...
    def summarize(self, metrics: dict[str, np.ndarray], alive: np.ndarray, control_period: float) -> dict: ...


def choose(done: jax.Array, new: Any, old: Any) -> Any:
    """`new` where `done` [], else `old`: two states, their random keys included."""

    def leaf(new: jax.Array, old: jax.Array) -> jax.Array:
        if jnp.issubdtype(old.dtype, jax.dtypes.prng_key):
            return jax.random.wrap_key_data(jnp.where(done, jax.random.key_data(new), jax.random.key_data(old)))
        return jnp.where(done, new, old)

    return jax.tree.map(leaf, new, old)
