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
from dexsim_ppo.learner.adapter import Plan
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


class TinyEnv:
    """The environment interface in forty lines."""

    name = "tiny"
    action_size = 1
    control_period = 0.1
    evaluation_steps = 32
    evaluation = "series"
    observation_layout = {
        group: (LayoutEntry("position", 1, None), LayoutEntry("target", 1, None), LayoutEntry("touch", 1, 2.0))
        for group in ("actor", "critic")
    }

    def __init__(self, config: TinyConfig | None = None, *, backend: str = "mjx"):
        self.config, self.backend = config or TinyConfig(), "mjx" if backend == "auto" else backend

    def _start(self, key: jax.Array, scale: jax.Array | float = 1.0) -> TinyState:
        key, subkey = jax.random.split(key)
        scale, zero, false = jnp.float32(scale), jnp.float32(0), jnp.bool_(False)
        x, target = scale * jax.random.uniform(subkey, (2,), minval=-1.0, maxval=1.0)
        metrics = {"return": zero, "length": zero, "success": zero, "error": zero, "drawn": scale}
        return self._observe(TinyState(x, target, {}, zero, false, false, metrics, key, scale))

    def _observe(self, state: TinyState) -> TinyState:
        obs = jnp.stack([state.x, state.target, jnp.maximum(state.x, 0.0)])
        return dataclasses.replace(state, obs={"actor": obs, "critic": obs})

    def reset(self, key: jax.Array, scale: jax.Array | float = 1.0) -> TinyState:
        return self._start(key, scale)

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
        return jax.tree.map(lambda new, old: jnp.where(done, new, old), self._start(state.key, state.scale), state)

    def evaluation_plan(self, count: int, seed: int) -> Plan:
        return Plan(jax.random.split(jax.random.key(seed), count), np.arange(count))

    def evaluation_starts(self, plan: Plan) -> TinyState:
        return jax.vmap(self._start)(plan.key)

    def summarize(self, metrics: dict[str, np.ndarray], alive: np.ndarray) -> dict[str, Any]:
        error = float(metrics["error"][alive].mean())
        return {"error": error, "headline": {"error": error}}

    def snapshot(self, state: TinyState) -> dict[str, jax.Array]:
        return {"x": state.x}


# Runs and tests with the same settings share their environment and its compiled programs.
make_env = functools.cache(lambda env_class, config: env_class(config))
make_train, make_evaluator = functools.cache(trainer.make_train), functools.cache(trainer.Evaluator)


def training_of(config: PPOConfig = SMALL, env_class: type[TinyEnv] = TinyEnv) -> Training:
    """The learner on the environment, compiled once for all tests of a process."""
    return make_train(make_env(env_class, TinyConfig()), config, CurriculumConfig(), None, None)
