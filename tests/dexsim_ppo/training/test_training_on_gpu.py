"""Training on a GPU: numbers stay finite, episodes end and begin; `--deterministic` repeats to the bit."""

import subprocess
import sys

import jax
import numpy as np
import pytest
from paths import ROOT

from dexsim_ppo import checkpoint
from dexsim_ppo.training.runlog import RunFolder, read_metrics

pytestmark = pytest.mark.gpu

ENVS, STEPS, ITERATIONS = 64, 16, 2


def bits(tree):
    """The bytes of all arrays."""
    is_key = lambda x: jax.dtypes.issubdtype(x.dtype, jax.dtypes.prng_key)  # noqa: E731
    return [np.asarray(jax.random.key_data(x) if is_key(x) else x).tobytes() for x in jax.tree.leaves(tree)]


def test_training_on_a_gpu_repeats_to_the_bit(tmp_path):
    """Each run in a process of its own, which starts XLA anew."""
    command = [sys.executable, "-m", "dexsim_ppo.train", "--task", "grasp", "--deterministic", "--preset", "gpu"]
    command += ["--ppo.num-envs", ENVS, "--ppo.rollout-length", STEPS, "--ppo.iterations-per-call", 1, "--log-every", 1]
    command += ["--steps", ENVS * STEPS * ITERATIONS, "--env.pool-size", 80, "--env.episode-seconds", 0.6, "--no-video"]
    command += ["--evaluation-chunk", 32, "--evaluation-episodes", 32, "--evaluate-every", 0, "--run-dir"]
    saved = []
    for name in ("first", "second"):
        folder = RunFolder(tmp_path / name)
        subprocess.run([str(part) for part in [*command, folder.path]], cwd=ROOT, check=True)
        saved.append(checkpoint.load(folder.latest_checkpoint(), kind="train").leaves)
    assert saved[0].keys() == saved[1].keys() and bits(saved[0]) == bits(saved[1])
    rows = read_metrics(folder.metrics)
    assert len(rows) == ITERATIONS and rows[-1]["skipped_updates"] == 0
    for name in ("policy_loss", "value_loss", "kl", "explained_variance"):
        assert all(np.isfinite(row[name]) for row in rows), name
    assert sum(row["episodes"] for row in rows) >= ENVS, "episodes of 20 ticks end within 32 ticks"
    assert np.max(saved[0][".env_state.finger_force"]) > 0.5, "no hand has touched anything"
