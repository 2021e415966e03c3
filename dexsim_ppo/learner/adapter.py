"""Environments from elsewhere in the learner's terms: five members are enough.

    training = make_train(adapt(my_env, "mine"), PPOConfig())

`python -m dexsim_ppo.train --task my_module:make_env` does the same with what `make_env()` returns.
"""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
import numpy as np

from dexsim.core.compilation import check_float32
from dexsim.core.config import NoSettings
from dexsim.core.errors import ConfigError
from dexsim.core.pytree import choose, pytree_dataclass
from dexsim_ppo.learner.types import Environment, Field

CONTROL_PERIOD = 0.05
"""Length of a step, s, where an environment does not say; only reports and policies speak of it."""
LONGEST = 1_000_000
"""Largest time limit, steps: an evaluation runs episodes to their end, and keeps the metrics of every step."""


class SimpleEnvironment(Protocol):
    """What an environment must have to be trained: pure functions of one state, an arbitrary pytree.

    It may also have `control_period` (s) and `metrics(state) -> {name: scalar}`, which are logged and reported.
    """

    observation_size: int
    action_size: int
    max_steps: int
    """Time limit of an episode. The learner keeps it: an episode that it cuts is bootstrapped, not terminated."""

    def reset(self, key: jax.Array) -> tuple[jax.Array, Any]:
        """Observation [observation_size] and state of a new episode."""
        ...

    def step(self, key: jax.Array, state: Any, action: jax.Array) -> tuple[jax.Array, Any, jax.Array, jax.Array]:
        """Observation, state, reward [] and whether the episode terminated [] (bool) after an action [action_size] in
        [-1, 1]. No restart, and no time limit."""
        ...


@pytree_dataclass
class AdaptedState:
    """State of an adapted environment; see `types.State`."""

    inner: Any
    obs: dict[str, jax.Array]
    reward: jax.Array
    terminated: jax.Array
    truncated: jax.Array
    metrics: dict[str, jax.Array]
    clock: jax.Array
    """Steps towards the time limit []; `randomize_episode_time` sets it."""
    key: jax.Array


class AdaptedPlan(NamedTuple):
    """Evaluation episodes: a key for each, and its number."""

    key: jax.Array
    row: np.ndarray


