"""What an iteration does around the loss: shuffling, clipping, statistics."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats
from tiny_env import SMALL, TinyConfig, TinyEnv, training_of

from dexsim.errors import ConfigError
from dexsim_ppo.learner import distribution, running_stats, update
from dexsim_ppo.learner.config import CurriculumConfig, PPOConfig
from dexsim_ppo.learner.distribution import Decision
from dexsim_ppo.learner.loss import Samples
from dexsim_ppo.learner.networks import init_mlp
from dexsim_ppo.learner.ppo import make_train, update_scale
from dexsim_ppo.learner.rollout import Rollout, bound_rewards
from dexsim_ppo.learner.running_stats import RunningStats, init_stats, merge_moments
from dexsim_ppo.learner.types import AdamState
from dexsim_ppo.learner.update import Learner, adapt_learning_rate, step_adam

UPDATES = dataclasses.replace(SMALL, epochs=3, minibatches=4, kl_target=0.0)
RATE, COUNT, BLOCKS = UPDATES.learning_rate, UPDATES.steps_per_iteration, 2
apply_gradients = jax.jit(functools.partial(update.apply_gradients, UPDATES))


@pytest.fixture(scope="module")
def learner():
    state = training_of().init(jax.random.key(0))
    return Learner(state.params, state.adam, state.learning_rate, state.skipped_updates)


def numbered(blocks):
    """Samples in blocks, whose advantage is their number."""
    number, action = jnp.arange(COUNT, dtype=jnp.float32), jnp.zeros((COUNT, 1))
    samples = Samples({}, Decision(action, action, number), number, number, number)
    return jax.tree.map(lambda x: x.reshape(blocks, COUNT // blocks, *x.shape[1:]), samples)


def test_every_epoch_takes_every_row_once_in_an_order_of_its_own(learner, monkeypatch):
    """And every minibatch as many rows of each block. The divergence is that of the last epoch: each update lowers
    log_std by the learning rate (Adam under a constant gradient)."""
    rows = []

    def downward(params, config, normalizers, batch, old_log_std):
        jax.debug.callback(lambda x: rows.append(np.asarray(x).astype(int)), batch.advantage, ordered=True)
        return jnp.sum(params.log_std), {"kl": jnp.sum(old_log_std - params.log_std)}

    monkeypatch.setattr(update, "loss", downward)
    _, metrics = update.update(UPDATES, {}, numbered(BLOCKS), jax.random.key(2), learner)
    jax.effects_barrier()
    assert len(rows) == UPDATES.epochs * UPDATES.minibatches
    epochs = np.concatenate(rows).reshape(UPDATES.epochs, COUNT)
    np.testing.assert_array_equal(np.sort(epochs, axis=1), np.tile(np.arange(COUNT), (UPDATES.epochs, 1)))
    of_block = COUNT // BLOCKS
    for minibatch in rows:
        np.testing.assert_array_equal(np.bincount(minibatch // of_block), [len(minibatch) // BLOCKS] * BLOCKS)
    for block in range(BLOCKS):
        mine = np.array([epoch[epoch // of_block == block] for epoch in epochs])
        for order in (*mine, mine[0][mine[1].argsort()]):
            far = np.corrcoef(order, np.arange(of_block))[0, 1]
            assert abs(far) < 0.5, "shuffled, and not alike in two epochs"
    first = (UPDATES.epochs - 1) * UPDATES.minibatches
    expected = RATE * np.mean(first + np.arange(UPDATES.minibatches))
    assert float(metrics["kl"]) == pytest.approx(expected, rel=1e-2)


def test_a_minibatch_without_a_finite_loss_says_nothing(learner, monkeypatch):
    """The means are over the others; so is the divergence that the learning rate follows."""
    config = dataclasses.replace(UPDATES, kl_target=0.01)

    def broken(params, config, normalizers, batch, old_log_std):
        found = jnp.where(jnp.any(batch.advantage == 5.0), jnp.nan, 1.0)
        return found * jnp.sum(params.log_std), {"kl": found, "value_loss": 2 * found}

    monkeypatch.setattr(update, "loss", broken)
    after, metrics = update.update(config, {}, numbered(1), jax.random.key(1), learner)
    assert int(after.skipped_updates) == config.epochs, "row 5 is in one minibatch of each epoch"
    assert float(metrics["kl"]) == 1.0 and float(metrics["value_loss"]) == 2.0
    assert float(after.learning_rate) == pytest.approx(RATE / 1.5)
    assert int(after.adam.count) == config.epochs * (config.minibatches - 1)
    # The target halves with the iterations that were learnt from: 2.2 at first, 1.1 after a hundred.
    config, count = dataclasses.replace(UPDATES, kl_target=2.2, kl_halving=100), 99 * config.epochs * config.minibatches
    late = learner._replace(adam=dataclasses.replace(learner.adam, count=jnp.int32(count)))
    after, _ = update.update(config, {}, numbered(1), jax.random.key(1), late)
    assert float(after.learning_rate) == pytest.approx(RATE)


@pytest.mark.parametrize("part", ["actor", "log_std", "critic"])
def test_nothing_moves_where_one_part_of_the_gradient_is_not_finite(learner, part):
    broken = jax.tree.map(lambda x: jnp.full_like(x, jnp.inf), getattr(learner.params, part))
    grads = dataclasses.replace(jax.tree.map(jnp.ones_like, learner.params), **{part: broken})
    after, _ = apply_gradients(learner, grads)
    assert int(after.skipped_updates) == int(learner.skipped_updates) + 1
    jax.tree.map(np.testing.assert_array_equal, (after.params, after.adam), (learner.params, learner.adam))


@pytest.mark.parametrize(("long", "short"), [("actor", "critic"), ("critic", "actor")])
def test_actor_and_critic_are_each_clipped_to_the_norm(learner, long, short):
    """A long gradient of one does not shorten the other's."""
    grads = jax.tree.map(lambda x: jnp.full_like(x, 1e-3), learner.params)
    grads = dataclasses.replace(grads, **{long: jax.tree.map(lambda x: 1e6 * x, getattr(grads, long))})
    after, norms = apply_gradients(learner, grads)
    clipped, whole = (
        np.concatenate([np.ravel(x) for x in jax.tree.leaves(getattr(after.adam.mean, part))]) for part in (long, short)
    )
    assert np.linalg.norm(clipped) == pytest.approx(0.1 * UPDATES.max_grad_norm, rel=1e-3)
    assert float(norms[f"{long}_grad_norm"]) > 1e3
    np.testing.assert_allclose(whole, 0.1 * 1e-3, rtol=1e-3)


