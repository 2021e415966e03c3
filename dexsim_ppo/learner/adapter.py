"""Environments from elsewhere in the learner's terms: five members are enough.

    training = make_train(my_env, PPOConfig())

`python -m dexsim_ppo.train --task my_module:make_env` does the same with what `make_env()` returns. The members are
sizes, and pure functions of one state, an arbitrary pytree:

    observation_size, action_size, max_steps: int
    reset(key) -> (observation [observation_size], state)   of a new episode
    step(key, state, action) -> (observation, state, reward [], terminated [] bool)

Actions [action_size] are in [-1, 1]. Steps restart nothing and know no time limit: `max_steps` is kept by the learner,
and an episode that it cuts is bootstrapped, not terminated. An environment may also have `control_period` (s) and
`metrics(state) -> {name: scalar}`, which are logged and reported.
"""

from dataclasses import replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from dexsim.core.config import NoSettings
from dexsim.core.layout import LayoutEntry
from dexsim.core.pytree import choose, pytree_dataclass
from dexsim.errors import ConfigError
from dexsim_ppo.learner.types import Environment

MEMBERS = ("observation_size", "action_size", "max_steps", "reset", "step")


@pytree_dataclass
class AdaptedState:
    """State of an adapted environment; see `types.Environment`."""

    inner: Any
    obs: dict[str, jax.Array]
    reward: jax.Array
    terminated: jax.Array
    truncated: jax.Array
    metrics: dict[str, jax.Array]
    clock: jax.Array  # [] steps towards the time limit; `randomize_episode_time` sets it
    key: jax.Array


class Plan(NamedTuple):
    """Evaluation episodes: a key for each, and its number."""

    key: jax.Array
    row: np.ndarray


class Adapted:
    """An environment of five members as the learner's `Environment`, with the members of an evaluation; see `adapt`."""

    backend, evaluation, config = "own", "series", NoSettings()

    def __init__(self, env: Any, name: str):
        if missing := [member for member in MEMBERS if not hasattr(env, member)]:
            raise ConfigError(f"environment {name!r}: a {type(env).__name__} has no {', '.join(missing)}")
        self.name, self._env = name, env
        self.action_size, self.evaluation_steps = int(env.action_size), int(env.max_steps)
        self.control_period = float(getattr(env, "control_period", 0.05))  # only reports and policies speak of it
        # One vector for both networks, scaled by its running statistics.
        layout = (LayoutEntry("observation", int(env.observation_size)),)
        self.observation_layout: dict[str, tuple[LayoutEntry, ...]] = {"actor": layout, "critic": layout}

    def reset(self, key: jax.Array) -> AdaptedState:
        """A new episode."""
        key, begin = jax.random.split(key)
        observation, inner = self._env.reset(begin)
        zero, no = jnp.float32(0), jnp.bool_(False)
        metrics = self._metrics(inner, zero, zero)
        return AdaptedState(inner, self._observe(observation), zero, no, no, metrics, jnp.int32(0), key)

    def step(self, state: AdaptedState, action: jax.Array) -> AdaptedState:
        """One step; no automatic restart."""
        key, use = jax.random.split(state.key)
        observation, inner, reward, terminated = self._env.step(use, state.inner, action)
        reward, clock = jnp.asarray(reward, jnp.float32), state.clock + 1
        total, length = state.metrics["return"] + reward, state.metrics["length"] + 1.0
        terminated = jnp.asarray(terminated, bool)
        truncated = (clock >= self.evaluation_steps) & ~terminated
        metrics = self._metrics(inner, total, length)
        return AdaptedState(inner, self._observe(observation), reward, terminated, truncated, metrics, clock, key)

    def restart(self, state: AdaptedState, done: jax.Array) -> AdaptedState:
        """A new episode if `done` [], else the same state; the random keys advance either way."""
        key, fresh = jax.random.split(state.key)
        return choose(done, self.reset(fresh), replace(state, key=key))

    def randomize_episode_time(self, state: AdaptedState, key: jax.Array) -> AdaptedState:
        """The episode's clock at a random time."""
        return replace(state, clock=jax.random.randint(key, (), 0, self.evaluation_steps))

    def evaluation_plan(self, count: int, seed: int) -> Plan:
        """`count` episodes, each from a key of its own."""
        return Plan(jax.random.split(jax.random.key(seed), count), np.arange(count))

    def evaluation_starts(self, plan: Plan) -> AdaptedState:
        """The first states of a plan's episodes."""
        return jax.vmap(self.reset)(plan.key)

    def summarize(self, metrics: dict[str, np.ndarray], alive: np.ndarray) -> dict[str, Any]:
        """Means of the environment's own metrics over all live steps (host)."""
        live = max(int(alive.sum()), 1)
        own = [name for name in metrics if name not in ("return", "length")]
        return {"headline": {name: float(metrics[name][alive].sum()) / live for name in own}}

    def snapshot(self, state: AdaptedState) -> dict[str, jax.Array]:
        """Nothing: it is not drawn."""
        return {}

    def _observe(self, observation: jax.Array) -> dict[str, jax.Array]:
        observation = jnp.asarray(observation, jnp.float32)
        return {"actor": observation, "critic": observation}

    def _metrics(self, inner: Any, total: jax.Array, length: jax.Array) -> dict[str, jax.Array]:
        own = self._env.metrics(inner) if hasattr(self._env, "metrics") else {}
        own = {name: jnp.asarray(value, jnp.float32) for name, value in own.items()}
        return own | {"return": total, "length": length}


def adapt(env: Any, name: str = "") -> Environment:
    """`env` itself if it is an `Environment`, else a wrapper of its five members, whose name is that of its class by
    default. Raises ConfigError: a member is missing."""
    return env if hasattr(env, "observation_layout") else Adapted(env, name or type(env).__name__)
