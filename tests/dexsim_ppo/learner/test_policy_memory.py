"""A policy's memory: learnt where it is needed, emptied with every episode, the same in rollout and update."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dexsim_ppo.evaluate import evaluate_policy
from dexsim_ppo.learner import ppo
from dexsim_ppo.learner.adapter import adapt
from dexsim_ppo.learner.config import PPOConfig
from dexsim_ppo.learner.loss import actor_mean
from dexsim_ppo.learner.networks import GRU, Layer, step_memory
from dexsim_ppo.policy import Policy

MAX_STEPS = 6
# Rollouts are shorter than episodes: what a GRU remembers crosses them.
CONFIG = PPOConfig(
    num_envs=64,
    rollout_length=4,
    minibatches=4,
    epochs=4,
    actor_layers=(32,),
    critic_layers=(32,),
    discount=0.0,
    kl_target=0.02,
    learning_rate=2e-3,
    learning_rate_max=1e-2,
    memory_size=16,
    iterations_per_call=10,
)


class Recall:
    """A number that is shown once, at an episode's first step, and is to be given as the action until its end.

    Without memory the best action of every later step is 0, at a mean error of 0.5.
    """

    observation_size, action_size, max_steps = 2, 1, MAX_STEPS
    control_period = 0.1

    def reset(self, key):
        state = {"number": jax.random.uniform(key, (), minval=-1.0), "error": jnp.float32(0)}
        return jnp.stack([state["number"], jnp.float32(1)]), state

    def step(self, key, state, action):
        state = state | {"error": jnp.abs(action[0] - state["number"])}
        return jnp.zeros(2), state, -state["error"], jnp.bool_(False)

    def metrics(self, state):
        return {"error": state["error"]}


@functools.cache
def learner(kind):
    """Environment, configuration, training and a first state."""
    env, config = adapt(Recall(), "recall"), dataclasses.replace(CONFIG, memory=kind)
    training = ppo.make_train(env, config)
    return env, config, training, training.init(jax.random.key(0))


@functools.cache
def experience(kind):
    """A rollout from that state with something in its memory, and the samples that the update would see."""
    env, config, _, state = learner(kind)
    state = dataclasses.replace(state, carry=jnp.full_like(state.carry, 0.1))  # amid episodes

    @jax.jit
    def collect(state):
        after, rollout, _ = ppo.collect_rollout(env, config, state)
        samples, *_ = ppo.prepare(config, state, rollout)
        return after, rollout, jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), samples)  # blocks one after another

    return jax.device_get(collect(state))


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["none", "gru"])
def test_what_was_shown_once_is_recalled_only_with_memory(kind):
    env, config, training, _ = learner(kind)
    state = training.init(jax.random.key(0))
    for _ in range(8):  # 80 iterations
        state, _ = training.step(state)
    policy = Policy.from_training(env, state)
    report = evaluate_policy(policy, env=env, episodes=256)
    error = report["task"]["headline"]["error"]
    # The mean of |number| is 0.5, and the first of six steps shows it.
    assert error > 0.35 if kind == "none" else error < 0.1


def test_every_episode_begins_with_an_empty_memory_and_only_then():
    (_, last), rollout, samples = experience("gru")
    ended = rollout.terminated | rollout.truncated
    later = np.concatenate([rollout.carry[1:], last[None]])
    assert 0 < ended.sum() < ended.size and ended[:-1].any(), "episodes that end within the rollout"
    assert not later[ended].any()
    assert np.abs(later[~ended]).max(-1).min() > 0
    env, config, _, state = learner("gru")
    seen = jax.tree.map(jnp.asarray, dataclasses.replace(samples, first=samples.first > 0))
    mean = actor_mean(config, state.params, ppo.make_normalizers(env, state.observation_stats), seen)
    np.testing.assert_allclose(mean, samples.decision.mean, atol=1e-6, err_msg="the update replays what was done")
    assert samples.first.any()


def test_a_step_is_that_of_cudnns_unit():
    """Gates in the order reset, update, candidate; the reset gate acts after the product. Also as a policy's file."""
    rng, (inputs, units) = np.random.default_rng(0), (3, 4)
    layers = [Layer(*(rng.normal(size=size) for size in ((n, 3 * units), 3 * units))) for n in (inputs, units)]
    x, past = rng.normal(size=(5, inputs)), rng.normal(size=(5, units))
    now, before = (np.split(a @ layer.kernel + layer.bias, 3, -1) for a, layer in zip((x, past), layers, strict=True))
    reset, update = (1 / (1 + np.exp(-now[k] - before[k])) for k in (0, 1))
    expected = (1 - update) * np.tanh(now[2] + reset * before[2]) + update * past
    unit, x, past = jax.tree.map(jnp.float32, (GRU(*layers), x, past))
    carry, features = step_memory(unit, past, x)
    np.testing.assert_allclose(carry, expected, atol=1e-5)
    np.testing.assert_allclose(features, np.concatenate([x, expected], -1), atol=1e-5)


def test_gradients_go_back_through_the_rollout():
    """A step's error reaches what an earlier observation did, but not across an episode's start."""
    env, config, _, state = learner("gru")
    *_, samples = experience("gru")
    normalizers = ppo.make_normalizers(env, state.observation_stats)

    def last(obs, first):
        changed = dataclasses.replace(samples, obs={"actor": obs}, carry=jnp.asarray(samples.carry), first=first)
        return actor_mean(config, state.params, normalizers, changed)[:, -1].sum()

    begun = jnp.zeros(samples.first.shape, bool)
    for first, reaches in ((begun, [True] * 4), (begun.at[:, 2].set(True), [False, False, True, True])):
        slope = np.abs(jax.grad(last)(jnp.asarray(samples.obs["actor"]), first)).sum((0, 2))
        assert ((slope > 1e-6) == reaches).all(), slope
