"""PPO end to end on the tiny environment."""

import dataclasses
import functools
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tiny_env import CONFIG, SMALL, TinyConfig, TinyEnv, training_of

from dexsim.core.pytree import choose
from dexsim_ppo.learner import ppo
from dexsim_ppo.learner.loss import critic_value
from dexsim_ppo.policy import Policy
from dexsim_ppo.training.arguments import fine_tuning_config
from dexsim_ppo.training.trainer import initialize_from


@pytest.fixture(scope="module")
def trained():
    """The state after 150 iterations, and the mean return of each ten."""
    training = training_of(CONFIG)
    state, returns = training.init(jax.random.key(0)), []
    for _ in range(15):
        state, metrics = training.step(state)
        returns.append(float(jnp.nanmean(metrics["episode/return"])))
    return state, returns


def test_reaches_the_known_return(trained):
    """29 of the best possible 31.2 after 80 iterations, with exploration on."""
    state, returns = trained
    assert returns[7] > 29.0 and returns[0] < 25.0, returns
    assert int(state.skipped_updates) == 0
    assert int(state.iteration) == 150


def test_a_good_policy_is_not_worse_in_another_world(trained):
    """The return falls when the critic learns at the policy's small rate: the policy climbs its errors. Observations
    keep their normalisation, which many steps of a GPU would change wholly."""
    policy = Policy.from_training(TinyEnv(), trained[0])
    config = dataclasses.replace(fine_tuning_config(policy, CONFIG), discount=0.99, critic_first=50)
    start = functools.partial(initialize_from, policy)
    training = ppo.make_train(TinyEnv(TinyConfig(gain=0.1, horizon=64)), config, start=start)
    state, returns = training.init(jax.random.key(1)), []
    for _ in range(25):
        state, metrics = training.step(state)
        returns.append(np.nanmean(metrics["episode/return"]))
    assert np.mean(returns[-5:]) > np.mean(returns[:5]) - 0.5
    new = Policy.from_training(TinyEnv(), state).params.normalizer
    np.testing.assert_array_equal(new.mean, policy.params.normalizer.mean)
    np.testing.assert_allclose(new.std, policy.params.normalizer.std, rtol=1e-6)


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
    policy = Policy.from_training(TinyEnv(), state)
    np.testing.assert_array_equal(policy.params.layers[0].kernel, state.average[0][0].kernel)


class BadRewards(TinyEnv):
    """Diverges on one side: its reward and final observation are not finite, and it says so by terminating. As with
    `dexsim.Env` keys advance at every restart, also where nothing is done."""

    def restart(self, state, done):
        key, fresh_key = jax.random.split(state.key)
        return choose(done, self.reset(fresh_key), dataclasses.replace(state, key=key))

    def step(self, state, action):
        state = super().step(state, action)
        diverged = (state.metrics["length"] % 5 == 0) & (state.target > 0)
        poison = lambda x: jnp.where(diverged, jnp.nan, x)  # noqa: E731
        metrics = state.metrics | {"error": poison(state.metrics["error"])}
        return dataclasses.replace(
            state,
            reward=poison(state.reward),
            obs=jax.tree.map(poison, state.obs),
            metrics=metrics,
            terminated=diverged,
        )


def test_metrics_are_those_of_a_plain_loop_and_a_diverging_world_poisons_nothing():
    """Who ended goes on from a new start. Means over all steps, and over the last steps of episodes; what is not finite
    is left out and counted."""
    env, count, config = BadRewards(), SMALL.num_envs, dataclasses.replace(SMALL, rollout_length=32)
    state = training_of().init(jax.random.key(3))
    lengths = jnp.arange(count, dtype=jnp.float32) * 2.0
    begin = dataclasses.replace(state.env_state, metrics=state.env_state.metrics | {"length": lengths})
    state = dataclasses.replace(state, env_state=begin)

    @jax.jit
    def collect(state):
        (after, _), rollout, metrics = ppo.collect_rollout(env, config, state)
        samples, learnt, explained = ppo.prepare(config, state, rollout)
        batch = samples, learnt.params, learnt.value_stats, learnt.observation_stats, explained
        normalizers = ppo.make_normalizers(env, state.observation_stats)
        return after.key, rollout, metrics, batch, critic_value(config, state.params, normalizers, rollout.obs)

    keys, rollout, metrics, learnt_from, value = collect(state)
    step, restart, seen, now = jax.jit(jax.vmap(env.step)), jax.jit(jax.vmap(env.restart)), [], begin
    for tick, action in enumerate(rollout.decision.action):
        if tick % 16 == 0:  # New episodes are drawn: whoever ends goes on from the last one drawn for it.
            fresh, now = (restart(now, jnp.full(count, done)) for done in (True, False))
        np.testing.assert_array_equal(rollout.obs["actor"][tick], now.obs["actor"])
        now = step(now, jnp.clip(action, -1, 1))
        over = now.terminated | now.truncated
        seen.append((now.reward, now.metrics["error"], now.metrics["length"], over))
        now = jax.vmap(choose)(over, fresh, now)
    np.testing.assert_array_equal(jax.random.key_data(keys), jax.random.key_data(now.key))
    reward, error, length, over = (np.array(column) for column in zip(*seen, strict=True))
    broken = ~np.isfinite(reward)
    reward, error = (np.where(np.isfinite(x), x, 0.0) for x in (reward, error))
    assert over.sum() > 3 and broken.sum() > 3, "the test tests less than it says"
    assert float(metrics["episodes"]) == over.sum() and float(metrics["nonfinite_rewards"]) == broken.sum()
    ends = np.asarray(rollout.terminated).sum() / over.sum()
    assert 0 < ends < 1 and float(metrics["terminated_share"]) == pytest.approx(ends)
    np.testing.assert_allclose(metrics["step/error"], error.mean(), rtol=1e-4)
    np.testing.assert_allclose(metrics["episode/length"], length[over].mean(), rtol=1e-5)
    np.testing.assert_allclose(metrics["reward"], reward.mean(), rtol=1e-4)
    np.testing.assert_allclose(rollout.reward, reward, rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(rollout.value, value, rtol=1e-4, atol=1e-5)  # while there are no returns
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(learnt_from))
