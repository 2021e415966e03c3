"""A one-dimensional integrator that follows a target: small enough to know its best return.

x' = x + 0.25 a, reward 1 - |x' - target|. A perfect policy closes a distance d in ceil(d / 0.25) steps, so
from x, target ~ U(-1, 1) its return over 32 steps is 32 - E[sum of remaining distances] = 31.2.
"""

import dataclasses
import functools
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from dexsim.core.config import Config, setting
from dexsim.core.layout import LayoutEntry
from dexsim.core.pytree import pytree_dataclass
from dexsim_ppo.learner.adapter import Adapted
from dexsim_ppo.learner.config import CurriculumConfig, PPOConfig
from dexsim_ppo.learner.ppo import Training
from dexsim_ppo.training import trainer
from dexsim_ppo.training.presets import PRESETS

# Learners: one that solves the task, and one that is quick to compile, as `tiny_train.QUICK` has it.
CONFIG = PPOConfig(
    num_envs=64,
    rollout_length=16,
    minibatches=4,
    epochs=4,
    actor_layers=(32, 32),
    critic_layers=(32, 32),
    discount=0.95,
    iterations_per_call=10,
)
SMALL = dataclasses.replace(
    PRESETS["cpu"].ppo, num_envs=16, rollout_length=8, minibatches=2, epochs=2, actor_layers=(8,), critic_layers=(8,)
)


@dataclass(frozen=True, kw_only=True)
class TinyConfig(Config):
    """Settings of the integrator."""

    horizon: int = setting(32, unit="steps", low=2)
    """Steps until the time limit."""
    gain: float = setting(0.25, unit="m", low=0.01, high=1.0)
    """Distance moved by a full action."""
    wall: float = setting(2.0, unit="m", low=1.5)
    """Distance from the origin at which an episode terminates."""


# The time limit is 6 steps; with full actions the point is beyond a wall within three.
SHORT = TinyConfig(horizon=6, gain=1.0, wall=1.5)


@pytree_dataclass
class TinyState:
    x: jax.Array
    target: jax.Array
    obs: dict[str, jax.Array]
    reward: jax.Array
    terminated: jax.Array
    truncated: jax.Array
    metrics: dict[str, jax.Array]
    key: jax.Array
    scale: jax.Array  # of the next episode's start


class TinyEnv(Adapted):
    """The learner's interface in thirty lines; episodes of an evaluation and their report are those of `Adapted`."""

    name = "tiny"
    action_size = 1
    control_period = 0.1
    evaluation_steps = 32
    observation_layout = {
        group: (LayoutEntry("position", 1, None), LayoutEntry("target", 1, None), LayoutEntry("touch", 1, 2.0))
        for group in ("actor", "critic")
    }

    def __init__(self, config: TinyConfig | None = None, *, backend: str = "mjx"):
        self.config, self.backend = config or TinyConfig(), "mjx" if backend == "auto" else backend

    def reset(self, key: jax.Array, scale: jax.Array | float = 1.0) -> TinyState:
        key, subkey = jax.random.split(key)
        scale, zero, false = jnp.float32(scale), jnp.float32(0), jnp.bool_(False)
        x, target = scale * jax.random.uniform(subkey, (2,), minval=-1.0, maxval=1.0)
        metrics = {"return": zero, "length": zero, "success": zero, "error": zero, "drawn": scale}
        return self._observe(TinyState(x, target, {}, zero, false, false, metrics, key, scale))

    def _observe(self, state: TinyState) -> TinyState:
        obs = jnp.stack([state.x, state.target, jnp.maximum(state.x, 0.0)])
        return dataclasses.replace(state, obs={"actor": obs, "critic": obs})

    def set_randomization_scale(self, state: TinyState, scale: jax.Array) -> TinyState:
        return dataclasses.replace(state, scale=scale)

    def randomize_episode_time(self, state: TinyState, key: jax.Array) -> TinyState:
        clock = jax.random.randint(key, (), 0, self.config.horizon).astype(jnp.float32)
        return dataclasses.replace(state, metrics=state.metrics | {"length": clock})

    def step(self, state: TinyState, action: jax.Array) -> TinyState:
        x = state.x + self.config.gain * action[0]  # Whoever steps it keeps to [-1, 1].
        error = jnp.abs(x - state.target)
        length = state.metrics["length"] + 1
        metrics = {
            "return": state.metrics["return"] + 1 - error,
            "length": length,
            "success": (error < 0.1).astype(jnp.float32),
            "error": error,
            "drawn": state.metrics["drawn"],
        }
        return self._observe(
            dataclasses.replace(
                state,
                x=x,
                reward=1 - error,
                metrics=metrics,
                terminated=jnp.abs(x) > self.config.wall,
                truncated=length >= self.config.horizon,
            )
        )

    def restart(self, state: TinyState, done: jax.Array) -> TinyState:
        return jax.tree.map(lambda new, old: jnp.where(done, new, old), self.reset(state.key, state.scale), state)


def leaves(tree: Any) -> dict[str, np.ndarray]:
    """All numbers of a pytree by path; random keys as their data."""
    is_key = lambda x: jnp.issubdtype(x.dtype, jax.dtypes.prng_key)  # noqa: E731
    named = jax.tree_util.tree_leaves_with_path(tree)
    return {jax.tree_util.keystr(p): np.asarray(jax.random.key_data(x) if is_key(x) else x) for p, x in named}


def assert_same(first: Any, second: Any, rows: Any = slice(None)) -> None:
    """To the last bit, in these rows."""
    ours, theirs = leaves(first), leaves(second)
    assert ours.keys() == theirs.keys()
    for path in ours:
        np.testing.assert_array_equal(ours[path][rows], theirs[path][rows], err_msg=path)


# Runs and tests with the same settings share their environment and its compiled programs.
make_env = functools.cache(lambda env_class, config: env_class(config))
make_train, make_evaluator = functools.cache(trainer.make_train), functools.cache(trainer.Evaluator)


def training_of(config: PPOConfig = SMALL, env_class: type[TinyEnv] = TinyEnv) -> Training:
    """The learner on the environment, compiled once for all tests of a process."""
    return make_train(make_env(env_class, TinyConfig()), config, CurriculumConfig(), None, None)
