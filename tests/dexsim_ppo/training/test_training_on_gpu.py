"""Training on a GPU: numbers stay finite, hands touch, episodes end and begin."""

import dataclasses

import jax
import numpy as np
import pytest

import dexsim
from dexsim.tasks.grasp.config import GraspConfig
from dexsim_ppo.learner.ppo import make_train
from dexsim_ppo.training.presets import find_preset

pytestmark = pytest.mark.gpu

ENVS, ITERATIONS = 32, 4


def test_some_iterations_of_grasp():
    env = dexsim.make("grasp", GraspConfig(pool_size=64, episode_seconds=0.6), backend="cuda")
    config = dataclasses.replace(
        find_preset("gpu", "grasp").ppo, num_envs=ENVS, rollout_length=8, minibatches=2, iterations_per_call=1
    )
    training = make_train(env, config)
    state = training.init(jax.random.key(0))
    begun, ended, force = jax.tree.map(np.array, state.params), 0.0, []
    for _ in range(ITERATIONS):
        state, metrics = training.step(state)
        ended += np.nansum(np.asarray(metrics["episodes"]))
        force.append(np.asarray(state.env_state.finger_force))
        for name in ("policy_loss", "value_loss", "kl", "explained_variance"):
            assert np.isfinite(np.asarray(metrics[name])).all(), name
    assert int(state.skipped_updates) == 0 and int(state.iteration) == ITERATIONS
    assert ended >= ENVS, "episodes of 20 ticks end within 32 ticks"
    assert np.max(force) > 0.5, "no hand has touched anything"
    moved = jax.tree.map(lambda before, after: np.abs(np.asarray(after) - before).max(), begun, state.params)
    assert np.isfinite(jax.tree.leaves(moved)).all() and max(jax.tree.leaves(moved)) > 1e-4, moved
