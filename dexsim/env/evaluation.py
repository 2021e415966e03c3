"""What an evaluation runs: its episodes, each from a start state that training never had; and pictures of them.

The pool of start states that an environment is made with belongs to training. An evaluation draws its own, by its
own seed, and gives every episode a row and a random key of its own: what is measured does not depend on how many
episodes run side by side, and episodes are independent.
"""

import itertools
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np

from dexsim.core.pytree import pytree_dataclass
from dexsim.env.env import Env
from dexsim.env.state import Start, State
from dexsim.geometry import rotations
from dexsim.render.snapshot import Snapshot

jax.tree_util.register_dataclass(Snapshot)

_POOL, _EPISODES = 0xE7A1, 0xE7A2  # streams of an evaluation's seed; training's pool has the seed's own key


@pytree_dataclass
class EvaluationPlan:
    """The episodes of an evaluation, [N, ...] each."""

    key: jax.Array  # [N] of physical properties, hand, sensors, noise and pushes
    row: np.ndarray  # [N] of the evaluation's pool; episodes with the same one are not independent
    start: Start
    goal: Any  # the task's own pytree


class Evaluation:
    """The evaluation protocol of an environment's task: what `evaluate_policy` asks of an environment."""

    def __init__(self, env: Env):
        self.env, self.name = env, env.name
        self.evaluation, self.evaluation_steps = env.task.evaluation, env.task.evaluation_ticks

    def evaluation_plan(self, count: int, seed: int) -> EvaluationPlan:
        """The fixed protocol for `count` episodes, from a pool of start states of this evaluation's own, with rows
        enough for them (host). Raises ConfigError: see `Task.make_pool`."""
        task, key = self.env.task, jax.random.key(seed)
        pool_key, pool = jax.random.fold_in(key, _POOL), cast(Any, None)
        for part in itertools.count():
            rows: Any = jax.tree.map(np.asarray, task.make_pool(jax.random.fold_in(pool_key, part)))
            pool = rows if pool is None else jax.tree.map(lambda *parts: np.concatenate(parts), pool, rows)
            row, goal = task.evaluation_plan(count, pool.object.shape_index)
            # A plan that repeats rows of a pool twice as large means to.
            if len(np.unique(row)) == count or len(pool.qpos) >= 2 * count:
                break
        keys = jax.random.split(jax.random.fold_in(key, _EPISODES), count)
        return EvaluationPlan(keys, np.asarray(row), jax.tree.map(lambda rows: rows[np.asarray(row)], pool), goal)

    def evaluation_starts(self, plan: EvaluationPlan) -> State:
        """[N] start states of a plan, or of a slice of one."""
        return jax.vmap(self.env.reset_from)(plan.key, plan.start, plan.goal)

    def summarize(self, metrics: dict[str, np.ndarray], alive: np.ndarray) -> dict:
        """The task's report of an evaluation (host); see `Task.summarize`."""
        return self.env.task.summarize(metrics, alive, self.env.control_period)

    def snapshot(self, state: State) -> Snapshot:
        """What a frame of video shows."""
        return take_snapshot(self.env, state)


def evaluation_of(env: Any) -> Any:
    """`Evaluation` of an `Env`; an environment of another kind brings these members itself."""
    return Evaluation(env) if isinstance(env, Env) else env


def take_snapshot(env: Env, state: State) -> Snapshot:
    """What a frame of video shows of one environment's state."""
    place, shape = state.physics.qpos[env.physics.object_qpos], state.episode.object.shape()
    turning = env.task.turn is not None
    return Snapshot(
        joint_position=state.physics.qpos[env.physics.joint_qpos],
        object_position=place[:3],
        object_rotation=rotations.quat_to_matrix(place[3:]),
        primitive_size=shape.size,
        primitive_position=shape.position,
        primitive_rotation=shape.rotation,
        primitive_active=shape.active,
        taxel_force=state.readings.taxel_force,
        command=state.readings.command,
        target_force=env.task.target_force(state.goal),
        finger_force=state.finger_force,
        goal_rotation=rotations.quat_to_matrix(state.readings.goal_quat) if turning else None,
        turns=env.task.turns(state.goal),
        seconds=state.length.astype(jnp.float32) * env.control_period,
    )
