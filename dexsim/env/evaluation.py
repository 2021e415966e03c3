"""What an evaluation runs: its episodes, each from a start state that training never had.

The pool of start states that an environment is made with belongs to training. An evaluation draws its own, by its
own seed, and gives every episode a row and a random key of its own: what is measured does not depend on how many
episodes run side by side, and episodes are independent.
"""

from __future__ import annotations

import itertools
from typing import Any

import jax
import numpy as np

from dexsim.core.pytree import pytree_dataclass
from dexsim.env.env import Env
from dexsim.env.snapshot import take_snapshot
from dexsim.env.state import Start, State
from dexsim.env.task import Task
from dexsim.render.snapshot import Snapshot

_POOL, _EPISODES = 0xE7A1, 0xE7A2  # streams of an evaluation's seed; training's pool has the seed's own key


@pytree_dataclass
class EvaluationPlan:
    """The episodes of an evaluation, [N, ...] each."""

    key: jax.Array  # [N] of bulk, hand, sensors, noise and pushes
    row: np.ndarray  # [N] of the evaluation's pool; episodes with the same one are not independent
    start: Start
    goal: Any  # the task's own pytree


class Evaluation:
    """The evaluation protocol of an environment's task."""

    def __init__(self, env: Env):
        self.env, self.name = env, env.name
        self.evaluation = env.task.evaluation
        """What `summarize` is given: "series" or "totals"."""
        self.evaluation_steps = env.task.evaluation_ticks
        """Length of an evaluation episode, ticks."""

    def evaluation_plan(self, count: int, seed: int) -> EvaluationPlan:
        """The fixed protocol for `count` episodes, from a pool of start states of this evaluation's own."""
        return make_plan(self.env.task, count, seed)

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


def make_plan(task: Task, count: int, seed: int) -> EvaluationPlan:
    """The plan of `count` episodes (host).

    Raises:
      ConfigError: see `Task.make_pool`.
    """
    key = jax.random.key(seed)
    pool, row, goal = _pool_and_plan(task, count, jax.random.fold_in(key, _POOL))
    return EvaluationPlan(
        key=jax.random.split(jax.random.fold_in(key, _EPISODES), count),
        row=row,
        start=jax.tree.map(lambda rows: rows[row], pool),
        goal=goal,
    )


def _pool_and_plan(task: Task, count: int, key: jax.Array) -> tuple[Start, np.ndarray, Any]:
    """A pool with rows enough for `count` episodes, the row [count] of each, and the goals."""
    pool: Any = None
    for part in itertools.count():
        more = jax.tree.map(np.asarray, task.make_pool(jax.random.fold_in(key, part)))
        pool = more if pool is None else jax.tree.map(lambda *parts: np.concatenate(parts), pool, more)
        row, goal = task.evaluation_plan(count, pool.object.shape_index)
        row = np.asarray(row)
        # A plan that repeats rows of a pool twice as large means to.
        if len(np.unique(row)) == count or len(pool.qpos) >= 2 * count:
            return pool, row, goal
    raise AssertionError("unreachable")
