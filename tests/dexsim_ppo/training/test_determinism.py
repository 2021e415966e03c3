"""Two runs from one seed are the same to the last bit: on a CPU always, on a GPU with `--deterministic`."""

import subprocess
import sys

import jax
import numpy as np
import pytest
from paths import ROOT

from dexsim_ppo import checkpoint
from dexsim_ppo.training.runlog import RunFolder


def bits(tree):
    """The bytes of all arrays."""
    is_key = lambda x: jax.dtypes.issubdtype(x.dtype, jax.dtypes.prng_key)  # noqa: E731
    return [np.asarray(jax.random.key_data(x) if is_key(x) else x).tobytes() for x in jax.tree.leaves(tree)]


@pytest.mark.gpu
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
