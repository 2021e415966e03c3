"""What the learner and its tools require of an environment."""

from collections.abc import Mapping, Sequence
from typing import Any, Protocol

import jax
import numpy as np

from dexsim.core.layout import LayoutEntry


class State(Protocol):
    """State of one environment: a pytree. Callers add batch axes with `jax.vmap`."""

    obs: Mapping[str, jax.Array]
    """`"actor"` [n] and `"critic"` [m]. After `step` and before `restart` it is the true final observation."""
    reward: jax.Array
    terminated: jax.Array
    """bool []: the episode reached a terminal state. Takes precedence over `truncated`."""
    truncated: jax.Array
    """bool []: the time limit cut the episode; its value is bootstrapped."""
    metrics: Mapping[str, jax.Array]
    """Scalars of this step; `"return"` and `"length"` are sums over the episode so far."""


class Environment(Protocol):
    """Pure functions of one environment's state."""

    @property
    def name(self) -> str:
        """The task's name."""
        ...

    @property
    def backend(self) -> str:
        """The physics backend; "own" for an environment from elsewhere."""
        ...

    @property
    def config(self) -> Any:
        """The task's configuration."""
        ...

    @property
    def action_size(self) -> int:
        """Length of the action (A)."""
        ...

    @property
    def observation_layout(self) -> Mapping[str, Sequence[LayoutEntry]]:
        """Layout of the `"actor"` and `"critic"` observations."""
        ...

    @property
    def control_period(self) -> float:
        """Length of one control tick, s."""
        ...

    def reset(self, key: jax.Array) -> Any:
        """A new episode."""
        ...

    def step(self, state: Any, action: jax.Array) -> Any:
        """Advance by one control tick; no automatic restart.

        An action [A] is in [-1, 1]: learner and `Policy` clip or squash what they give, whatever the environment does.
        """
        ...

    def restart(self, state: Any, done: jax.Array) -> Any:
        """A new episode if `done` [], else the same state; the random keys advance either way.

        The learner calls it every 16 steps at least: episodes that end sooner begin several times from one start.
        """
        ...

    def randomize_episode_time(self, state: Any, key: jax.Array) -> Any:
        """Set the episode clock to a random time, so that a batch does not truncate all at once."""
        ...


class Evaluated(Protocol):
    """What an evaluation needs on top of an environment; see `dexsim.env.evaluation.evaluation_of`."""

    @property
    def name(self) -> str:
        """The task's name."""
        ...

    @property
    def evaluation_steps(self) -> int:
        """Length of an evaluation episode, control ticks."""
        ...

    @property
    def evaluation(self) -> str:
        """What `summarize` takes: "series" over all ticks, or "totals" that the task accumulates."""
        ...

    def evaluation_plan(self, count: int, seed: int) -> Any:
        """The task's evaluation episodes: a pytree of [count, ...] arrays (host).

        Its attribute `row` [count] is the same for episodes that begin from the same start, and so are not independent.
        """
        ...

    def evaluation_starts(self, plan: Any) -> Any:
        """States [N] at which the episodes of a plan, or of a slice of one, start."""
        ...

    def summarize(self, metrics: dict[str, np.ndarray], alive: np.ndarray) -> dict[str, Any]:
        """The task's report, from metrics [T, N] and the mask [T, N] of live ticks; with "totals", from the
        metrics [N] of each episode's last tick and its length [N] in ticks."""
        ...

    def snapshot(self, state: Any) -> Any:
        """What one video frame shows."""
        ...


class CurriculumEnvironment(Environment, Protocol):
    """An environment whose randomisation ranges have a scale [] in [0, 1]."""

    def reset(self, key: jax.Array, scale: jax.Array | None = None) -> Any:
        """A new episode, from ranges of this scale."""
        ...

    def set_randomization_scale(self, state: Any, scale: jax.Array) -> Any:
        """Take the next episodes from ranges of this scale."""
        ...