def test_log_std_stays_between_floor_and_cap(learner):
    learner = learner._replace(learning_rate=jnp.float32(1.0))
    for sign, bound in ((1.0, 0.05), (-1.0, 1.0)):
        moved, grads = learner, jax.tree.map(lambda x, sign=sign: jnp.full_like(x, 100 * sign), learner.params)
        for _ in range(5):
            moved, _ = apply_gradients(moved, grads)
        np.testing.assert_allclose(jnp.exp(moved.params.log_std), bound, rtol=1e-5)


# --- seven iterations of one update each, with ranges that widen with success ------------------------------

RULES = CurriculumConfig(on=True, start=0.5, widen_above=0.9, narrow_below=0.3, step=0.1)


class Watched(TinyEnv):
    """Shows the critic other numbers than the actor; all episodes begin and end together."""

    def _observe(self, state):
        state = super()._observe(state)
        return dataclasses.replace(state, obs={"actor": state.obs["actor"], "critic": 3.0 * state.obs["actor"] + 5.0})

    def randomize_episode_time(self, state, key):
        return state


@pytest.fixture(scope="module")
def watched():
    """The last state, and each iteration's metrics."""
    training = make_train(
        Watched(TinyConfig(horizon=4)), dataclasses.replace(SMALL, initial_std=1.0, epochs=1, minibatches=1), RULES
    )
    state, rows = training.init(jax.random.key(0)), []
    for _ in range(7):
        state, metrics = training.step(state)
        rows.append({name: float(value[0]) for name, value in metrics.items()})
    assert training.step._cache_size() == 1
    return state, rows


def test_every_group_has_the_statistics_of_its_own_observations(watched):
    actor, critic = (watched[0].observation_stats[group] for group in ("actor", "critic"))
    np.testing.assert_allclose(critic.mean, 3 * actor.mean + 5, rtol=1e-4)
    np.testing.assert_allclose(critic.variance, 9 * actor.variance, rtol=1e-3)
    assert np.all(np.asarray(actor.variance) > 1e-3)


