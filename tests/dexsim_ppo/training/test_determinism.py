"""Two runs from one seed are the same to the last bit: on a CPU always, on a GPU with `--deterministic`."""

import subprocess
import sys

import jax
import numpy as np
import pytest
from paths import ROOT

import dexsim
from dexsim.tasks.grasp.config import GraspConfig
from dexsim_ppo import checkpoint
from dexsim_ppo.learner.config import PPOConfig
from dexsim_ppo.learner.ppo import make_train
from dexsim_ppo.training.runlog import RunFolder


def bits(tree):
    """The bytes of all arrays."""
    is_key = lambda x: jax.dtypes.issubdtype(x.dtype, jax.dtypes.prng_key)  # noqa: E731
    return [np.asarray(jax.random.key_data(x) if is_key(x) else x).tobytes() for x in jax.tree.leaves(tree)]


@pytest.mark.slow
def test_training_on_c_repeats_to_the_bit():
    """Though its worlds are stepped by several threads."""
    env = dexsim.make("grasp", GraspConfig(pool_size=80, episode_seconds=0.6), backend="c")
    training = make_train(
        env, PPOConfig(num_envs=8, rollout_length=8, minibatches=2, actor_layers=(8,), critic_layers=(8,))
    )

    def train_from(seed):
        state = training.init(jax.random.key(seed))
        for _ in range(3):
            state, _ = training.step(state)
        return bits(state)

    assert train_from(0) == train_from(0) != train_from(1)


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
