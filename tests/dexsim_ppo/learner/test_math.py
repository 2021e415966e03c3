"""Formulas of the learner against hand-computed values or NumPy; `test_composed_objective.py` has the others."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dexsim_ppo.learner import running_stats
from dexsim_ppo.learner.config import PPOConfig
from dexsim_ppo.learner.running_stats import RunningStats, init_stats, merge_moments
from dexsim_ppo.learner.update import adapt_learning_rate, init_adam, step_adam


def merged(stats, batch):
    axes = tuple(range(batch.ndim - stats.mean.ndim))
    return merge_moments(stats, batch.mean(axes), batch.var(axes), batch.size // stats.mean.size)


class TestRunningStats:
    def test_memory_fades_over_a_full_count(self):
        """A sample's weight is never below one in `MEMORY`; the count neither overflows nor freezes."""
        full = RunningStats(jnp.int32(running_stats.MEMORY), jnp.zeros(()), jnp.ones(()))
        assert float(merged(full, jnp.full(2**20, 1.0)).mean) == pytest.approx(1 / 129, rel=1e-4)
        stats, _ = jax.lax.scan(lambda s, _: (merged(s, jnp.full((64, 1024), 2.0)), None), full, None, length=10_000)
        assert int(stats.count) > 0 and float(stats.mean) == pytest.approx(2.0, rel=0.02)

    def test_a_column_that_is_not_finite_stays_unchanged(self):
        stats = merged(init_stats((2,)), jnp.array([[1.0, 2.0], [3.0, jnp.nan]]))
        np.testing.assert_allclose((stats.mean, stats.variance), [[2.0, 0.0], [1.0, 1.0]])


class TestAdam:
    def test_against_numpy(self):
        rng = np.random.default_rng(0)
        params = {"a": rng.normal(size=3), "b": rng.normal(size=(2, 2))}
        grads = [{k: rng.normal(size=v.shape) for k, v in params.items()} for _ in range(5)]
        single = lambda tree: jax.tree.map(jnp.float32, tree)  # noqa: E731
        state, got = init_adam(single(params)), single(params)
        moments = {k: (np.zeros_like(v), np.zeros_like(v)) for k, v in params.items()}
        for t, grad in enumerate(grads, start=1):
            got, state = step_adam(single(grad), state, got, 0.01)
            for k, g in grad.items():
                m, v = (0.9 * moments[k][0] + 0.1 * g, 0.999 * moments[k][1] + 0.001 * g**2)
                moments[k] = m, v
                params[k] = params[k] - 0.01 * (m / (1 - 0.9**t)) / (np.sqrt(v / (1 - 0.999**t)) + 1e-5)
        for k in params:
            np.testing.assert_allclose(got[k], params[k], rtol=1e-5, atol=1e-6)


class TestConfig:
    def test_learning_rate_adapts_within_its_band(self):
        config = PPOConfig(learning_rate=1e-3, learning_rate_min=9e-4, learning_rate_max=1.2e-3, kl_target=0.01)
        rate = lambda kl: float(adapt_learning_rate(config, jnp.float32(1e-3), jnp.float32(kl), 0))  # noqa: E731
        assert [rate(kl) for kl in (0.0, 0.006, 0.01, 0.021)] == pytest.approx([1.2e-3, 1e-3, 1e-3, 9e-4])
        config = dataclasses.replace(config, learning_rate_min=1e-5, learning_rate_max=1e-1)
        wide = [1.5e-3, 1e-3, 1e-3, 1e-3 / 1.5]
        assert [rate(kl) for kl in (0.0049, 0.0051, 0.0199, 0.0201)] == pytest.approx(wide)
        halved = dataclasses.replace(config, kl_target=0.04, kl_halving=100)
        for iteration, target in ((0, 0.04), (100, 0.02), (300, 0.01)):
            for share, factor in ((0.49, 1.5), (0.51, 1.0), (1.99, 1.0), (2.01, 1 / 1.5)):
                after = adapt_learning_rate(halved, jnp.float32(1e-3), jnp.float32(share * target), iteration)
                assert float(after) == pytest.approx(1e-3 * factor), (iteration, share)
        fixed = dataclasses.replace(config, kl_target=0.0)
        assert float(adapt_learning_rate(fixed, jnp.float32(1e-3), jnp.float32(9.0), 0)) == pytest.approx(1e-3)


@given(st.integers(1, 6), st.integers(1, 40))
def test_any_split_into_batches_gives_the_same_statistics(parts, size):
    data = np.random.default_rng(size).normal(size=(parts * size, 2)).astype(np.float32)
    stats = init_stats((2,))
    for batch in np.split(data, parts):
        stats = merged(stats, batch)
    np.testing.assert_allclose(stats.mean, data.mean(0), rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(stats.variance, data.var(0), rtol=1e-3, atol=1e-5)
