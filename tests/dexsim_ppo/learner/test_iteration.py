"""What an iteration does around the loss: shuffling, clipping, statistics, the actions that the environment gets."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tiny_env import SMALL, TinyEnv

from dexsim_ppo.learner import ppo, update
from dexsim_ppo.learner.curriculum import Curriculum, next_scale
from dexsim_ppo.learner.loss import Samples
from dexsim_ppo.learner.networks import apply_mlp, init_params
from dexsim_ppo.learner.ppo import make_train
from dexsim_ppo.learner.rollout import Decision, Rollout, bound_rewards
from dexsim_ppo.learner.running_stats import RunningStats
from dexsim_ppo.learner.update import Learner

UPDATES = dataclasses.replace(SMALL, epochs=3, minibatches=4, kl_target=0.0)  # of 64 rows
RATE, BLOCKS = UPDATES.learning_rate, 2


@pytest.fixture(scope="module")
def learner():
    state = make_train(TinyEnv(), UPDATES).init(jax.random.key(0))
    return Learner(state.params, state.adam, state.learning_rate, state.skipped_updates)


@pytest.fixture
def updates(learner, monkeypatch):
    """The rows of every minibatch, and the metrics of an update under a loss that only lowers the deviation."""
    rows, count = [], UPDATES.steps_per_iteration

    def downward(params, config, normalizers, batch, old_log_std):
        jax.debug.callback(lambda x: rows.append(np.asarray(x).astype(int)), batch.advantage, ordered=True)
        return jnp.sum(params.log_std), {"kl": jnp.sum(old_log_std - params.log_std)}

    monkeypatch.setattr(update, "loss", downward)
    number, action = jnp.arange(count, dtype=jnp.float32), jnp.zeros((count, 1))
    samples = Samples({}, Decision(action, action, number), number, number, number)
    samples = jax.tree.map(lambda x: x.reshape(BLOCKS, count // BLOCKS, *x.shape[1:]), samples)
    _, metrics = update.update(UPDATES, {}, samples, jax.random.key(1), learner)
    jax.effects_barrier()
    return rows, metrics


def test_every_epoch_takes_every_row_once_in_an_order_of_its_own(updates):
    rows, count = updates[0], UPDATES.steps_per_iteration
    assert len(rows) == UPDATES.epochs * UPDATES.minibatches
    epochs = np.concatenate(rows).reshape(UPDATES.epochs, count)
    np.testing.assert_array_equal(np.sort(epochs, axis=1), np.tile(np.arange(count), (UPDATES.epochs, 1)))
    of_block = count // BLOCKS
    for block in range(BLOCKS):
        mine = np.array([epoch[epoch // of_block == block] for epoch in epochs])
        for order in (*mine, mine[0][mine[1].argsort()]):
            far = np.corrcoef(order, np.arange(of_block))[0, 1]
            assert abs(far) < 0.5, "shuffled, and not alike in two epochs"


def test_every_minibatch_has_as_many_rows_of_each_block(updates):
    of_block = UPDATES.steps_per_iteration // BLOCKS
    for rows in updates[0]:
        np.testing.assert_array_equal(np.bincount(rows // of_block), [len(rows) // BLOCKS] * BLOCKS)


def test_the_divergence_is_that_of_the_last_epoch(updates):
    """Each update lowers log_std by the learning rate (Adam under a constant gradient)."""
    first = (UPDATES.epochs - 1) * UPDATES.minibatches
    expected = RATE * np.mean(first + np.arange(UPDATES.minibatches))
    assert float(updates[1]["kl"]) == pytest.approx(expected, rel=1e-2)


def test_actor_and_critic_are_each_clipped_to_the_norm(learner):
    """A long gradient of one does not shorten the other's."""
    for long in ("actor", "critic"):
        grads = jax.tree.map(lambda x: jnp.full_like(x, 1e-3), learner.params)
        grads = dataclasses.replace(grads, **{long: jax.tree.map(lambda x: 1e6 * x, getattr(grads, long))})
        after, norms = update.apply_gradients(UPDATES, learner, grads)
        for part in ("actor", "critic"):
            moments = np.concatenate([np.ravel(x) for x in jax.tree.leaves(getattr(after.adam.mean, part))])
            if part == long:
                assert np.linalg.norm(moments) == pytest.approx(0.1 * UPDATES.max_grad_norm, rel=1e-3)
                assert float(norms[f"{part}_grad_norm"]) > 1e3
            else:
                np.testing.assert_allclose(moments, 0.1 * 1e-3, rtol=1e-3)


def test_a_critic_that_learns_first_does_so_at_the_largest_rate(learner):
    config = dataclasses.replace(UPDATES, critic_first=1)
    after, _ = update.apply_gradients(config, learner, jax.tree.map(jnp.ones_like, learner.params))
    moved = jax.tree.map(lambda new, old: np.asarray(old - new), after.params, learner.params)
    for leaf in jax.tree.leaves(moved.critic):  # Adam's first step is the rate.
        np.testing.assert_allclose(leaf, config.learning_rate_max, rtol=1e-2)
    assert not any(np.any(leaf) for leaf in jax.tree.leaves((moved.actor, moved.log_std)))


