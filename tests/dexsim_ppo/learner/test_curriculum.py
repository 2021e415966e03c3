"""The curriculum: ranges that widen with success, carried in the training state."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tiny_env import SMALL, TinyConfig, TinyEnv

from dexsim.core.errors import ConfigError
from dexsim_ppo.learner.config import CurriculumConfig
from dexsim_ppo.learner.ppo import make_train, update_scale

RULES = CurriculumConfig(on=True, start=0.5, widen_above=0.9, narrow_below=0.3, step=0.1)


class Together(TinyEnv):
    """All episodes begin and end together."""

    def randomize_episode_time(self, state, key):
        return state


def run(env, rules, iterations):
    training = make_train(env, SMALL, rules)
    state, rows = training.init(jax.random.key(0)), []
    for _ in range(iterations):
        state, metrics = training.step(state)
        rows.append({name: float(value[0]) for name, value in metrics.items()})
    assert training.step._cache_size() == 1
    return state, rows


def test_ranges_widen_with_success_and_episodes_update_scale():
    state, rows = run(Together(TinyConfig(horizon=4)), RULES, 7)
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
