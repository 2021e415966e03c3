"""What the learner requires of an environment, and what it carries from one iteration to the next."""

from typing import Any, Protocol

import jax

from dexsim.core.layout import LayoutEntry
from dexsim.core.pytree import pytree_dataclass
from dexsim_ppo.learner.networks import GRU, MLP, Params
from dexsim_ppo.learner.running_stats import RunningStats


class Environment(Protocol):
    """Pure functions of one environment's state; callers add batch axes with `jax.vmap`. It is a pytree with

      obs: `"actor"` [n] and `"critic"` [m]; after `step` and before `restart` the true final observation.
      reward: [].
      terminated: bool [], the episode reached a terminal state. Takes precedence over `truncated`.
      truncated: bool [], the time limit cut the episode; its value is bootstrapped.
      metrics: scalars of this step by name; `"return"` and `"length"` are sums over the episode so far.

    A curriculum also needs `reset(key, scale)` and `set_randomization_scale(state, scale)`, with the width [] of the
    randomisation ranges in [0, 1].
    """

    name: str  # of the task
    backend: str  # of the physics; "own" for an environment from elsewhere
    config: Any  # of the task
    action_size: int  # A
    observation_layout: dict[str, tuple[LayoutEntry, ...]]  # of the `"actor"` and `"critic"` observations
    control_period: float  # s, length of one control tick

    def reset(self, key: jax.Array) -> Any:
        """A new episode."""

    def step(self, state: Any, action: jax.Array) -> Any:
        """Advance by one control tick; no automatic restart. The learner clips actions [A] to [-1, 1]."""

    def restart(self, state: Any, done: jax.Array) -> Any:
        """A new episode if `done` [], else the same state; the random keys advance either way.

        The learner calls it every 16 steps at least: episodes that end sooner begin several times from one start.
        """

    def randomize_episode_time(self, state: Any, key: jax.Array) -> Any:
        """Set the episode clock to a random time, so that a batch does not truncate all at once."""


@pytree_dataclass
class AdamState:
    """Running moments of the gradient, shaped like the parameters (Adam, Kingma and Ba 2015)."""

    count: jax.Array  # int32 []
    mean: Params
    variance: Params


@pytree_dataclass
class TrainState:
    """All that training carries from one iteration to the next."""

    params: Params
    average: tuple[MLP, GRU | None]  # of actor and memory over the last iterations: what a policy is made of
    adam: AdamState
    learning_rate: jax.Array  # []
    observation_stats: dict[str, RunningStats]
    value_stats: RunningStats  # of returns []
    env_state: Any  # [B, ...]
    key: jax.Array
    iteration: jax.Array  # int32 []
    skipped_updates: jax.Array  # int32 [], minibatches whose gradient was not finite
    scale: jax.Array | None = None  # [] width of the randomisation ranges, with a curriculum
    carry: jax.Array | None = None  # [B, m] of the policy's memory