def test_the_first_minibatch_meets_the_policy_that_collected_it(watched):
    """With the normalisers of the collection: the divergence is zero, and no ratio is clipped."""
    for row in watched[1]:
        assert abs(row["kl"]) < 1e-6 and row["clip_fraction"] == 0.0


def test_ranges_widen_with_success_and_episodes_update_scale(watched):
    state, rows = watched
    np.testing.assert_allclose([row["curriculum/scale"] for row in rows], [0.6, 0.7, 0.8, 0.9, 1, 1, 1], rtol=1e-5)
    assert all(row["curriculum/success"] == 1 for row in rows)
    np.testing.assert_allclose(state.scale, 1.0)
    np.testing.assert_array_equal(state.env_state.scale, np.ones(SMALL.num_envs, np.float32))
    # Two episodes of four steps in an iteration of eight: both are drawn at the scale that it began with.
    np.testing.assert_allclose([row["step/drawn"] for row in rows[1:5]], [0.55, 0.65, 0.75, 0.85], atol=1e-5)


def test_no_ended_episode_says_nothing_and_an_unknown_metric_is_named():
    """`training/test_presets.py` has a metric by name."""
    metrics = {"terminated_share": jnp.float32(jnp.nan), "episode/goals": jnp.float32(7.0)}
    scale, success = update_scale(RULES, jnp.float32(0.5), metrics)
    assert np.isnan(success) and float(scale) == 0.5
    with pytest.raises(ConfigError, match="CurriculumConfig.metric = 'step/luck': choose from episode/goals"):
        update_scale(dataclasses.replace(RULES, metric="step/luck"), scale, metrics)


def test_training_begins_amid_episodes():
    """Else all of them would reach the time limit together."""
    state = training_of().init(jax.random.key(0))
    clocks = np.asarray(state.env_state.metrics["length"])
    assert len(np.unique(clocks)) > 8 and clocks.min() < 8 and clocks.max() > 24
    assert len(np.unique(state.env_state.x)) == SMALL.num_envs


def test_rewards_beyond_a_hundred_deviations_of_returns_are_bounded_and_others_stay_to_the_last_bit():
    stats = RunningStats(jnp.int32(9), jnp.float32(0), jnp.float32(25))
    reward = jax.random.normal(jax.random.key(1), (16, 64)).at[1, 2].set(450.0).at[2, 3].set(-1500.0)
    zero, flag = jnp.zeros_like(reward), jnp.zeros(reward.shape, bool)
    bound = jax.jit(bound_rewards)
    bounded, count = bound(Rollout({}, None, zero, zero, reward, flag, flag), stats)
    assert float(count) == 1
    np.testing.assert_allclose(bounded.reward[2, 3], -500.0, rtol=1e-5)
    np.testing.assert_array_equal(bounded.reward, reward.at[2, 3].set(bounded.reward[2, 3]))
    # While there are no returns: a thousand times the root mean square of the others; a first reward may be alone.
    calm = jnp.where(jnp.abs(reward) < 10, reward, 0.0)
    limit, alone = 1000 * jnp.sqrt(jnp.mean(calm**2)), zero.at[1, 2].set(900.0)
    for given, expected in ((calm.at[1, 2].set(-1e5), calm.at[1, 2].set(-limit)), (alone, alone)):
        bounded, count = bound(Rollout({}, None, zero, zero, given, flag, flag), init_stats(()))
        np.testing.assert_allclose(bounded.reward, expected, rtol=1e-4)
        assert float(count) == (given is not alone)


# --- formulas; `test_composed_objective.py` has the others ------------------------------------------------


def test_memory_fades_over_a_full_count():
    """A sample's weight is never below one in `MEMORY`; the count neither overflows nor freezes."""
    merged = lambda stats, value, size: merge_moments(stats, jnp.float32(value), jnp.zeros(()), size)  # noqa: E731
    full = RunningStats(jnp.int32(running_stats.MEMORY), jnp.zeros(()), jnp.ones(()))
    assert float(merged(full, 1, 2**20).mean) == pytest.approx(1 / 129, rel=1e-4)
    stats, _ = jax.lax.scan(lambda s, _: (merged(s, 2, 64 * 1024), None), full, None, length=10_000)
    assert int(stats.count) > 0 and float(stats.mean) == pytest.approx(2.0, rel=0.02)


