"""Evaluations of kind "totals": the metrics of each episode's last tick, that of its end included."""

import jax.numpy as jnp
import numpy as np

from dexsim_ppo.evaluate import _follow


def test_the_tick_that_ends_an_episode_counts_and_none_after_it():
    """Three episodes: one ends in tick 2, one in the first tick, one never. Its last metrics are those of that tick."""
    ends = np.array([[False, True, False], [True, False, False], [True, True, False], [False, False, False]])
    last = {"return": jnp.zeros(3)}, jnp.zeros(3, jnp.int32), jnp.zeros(3, bool)
    for tick, ended in enumerate(ends):
        last = _follow(last, {"return": jnp.full(3, 10.0 * (tick + 1))}, jnp.asarray(ended))
    metrics, lived, ended = last
    np.testing.assert_array_equal(metrics["return"], [20.0, 10.0, 40.0])
    np.testing.assert_array_equal(lived, [1, 0, 4])
    np.testing.assert_array_equal(ended, [True, True, False])