class Watched(TinyEnv):
    """Shows the actor the action that it got, and the critic other numbers than the actor."""

    def _observe(self, state):
        state = super()._observe(state)
        return dataclasses.replace(state, obs={"actor": state.obs["actor"], "critic": 3.0 * state.obs["actor"] + 5.0})

    def step(self, state, action):
        state = super().step(state, action)
        return dataclasses.replace(state, obs=state.obs | {"actor": state.obs["actor"].at[0].set(action[0])})


def test_every_group_has_the_statistics_of_its_own_observations():
    training = make_train(Watched(), SMALL)
    after, _ = training.step(training.init(jax.random.key(0)))
    actor, critic = (after.observation_stats[group] for group in ("actor", "critic"))
    np.testing.assert_allclose(critic.mean[1:], 3 * actor.mean[1:] + 5, rtol=1e-4)
    np.testing.assert_allclose(critic.variance[1:], 9 * actor.variance[1:], rtol=1e-3)
    assert np.all(np.asarray(actor.variance) > 1e-3)


@pytest.mark.parametrize(("distribution", "squash"), [("gaussian", lambda x: np.clip(x, -1, 1)), ("tanh", np.tanh)])
def test_the_environment_gets_the_action_clipped_or_squashed(distribution, squash):
    env = Watched()
    config = dataclasses.replace(SMALL, distribution=distribution, initial_std=1.0)
    state = make_train(env, config).init(jax.random.key(0))

    @jax.jit
    def collect(state, key):
        return ppo.collect_rollout(env, config, state, ppo.make_normalizers(env, config, state.observation_stats), key)

    _, rollout, _ = collect(state, jax.random.key(1))
    drawn = np.asarray(rollout.decision.action[:-1, :, 0])
    going_on = ~np.asarray(rollout.terminated | rollout.truncated)[:-1]
    assert np.any(np.abs(drawn[going_on]) > 1.3)
    got = np.asarray(rollout.obs["actor"][1:, :, 0])
    np.testing.assert_allclose(got[going_on], squash(drawn)[going_on], rtol=1e-5, atol=1e-6)


def test_training_begins_amid_episodes():
    """Else all of them would reach the time limit together."""
    state = make_train(TinyEnv(), dataclasses.replace(SMALL, num_envs=64)).init(jax.random.key(0))
    clocks = np.asarray(state.env_state.metrics["length"])
    assert len(np.unique(clocks)) > 16 and clocks.min() < 8 and clocks.max() > 24
    assert len(np.unique(state.env_state.x)) == 64


@pytest.mark.parametrize("scale", [0.5, 1.0, 4.0])
def test_far_rewards_are_bounded_in_units_of_scaled_returns(scale):
    """A hundred deviations of returns, which are of scaled rewards."""
    limit = 100 * 5.0 / scale
    reward = jnp.zeros((4, 8)).at[1, 2].set(0.9 * limit).at[2, 3].set(-3 * limit)
    zero, flag = jnp.zeros_like(reward), jnp.zeros(reward.shape, bool)
    rollout = Rollout({}, None, zero, zero, reward, flag, flag)
    bounded, count = bound_rewards(rollout, RunningStats(jnp.int32(9), jnp.float32(0), jnp.float32(25)), scale)
    assert float(count) == 1
    np.testing.assert_allclose(bounded.reward[1, 2], 0.9 * limit, rtol=1e-6)
    np.testing.assert_allclose(bounded.reward[2, 3], -limit, rtol=1e-5)


@pytest.mark.parametrize(
    ("success", "change"), [(0.5, -0.1), (0.25, -0.1), (0.75, 0.0), (0.8, 0.0), (0.875, 0.1), (1.0, 0.1)]
)
def test_the_curriculum_widens_at_its_upper_mark_and_narrows_below_its_lower(success, change):
    rules = Curriculum(on=True, widen_above=0.875, narrow_below=0.75, step=0.1)
    assert float(next_scale(jnp.float32(0.5), jnp.float32(success), rules)) == pytest.approx(0.5 + change)


def test_a_new_actor_is_nearly_pure_noise_and_a_new_critic_is_not_flat():
    sizes = {"actor_sizes": (20, 64, 32, 4), "critic_sizes": (20, 64, 32, 1)}
    params = init_params(jax.random.key(0), initial_std=0.7, **sizes)
    x = jax.random.normal(jax.random.key(1), (200, 20))
    mean, value = (np.asarray(apply_mlp(layers, x)) for layers in (params.actor, params.critic))
    assert np.abs(mean).max() < 0.1 and value.std() > 0.3
    np.testing.assert_allclose(np.exp(params.log_std), 0.7, rtol=1e-6)
    first, second, last = (np.asarray(layer.kernel, float) for layer in params.actor)
    np.testing.assert_allclose(first @ first.T, 2 * np.eye(20), atol=1e-4)
    np.testing.assert_allclose(second.T @ second, 2 * np.eye(32), atol=1e-4)
    np.testing.assert_allclose(last.T @ last, 1e-4 * np.eye(4), atol=1e-8)
