"""What one faulty environment may do to the learner, and what the learner promises to environments."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tiny_env import SMALL, TinyEnv

from dexsim_ppo.acting import PolicyParams, act
from dexsim_ppo.learner import ppo
from dexsim_ppo.learner.ppo import make_train
from dexsim_ppo.learner.rollout import Rollout, bound_rewards
from dexsim_ppo.learner.running_stats import RunningStats

NEVER = 1e9
ROWS = dataclasses.replace(SMALL, num_envs=64, rollout_length=16)  # 1,024 rows an iteration


def experience(reward):
    zero, flag = jnp.zeros_like(reward), jnp.zeros(reward.shape, bool)
    return Rollout(obs={}, decision=None, value=zero, next_value=zero, reward=reward, terminated=flag, truncated=flag)


@pytest.mark.parametrize("count", [0, 5])
def test_healthy_rewards_stay_to_the_last_bit(count):
    """Also constant ones, none at all, and a bonus of fifty deviations."""
    stats = RunningStats(jnp.int32(count), jnp.float32(0.0), jnp.float32(25.0))
    for reward in (
        jax.random.normal(jax.random.key(0), (16, 64)),
        jnp.full((16, 64), 0.3),
        jnp.zeros((16, 64)),
        jax.random.normal(jax.random.key(1), (16, 64)).at[3, 4].set(250.0),
    ):
        same, counted = bound_rewards(experience(reward), stats, 1.0)
        np.testing.assert_array_equal(same.reward, reward)
        assert float(counted) == 0


def test_rewards_that_grow_are_followed():
    """A sparse reward after long silence: bounded at first, whole after some iterations."""
    stats = RunningStats(jnp.int32(10_000), jnp.float32(0.0), jnp.float32(0.0))
    reward = jnp.zeros((16, 64)).at[3, 4].set(250.0)
    config = dataclasses.replace(ROWS, normalize_value=True)
    params = make_train(TinyEnv(), config).init(jax.random.key(0)).params

    @jax.jit
    def iterate(stats):
        rollout, counted = bound_rewards(experience(reward), stats, 1.0)
        return ppo.prepare(config, stats, {}, params, rollout).value_stats, rollout, counted

    for _ in range(40):
        stats, rollout, counted = iterate(stats)
    assert float(counted) == 0 and float(rollout.reward.max()) == 250


class Unclipped(TinyEnv):
    """Trusts that actions are in [-1, 1], and remembers the largest."""

    def step(self, state, action):
        after = super().step(state, action)
        return dataclasses.replace(after, metrics=after.metrics | {"error": jnp.max(jnp.abs(action))})


@pytest.mark.slow
@pytest.mark.parametrize("distribution", ["gaussian", "tanh"])
def test_actions_are_in_range_in_training_as_from_a_policy(distribution):
    """A task's reward or its `last_action` sees the same range from the learner and from `act`."""
    config = dataclasses.replace(SMALL, distribution=distribution, initial_std=5.0, std_max=10.0)
    training = make_train(Unclipped(), config)
    state, metrics = training.step(training.init(jax.random.key(0)))
    assert 0.7 < float(metrics["step/error"][0]) <= 1.0
    normalizers = ppo.make_normalizers(Unclipped(), config, state.observation_stats)
    layers = jax.tree.map(lambda x: 1e3 * x, state.params.actor)
    obs = 10 * jax.random.normal(jax.random.key(1), (50, 3))
    assert float(jnp.abs(act(PolicyParams(layers, normalizers["actor"], distribution), None, obs)[1]).max()) == 1.0


class Short(TinyEnv):
    """Ends every episode after four steps."""

    def step(self, state, action):
        state = super().step(state, action)
        return dataclasses.replace(state, truncated=state.metrics["length"] >= 4)

    def randomize_episode_time(self, state, key):
        return state


def test_starts_that_are_used_again_are_counted():
    """Sixteen steps from one reserve: four episodes end, and all but the first begin from a used start."""
    for env, repeated in ((Short(), 3), (TinyEnv(), 0)):
        training = make_train(env, ROWS)
        _, metrics = training.step(training.init(jax.random.key(0)))
        assert float(metrics["repeated_starts"][0]) == repeated * ROWS.num_envs