def test_statistics_of_a_column_that_is_not_finite_stay_unchanged():
    """Mean, variance, or both."""
    new = jnp.array([[2.0, jnp.nan, 2.0, jnp.inf], [3.0, jnp.nan, jnp.inf, 3.0]])
    stats = merge_moments(init_stats((4,)), *new, 2)
    np.testing.assert_allclose((stats.mean, stats.variance), [[2.0, 0.0, 0.0, 0.0], [3.0, 1.0, 1.0, 1.0]])


def test_kernels_begin_orthogonal_and_the_last_one_small():
    for layer, gain in zip(init_mlp(jax.random.key(0), (8, 6, 5, 3), 0.01), (2**0.5, 2**0.5, 0.01), strict=True):
        np.testing.assert_allclose(layer.kernel.T @ layer.kernel / gain**2, np.eye(len(layer.bias)), atol=1e-5)


def test_adam_against_numpy():
    rng = np.random.default_rng(0)
    parameters, mean, square = rng.normal(size=3), 0.0, 0.0
    got = jnp.float32(parameters)
    state = AdamState(jnp.int32(0), *[jax.tree.map(jnp.zeros_like, got)] * 2)
    for t, grad in enumerate(rng.normal(size=(5, 3)), start=1):
        got, state = step_adam(jnp.float32(grad), state, got, 0.01)
        mean, square = 0.9 * mean + 0.1 * grad, 0.999 * square + 0.001 * grad**2
        parameters = parameters - 0.01 * (mean / (1 - 0.9**t)) / (np.sqrt(square / (1 - 0.999**t)) + 1e-5)
    np.testing.assert_allclose(got, parameters, rtol=1e-5, atol=1e-6)


def test_densities_and_divergences_are_over_the_last_axis_alone():
    """With a GRU there are two axes before it."""
    rng = np.random.default_rng(0)
    x, mean, other, std, other_std = *rng.normal(size=(3, 2, 4, 3)), *rng.uniform(0.5, 2, (2, 3))
    near = functools.partial(np.testing.assert_allclose, rtol=1e-5)
    x, mean, other, one, two = jax.tree.map(jnp.float32, (2 * x, 2 * mean, other, np.log(std), np.log(other_std)))
    near(distribution.log_prob(x, mean, one), scipy.stats.norm.logpdf(x, mean, std).sum(-1))
    near(distribution.bounds_loss(mean), (np.maximum(np.abs(mean) - 1.1, 0) ** 2).sum(-1))
    terms = np.log(other_std / std) + (std**2 + np.asarray(mean - other) ** 2) / (2 * other_std**2) - 0.5
    near(distribution.kl_divergence(mean, one, other, two), terms.sum(-1))


def test_learning_rate_adapts_within_its_band():
    config = PPOConfig(learning_rate=1e-3, learning_rate_min=9e-4, learning_rate_max=1.2e-3, kl_target=0.01)
    rate = lambda kl: float(adapt_learning_rate(config, jnp.float32(1e-3), jnp.float32(kl), 0))  # noqa: E731
    assert [rate(kl) for kl in (0.0, 0.006, 0.01, 0.021)] == pytest.approx([1.2e-3, 1e-3, 1e-3, 9e-4])
    wide = {"learning_rate_min": 1e-5, "learning_rate_max": 1e-1}
    halved = dataclasses.replace(config, kl_target=0.04, kl_halving=100, **wide)
    for iteration, target in ((0, 0.04), (100, 0.02), (300, 0.01)):
        for share, factor in ((0.49, 1.5), (0.51, 1.0), (1.99, 1.0), (2.01, 1 / 1.5)):
            after = adapt_learning_rate(halved, jnp.float32(1e-3), jnp.float32(share * target), iteration)
            assert float(after) == pytest.approx(1e-3 * factor), (iteration, share)
    fixed = dataclasses.replace(config, kl_target=0.0)
    assert float(adapt_learning_rate(fixed, jnp.float32(1e-3), jnp.float32(9.0), 0)) == pytest.approx(1e-3)
