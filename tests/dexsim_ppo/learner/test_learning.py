"""PPO end to end on the tiny environment."""

import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tiny_env import CONFIG, SMALL, TinyEnv, training_of

from dexsim.core.pytree import choose
from dexsim_ppo.learner import ppo
from dexsim_ppo.learner.loss import critic_value
from dexsim_ppo.learner.rollout import scan_restarting
from dexsim_ppo.policy import Policy


def test_reaches_the_known_return():
    """29 of the best possible 31.2 with exploration on."""
    training = training_of(CONFIG)
    state = training.init(jax.random.key(0))
    returns = []
    for _ in range(8):
        state, metrics = training.step(state)
        returns.append(float(jnp.nanmean(metrics["episode/return"])))
    assert returns[-1] > 29.0 and returns[0] < 25.0, returns
    assert int(state.skipped_updates) == 0
    assert int(state.iteration) == 80


def test_the_average_is_over_about_the_last_tenth():
    """Weights of iteration i count as binomial(i + 9, 9), which grows like i^9; a policy is made of them."""
    training = training_of()
    state = training.init(jax.random.key(0))
    kernels = []
    for _ in range(12):
        state, _ = training.step(state)
        kernels.append(np.asarray(state.params.actor[0].kernel))
    weights = [math.comb(i + 9, 9) for i in range(12)]
    expected = np.average(kernels, axis=0, weights=weights)
    np.testing.assert_allclose(state.average[0][0].kernel, expected, rtol=1e-4, atol=1e-6)
    policy = Policy.from_training(TinyEnv(), SMALL, state)
    np.testing.assert_array_equal(policy.params.layers[0].kernel, state.average[0][0].kernel)


class BadRewards(TinyEnv):
    """Diverges: its reward and final observation are not finite, and it says so by terminating."""

    def step(self, state, action):
        state = super().step(state, action)
        diverged = state.metrics["length"] % 5 == 0
        poison = lambda x: jnp.where(diverged, jnp.nan, x)  # noqa: E731
        metrics = state.metrics | {"error": poison(state.metrics["error"])}
        return dataclasses.replace(
            state,
            reward=poison(state.reward),
            obs=jax.tree.map(poison, state.obs),
            metrics=metrics,
            terminated=diverged,
        )


class Keyed(TinyEnv):
    """As `dexsim.Env` does it: whoever is asked to restart moves the key on, also where nothing is done."""

    def restart(self, state, done):
        key, fresh_key = jax.random.split(state.key)
        return choose(done, self._start(fresh_key), dataclasses.replace(state, key=key))


@pytest.mark.parametrize("length, block", [(7, 7), (40, 10)])
def test_restarts_what_ended_and_nothing_else(length, block, share=0.15):
    """Against a loop over environments and steps: who ended goes on from the start drawn for it last."""
    env, count = Keyed(), 5
    restart = jax.jit(env.restart)
    states = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(length), count))
    ends = np.random.default_rng(length).random((length, count)) < share

    def step(state, given):
        number, ended = given
        after = dataclasses.replace(
            state,
            x=state.x + number.astype(state.x.dtype),
            terminated=ended & (number % 2 == 0),
            truncated=ended & (number % 2 == 1),
        )
        return after, after.terminated | after.truncated, (state.x, after.x)

    numbers = jnp.arange(length)
    last, (before, after) = jax.jit(lambda *given: scan_restarting(jax.vmap(env.restart), step, *given))(
        states, (numbers, jnp.asarray(ends))
    )
    for row in range(count):
        state = jax.tree.map(lambda x, row=row: x[row], states)
        for tick in range(length):
            if tick % block == 0:
                fresh, state = (restart(state, jnp.bool_(done)) for done in (True, False))
            assert float(before[tick, row]) == float(state.x)
            state = fresh if ends[tick, row] else dataclasses.replace(state, x=state.x + tick)
            if not ends[tick, row]:
                assert float(after[tick, row]) == float(state.x)
        assert float(last.x[row]) == float(state.x)
        np.testing.assert_array_equal(jax.random.key_data(last.key[row]), jax.random.key_data(state.key))


def test_metrics_are_those_of_a_plain_loop_and_a_diverging_world_poisons_nothing():
    """Means over all steps, and over the last steps of episodes; what is not finite is left out and counted."""
    env, count, config = BadRewards(), SMALL.num_envs, SMALL
    state = training_of().init(jax.random.key(3))
    lengths = jnp.arange(count, dtype=jnp.float32) * 2.0
    begin = dataclasses.replace(state.env_state, metrics=state.env_state.metrics | {"length": lengths})
    state = dataclasses.replace(state, env_state=begin)

    @jax.jit
    def collect(state):
        _, rollout, metrics = ppo.collect_rollout(env, config, state)
        batch = ppo.prepare(config, state, rollout)
        normalizers = ppo.make_normalizers(env, config, state.observation_stats)
        return rollout, metrics, batch, critic_value(config, state.params, normalizers, rollout.obs)

    rollout, metrics, learnt_from, value = collect(state)
    fresh, now = (jax.vmap(env.restart)(begin, jnp.full(count, done)) for done in (True, False))
    step, seen = jax.jit(jax.vmap(env.step)), []
    for action in rollout.decision.action:
        now = step(now, jnp.clip(action, -1, 1))
        over = now.terminated | now.truncated
        seen.append((now.reward, now.metrics["error"], now.metrics["length"], over))
        now = jax.vmap(choose)(over, fresh, now)
    reward, error, length, over = (np.array(column) for column in zip(*seen, strict=True))
    broken = ~np.isfinite(reward)
    reward, error = (np.where(np.isfinite(x), x, 0.0) for x in (reward, error))
    assert over.sum() > 3 and broken.sum() > 3, "the test tests less than it says"
    assert float(metrics["episodes"]) == over.sum() and float(metrics["nonfinite_rewards"]) == broken.sum()
    np.testing.assert_allclose(metrics["step/error"], error.mean(), rtol=1e-4)
    np.testing.assert_allclose(metrics["episode/length"], length[over].mean(), rtol=1e-5)
    np.testing.assert_allclose(metrics["reward"], reward.mean(), rtol=1e-4)
    np.testing.assert_allclose(rollout.reward, reward, rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(rollout.value, value, rtol=1e-4, atol=1e-5)  # while there are no returns
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(learnt_from))