class Adapted:
    """A `SimpleEnvironment` as the learner's `Environment`; see `adapt`."""

    backend, evaluation, config = "own", "series", NoSettings()

    def __init__(self, env: SimpleEnvironment, name: str):
        self.name, self._env = name, env
        observation_size, self.action_size, self.evaluation_steps = self._sizes()
        self._check(observation_size, self.action_size)
        period = getattr(env, "control_period", CONTROL_PERIOD)
        if not isinstance(period, int | float) or not 1e-3 <= period <= 1.0:
            raise self._error(f"control_period = {period!r} s: must be a number between 0.001 and 1")
        self.control_period = float(period)
        # One vector for both networks, scaled by its running statistics.
        fields = (Field("observation", observation_size, None),)
        self.observation_layout: Mapping[str, Any] = {"actor": fields, "critic": fields}

    def reset(self, key: jax.Array) -> AdaptedState:
        """A new episode."""
        key, begin = jax.random.split(key)
        observation, inner = self._env.reset(begin)
        zero, no = jnp.float32(0), jnp.bool_(False)
        return AdaptedState(
            inner, self._seen(observation), zero, no, no, self._metrics(inner, zero, zero), jnp.int32(0), key
        )

    def step(self, state: AdaptedState, action: jax.Array) -> AdaptedState:
        """One step; no automatic restart."""
        key, use = jax.random.split(state.key)
        observation, inner, reward, terminated = self._env.step(use, state.inner, action)
        reward, clock = jnp.asarray(reward, jnp.float32), state.clock + 1
        total, length = state.metrics["return"] + reward, state.metrics["length"] + 1.0
        terminated = jnp.asarray(terminated, bool)
        truncated = (clock >= self.evaluation_steps) & ~terminated
        metrics = self._metrics(inner, total, length)
        return AdaptedState(inner, self._seen(observation), reward, terminated, truncated, metrics, clock, key)

    def restart(self, state: AdaptedState, done: jax.Array) -> AdaptedState:
        """A new episode if `done` [], else the same state; the random keys advance either way."""
        key, fresh = jax.random.split(state.key)
        return choose(done, self.reset(fresh), replace(state, key=key))

    def randomize_episode_time(self, state: AdaptedState, key: jax.Array) -> AdaptedState:
        """The episode's clock at a random time."""
        return replace(state, clock=jax.random.randint(key, (), 0, self.evaluation_steps))

    def evaluation_plan(self, count: int, seed: int) -> AdaptedPlan:
        """`count` episodes, each from a key of its own."""
        return AdaptedPlan(jax.random.split(jax.random.key(seed), count), np.arange(count))

    def evaluation_starts(self, plan: AdaptedPlan) -> AdaptedState:
        """The first states of a plan's episodes."""
        return jax.vmap(self.reset)(plan.key)

    def summarize(self, metrics: dict[str, np.ndarray], alive: np.ndarray) -> dict[str, Any]:
        """Means of the environment's own metrics over all live steps (host)."""
        live = max(int(alive.sum()), 1)
        own = [name for name in metrics if name not in ("return", "length")]
        return {"headline": {name: float(metrics[name][alive].sum()) / live for name in own}}

    def snapshot(self, state: AdaptedState) -> dict[str, jax.Array]:
        """Nothing: it is not drawn."""
        del state
        return {}

    def _seen(self, observation: jax.Array) -> dict[str, jax.Array]:
        observation = jnp.asarray(observation, jnp.float32)
        return {"actor": observation, "critic": observation}

    def _metrics(self, inner: Any, total: jax.Array, length: jax.Array) -> dict[str, jax.Array]:
        own = self._env.metrics(inner) if hasattr(self._env, "metrics") else {}
        return {name: jnp.asarray(value, jnp.float32) for name, value in own.items()} | {
            "return": total,
            "length": length,
        }

    def _error(self, text: str) -> ConfigError:
        return ConfigError(f"environment {self.name!r}: {text}")

    def _sizes(self) -> list[int]:
        """Sizes of observation and action, and the time limit. Raises ConfigError: a member is missing or no size."""
        wanted, sizes = ("observation_size", "action_size", "max_steps", "reset", "step"), list[int]()
        if missing := [name for name in wanted if not hasattr(self._env, name)]:
            raise self._error(f"a {type(self._env).__name__} has no {', '.join(missing)}")
        for name in wanted[:3]:
            value = getattr(self._env, name)
            if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < 1:
                raise self._error(f"{name} = {value!r}: must be a whole number of at least 1")
            sizes.append(int(value))
        if sizes[2] > LONGEST:
            raise self._error(f"max_steps = {sizes[2]}: must be at most {LONGEST}, for an evaluation runs that many")
        return sizes

    def _check(self, observation_size: int, action_size: int) -> None:
        """Raises ConfigError: a member gives something of another shape or type."""
        env, key = self._env, jax.random.key(0)
        begun = self._shapes("reset(key)", 2, env.reset, key)
        action = jax.ShapeDtypeStruct((action_size,), jnp.float32)
        after = self._shapes("step(key, state, action)", 4, env.step, key, begun[1], action)
        for call, found in (("reset", begun[0]), ("step", after[0])):
            self._check_array(f"{call}: the observation", found, (observation_size,))
        self._check_array("step: the reward", after[2], ())
        self._check_array("step: what says whether it terminated", after[3], ())
        if np.dtype(after[3].dtype) != np.dtype(bool):
            raise self._error(f"step: what says whether it terminated is {after[3].dtype}, not bool")
        if hasattr(env, "metrics"):
            (own,) = self._shapes("metrics(state)", 1, lambda state: (env.metrics(state),), begun[1])
            if not isinstance(own, dict):
                raise self._error(f"metrics(state) gives {type(own).__name__} where a dict is wanted")
            for name, value in own.items():
                if not isinstance(name, str) or name in ("return", "length"):
                    raise self._error(
                        f"metrics: {name!r} must be a word other than 'return' and 'length', the learner's"
                    )
                self._check_array(f"metrics: {name!r}", value, ())
        # The state is carried through a compiled loop: it must stay what it is.
        old, new = (jax.tree_util.tree_flatten_with_path(state)[0] for state in (begun[1], after[1]))
        structures: list[Any] = [jax.tree.structure(state) for state in (begun[1], after[1])]
        if structures[0] != structures[1]:
            raise self._error("step gives a state of another structure than reset")
        for (path, one), (_, other) in zip(old, new, strict=True):
            if (one.shape, one.dtype) != (other.shape, other.dtype):
                where = jax.tree_util.keystr(path) or "the state"
                raise self._error(f"{where} is {_type(one)} after reset and {_type(other)} after step")

    def _shapes(self, call: str, count: int, function: Any, *arguments: Any) -> tuple[Any, ...]:
        try:
            found = jax.eval_shape(function, *arguments)
        except Exception as error:  # whatever the environment raises
            text = " ".join(str(error).split())
            raise self._error(f"{call} fails: {type(error).__name__}: {text:.200}") from error
        if not isinstance(found, tuple) or len(found) != count:
            raise self._error(f"{call} gives {type(found).__name__} where a tuple of {count} is wanted")
        return found

    def _check_array(self, what: str, found: Any, shape: tuple[int, ...]) -> None:
        if getattr(found, "shape", None) != shape:
            raise self._error(f"{what} has the shape {getattr(found, 'shape', None)}, not {shape}")


def _type(array: Any) -> str:
    return f"{array.dtype}{list(array.shape)}"


def adapt(env: Any, name: str) -> Environment:
    """An environment that the learner can train: `env` itself if it has all that is needed, else round it.

    Args:
      env: an `Environment`, or an object with the members of `SimpleEnvironment`.
      name: of the task, for reports and policies.

    Raises:
      ConfigError: a member is missing, or gives something of another shape or type; or JAX is set to float64.
    """
    check_float32()
    return env if hasattr(env, "observation_layout") else Adapted(env, name)
