"""What a task is: the truth that it sees, and the rules that it adds."""

from typing import Any, Protocol

import jax
import numpy as np

from dexsim.core.pytree import pytree_dataclass
from dexsim.env.state import Start
from dexsim.hand.kinematics import HandPose
from dexsim.objects.params import ObjectParams
from dexsim.touch.feel import Touch


@pytree_dataclass
class GroundTruth:
    """The truth after a tick: what reward, termination and the critic may look at."""

    object: ObjectParams
    joint_position: jax.Array  # [J] rad
    joint_velocity: jax.Array  # [J] rad/s
    joint_torque: jax.Array  # [J] Nm
    pose: HandPose
    finger_force: jax.Array  # [F, 3] N, of the object on the finger tips
    touch: Touch
    object_position: jax.Array  # [3] m
    object_quat: jax.Array  # [4]
    object_velocity: jax.Array  # [3] m/s
    object_spin: jax.Array  # [3] rad/s
    action: jax.Array  # [J]
    last_action: jax.Array  # [J]
    tangential_force: jax.Array | None = None  # [F, 3] N of `finger_force`, along the taxels


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

    def sample_object(self, key: jax.Array, config: Any, shape_index: jax.Array | None = None) -> ObjectParams: ...
    def make_pool(self, key: jax.Array) -> Start: ...
    def unit_inertia(self, object: ObjectParams) -> jax.Array: ...
    def begin(self, key: jax.Array, start: Start) -> Any: ...
    def update(self, key: jax.Array, goal: Any, truth: GroundTruth) -> Any: ...
    def goal_readings(self, goal: Any) -> tuple[jax.Array, jax.Array]: ...
    def push(self, key: jax.Array, object: ObjectParams) -> jax.Array: ...
    def reward(self, goal: Any, truth: GroundTruth, dropped: jax.Array) -> tuple[jax.Array, dict[str, jax.Array]]: ...
    def dropped(self, goal: Any, truth: GroundTruth) -> jax.Array: ...
    def target_force(self, goal: Any) -> jax.Array: ...
    def evaluation_plan(self, count: int, shape_index: np.ndarray) -> tuple[np.ndarray, Any]: ...
    def summarize(self, metrics: dict[str, np.ndarray], alive: np.ndarray, control_period: float) -> dict: ...
