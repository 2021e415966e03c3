"""Environments that both learners train: ours as brax has them, brax's as ours, and a pendulum as both."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from brax.envs.base import Env, State

import dexsim
from dexsim.tasks.grasp.config import GraspConfig
from dexsim.wrappers.brax import BraxEnv, wrap
from dexsim_ppo.learner.adapter import SimpleEnvironment, adapt
from dexsim_ppo.learner.types import Environment


class Pendulum:
    """Gym's Pendulum-v1: swing up and hold, torque up to 2 Nm. Never terminates."""

    observation_size, action_size, max_steps = 3, 1, 200

    def reset(self, key: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Angle from upright [rad] and its rate [rad/s], within pi and 1."""
        state = jax.random.uniform(key, (2,), minval=-1.0) * jnp.array([jnp.pi, 1.0])
        return self._observe(state), state

    def step(self, key: jax.Array, state: jax.Array, action: jax.Array) -> tuple[jax.Array, ...]:
        """0.05 s; 10 m/s^2, 1 kg, 1 m."""
        angle, rate = state
        torque = 2.0 * jnp.clip(action[0], -1.0, 1.0)
        off = (angle + jnp.pi) % (2 * jnp.pi) - jnp.pi
        reward = -(off**2 + 0.1 * rate**2 + 0.001 * torque**2)
        rate = jnp.clip(rate + 0.05 * (15.0 * jnp.sin(angle) + 3.0 * torque), -8.0, 8.0)
        state = jnp.stack([angle + 0.05 * rate, rate])
        return self._observe(state), state, reward, jnp.bool_(False)

    def _observe(self, state: jax.Array) -> jax.Array:
        return jnp.stack([jnp.cos(state[0]), jnp.sin(state[0]), state[1]])


class ToBrax(Env):
    """A `SimpleEnvironment` behind brax's interface; the time limit is brax's (`episode_length`)."""

    backend, observation_size, action_size = "jax", 0, 0

    def __init__(self, env: SimpleEnvironment):
        self.env, self.observation_size, self.action_size = env, env.observation_size, env.action_size

    def reset(self, rng: jax.Array) -> State:
        key, begin = jax.random.split(rng)
        observation, inner = self.env.reset(begin)
        return State(inner, observation, jnp.float32(0), jnp.float32(0), {}, {"key": key})

    def step(self, state: State, action: jax.Array) -> State:
        key, use = jax.random.split(state.info["key"])
        observation, inner, reward, terminated = self.env.step(use, state.pipeline_state, action)
        return state.replace(
            pipeline_state=inner,
            obs=observation,
            reward=reward,
            done=terminated.astype(jnp.float32),
            info=state.info | {"key": key},
        )


class FromBrax:
    """A brax environment as a `SimpleEnvironment`."""

    max_steps = 1000

    def __init__(self, env: Env):
        self.env, self.observation_size, self.action_size = env, int(env.observation_size), int(env.action_size)

    def reset(self, key: jax.Array) -> tuple[jax.Array, State]:
        state = self.env.reset(jax.random.key_data(key))
        return state.obs, state

    def step(self, key: jax.Array, state: State, action: jax.Array) -> tuple[jax.Array, State, jax.Array, jax.Array]:
        state = self.env.step(state, action)
        return state.obs, state, state.reward, state.done.astype(bool)


class Contest(NamedTuple):
    """One environment as either learner has it."""

    ours: Environment
    brax: Env
    brax_options: dict[str, Any]
    """What brax's PPO needs of this environment besides sizes."""
    discount: float


def make(name: str, brax_backend: str, num_envs: int) -> Contest:
    """The environment called "pendulum" or "grasp", or one of brax's."""
    if name == "grasp":
        env = dexsim.make("grasp", GraspConfig(), num_envs=num_envs)
        options = {"wrap_env_fn": wrap, "episode_length": env.task.evaluation_ticks, "reward_scaling": 0.1}
        return Contest(env, BraxEnv(env), options, 0.99)
    if name == "pendulum":
        simple: Any = Pendulum()
        return Contest(adapt(simple, name), ToBrax(simple), {"episode_length": 200, "reward_scaling": 0.1}, 0.95)
    from brax import envs

    env = envs.get_environment(name, backend=brax_backend)
    return Contest(adapt(FromBrax(env), name), env, {"episode_length": FromBrax.max_steps}, 0.99)
