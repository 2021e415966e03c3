"""Training on a GPU: numbers stay finite, hands touch, episodes end and begin; `--deterministic` repeats to the bit."""

import dataclasses
import subprocess
import sys

import jax
import numpy as np
import pytest
from paths import ROOT

import dexsim
from dexsim.tasks.grasp.config import GraspConfig
from dexsim_ppo import checkpoint
from dexsim_ppo.learner.ppo import make_train
from dexsim_ppo.training.presets import find_preset
from dexsim_ppo.training.runlog import RunFolder

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


def bits(tree):
    """The bytes of all arrays."""
    is_key = lambda x: jax.dtypes.issubdtype(x.dtype, jax.dtypes.prng_key)  # noqa: E731
    return [np.asarray(jax.random.key_data(x) if is_key(x) else x).tobytes() for x in jax.tree.leaves(tree)]


def test_training_on_a_gpu_repeats_to_the_bit(tmp_path):
    """Each run in a process of its own, which starts XLA anew."""
    command = [sys.executable, "-m", "dexsim_ppo.train", "--task", "grasp", "--deterministic", "--preset", "gpu"]
    command += ["--ppo.num-envs", 64, "--ppo.rollout-length", 16, "--ppo.iterations-per-call", 1]
    command += ["--steps", 64 * 16 * 2, "--env.pool-size", 80, "--env.episode-seconds", 0.6, "--no-video"]
    command += ["--evaluation-chunk", 32, "--evaluation-episodes", 32, "--evaluate-every", 0, "--run-dir"]
    saved = []
    for name in ("first", "second"):
        folder = RunFolder(tmp_path / name)
        subprocess.run([str(part) for part in [*command, folder.path]], cwd=ROOT, check=True)
        saved.append(checkpoint.load(folder.latest_checkpoint(), kind="train").leaves)
    assert saved[0].keys() == saved[1].keys() and bits(saved[0]) == bits(saved[1])
