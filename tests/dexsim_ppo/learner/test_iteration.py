"""What an iteration does around the loss: shuffling, clipping, statistics, the actions that the environment gets."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tiny_env import SMALL, TinyEnv

from dexsim_ppo.learner import ppo, update
from dexsim_ppo.learner.distribution import Decision
from dexsim_ppo.learner.loss import Samples
from dexsim_ppo.learner.networks import apply_mlp, init_params
from dexsim_ppo.learner.ppo import make_train
from dexsim_ppo.learner.rollout import Rollout, bound_rewards
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
    _, metrics = update.update(UPDATES, {}, samples, jax.random.key(2), learner)
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


@pytest.mark.parametrize("rows", [1, 7, 4096, 5000])
def test_an_order_has_every_row_once(rows):
    order = np.asarray(update.draw_order(jax.random.key(rows), 3, rows))
    np.testing.assert_array_equal(np.sort(order, axis=1), np.tile(np.arange(rows), (3, 1)))


def test_every_order_of_a_few_rows_is_as_likely():
    """Chi-squared of 24 orders in 24,000 draws: 23 expected, 58 with a chance of 1 in 10,000."""
    order = np.asarray(update.draw_order(jax.random.key(0), 24_000, 4))
    _, counts = np.unique(order @ np.array([64, 16, 4, 1]), return_counts=True)
    assert len(counts) == 24 and np.sum((counts - 1000.0) ** 2 / 1000) < 58


def test_the_divergence_is_that_of_the_last_epoch(updates):
    """Each update lowers log_std by the learning rate (Adam under a constant gradient)."""
    first = (UPDATES.epochs - 1) * UPDATES.minibatches
    expected = RATE * np.mean(first + np.arange(UPDATES.minibatches))
    assert float(updates[1]["kl"]) == pytest.approx(expected, rel=1e-2)


def test_a_minibatch_without_a_finite_loss_says_nothing(learner, monkeypatch):
    """The means are over the others; so is the divergence that the learning rate follows."""
    config = dataclasses.replace(UPDATES, kl_target=0.01)

    def broken(params, config, normalizers, batch, old_log_std):
        found = jnp.where(jnp.any(batch.advantage == 5.0), jnp.nan, 1.0)
        return found * jnp.sum(params.log_std), {"kl": found, "value_loss": 2 * found}

    monkeypatch.setattr(update, "loss", broken)
    number, action = jnp.arange(config.steps_per_iteration, dtype=jnp.float32), jnp.zeros((64, 1))
    samples = Samples({}, Decision(action, action, number), number, number, number)
    one_block = jax.tree.map(lambda x: x[None], samples)
    after, metrics = update.update(config, {}, one_block, jax.random.key(1), learner)
    assert int(after.skipped_updates) == config.epochs, "row 5 is in one minibatch of each epoch"
    assert float(metrics["kl"]) == 1.0 and float(metrics["value_loss"]) == 2.0
    assert float(after.learning_rate) == pytest.approx(RATE / 1.5)
    assert int(after.adam.count) == config.epochs * (config.minibatches - 1)


def test_the_critic_is_first_for_whole_iterations(learner):
    config = dataclasses.replace(UPDATES, critic_first=2)
    learns = lambda count: bool(  # noqa: E731
        update.actor_learns(config, learner._replace(adam=dataclasses.replace(learner.adam, count=jnp.int32(count))))
    )
    assert [learns(count) for count in (0, 12, 23, 24, 25)] == [False, False, False, True, True]


@pytest.mark.parametrize("part", ["actor", "log_std", "critic"])
def test_nothing_moves_where_one_part_of_the_gradient_is_not_finite(learner, part):
    grads = jax.tree.map(jnp.ones_like, learner.params)
    grads = dataclasses.replace(
        grads, **{part: jax.tree.map(lambda x: jnp.full_like(x, jnp.inf), getattr(grads, part))}
    )
    after, _ = update.apply_gradients(UPDATES, learner, grads)
    assert int(after.skipped_updates) == int(learner.skipped_updates) + 1
    jax.tree.map(np.testing.assert_array_equal, (after.params, after.adam), (learner.params, learner.adam))


def test_the_deviations_gradient_is_clipped_with_the_actors(learner):
    grads = jax.tree.map(jnp.zeros_like, learner.params)
    grads = dataclasses.replace(grads, log_std=jnp.full_like(grads.log_std, 1e3))
    after, norms = update.apply_gradients(UPDATES, learner, grads)
    size = np.sqrt(learner.params.log_std.size)
    assert float(norms["actor_grad_norm"]) == pytest.approx(1e3 * size) and float(norms["critic_grad_norm"]) == 0
    np.testing.assert_allclose(after.adam.mean.log_std, 0.1 * UPDATES.max_grad_norm / size, rtol=1e-4)


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
        return ppo.collect_rollout(env, config, dataclasses.replace(state, key=key))

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


def test_healthy_rewards_of_a_small_scale_are_not_bounded():
    """The deviation is of scaled returns: the bound on rewards is the larger for a small scale."""
    training = make_train(TinyEnv(), dataclasses.replace(SMALL, reward_scale=1e-3))
    state = training.init(jax.random.key(0))
    stats = RunningStats(jnp.int32(9), jnp.float32(0), jnp.float32(1e-6))  # bounds rewards of about 1 at 141
    _, metrics = training.step(dataclasses.replace(state, value_stats=stats))
    assert 0.1 < abs(float(metrics["reward"][0])) < 10 and float(metrics["bounded_rewards"][0]) == 0


@pytest.mark.slow
def test_an_iteration_reports_what_it_had_and_what_it_made():
    """Of the experience, which collecting it again with the same key gives again, and of the state after it."""
    env = Watched()
    training = make_train(env, SMALL)
    state = training.init(jax.random.key(0))
    before = jax.tree.map(jnp.copy, state)
    after, metrics = training.step(state)

    @jax.jit
    def again(state):
        _, rollout, _ = ppo.collect_rollout(env, SMALL, state)
        return ppo.prepare(SMALL, state.value_stats, {}, state.params, rollout).samples

    samples = jax.tree.map(lambda x: np.asarray(x, np.float64), again(before))
    explained = 1 - np.var(samples.target - samples.value) / np.var(samples.target)
    assert float(metrics["explained_variance"][0]) == pytest.approx(explained, rel=1e-3, abs=1e-4)
    assert float(metrics["action_std"][0]) == pytest.approx(float(np.mean(np.exp(after.params.log_std))), rel=1e-5)
    assert float(metrics["learning_rate"][0]) == float(after.learning_rate) != RATE
    assert int(metrics["skipped_updates"][0]) == int(after.skipped_updates) == 0 and int(after.iteration) == 1
    assert int(after.adam.count) == SMALL.epochs * SMALL.minibatches
    assert int(after.value_stats.count) == int(after.observation_stats["actor"].count) == SMALL.steps_per_iteration
    keys = [
        np.asarray(jax.random.key_data(key)) for key in (before.key, after.key, *jax.random.split(before.key, 3)[1:])
    ]
    assert len({key.tobytes() for key in keys}) == 4, "the next iteration draws anew"


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
