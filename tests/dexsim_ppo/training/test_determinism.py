"""Two trainings from one seed are the same to the last bit: on a CPU always, on a GPU with `--deterministic`."""

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


def plain(tree):
    """A tree's arrays by their path."""
    keys = jax.tree.map(
        lambda x: jax.random.key_data(x) if jax.dtypes.issubdtype(x.dtype, jax.dtypes.prng_key) else x, tree
    )
    return {jax.tree_util.keystr(path): np.asarray(x) for path, x in jax.tree.leaves_with_path(keys)}


def unequal(first, second):
    """Paths of the arrays that differ in any bit."""
    assert first.keys() == second.keys()
    return [path for path, x in first.items() if x.tobytes() != second[path].tobytes()]


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
        return plain(state)

    assert not unequal(train_from(0), train_from(0))
    assert unequal(train_from(0), train_from(1)), "else the comparison sees nothing"


@pytest.mark.gpu
def test_training_on_a_gpu_repeats_to_the_bit(tmp_path):
    """Each training in a process of its own, which starts XLA anew."""
    command = [sys.executable, "-m", "dexsim_ppo.train", "--task", "grasp", "--deterministic", "--preset", "gpu"]
    command += ["--ppo.num-envs", 64, "--ppo.rollout-length", 16, "--ppo.iterations-per-call", 1]
    command += ["--steps", 64 * 16 * 2, "--env.pool-size", 80, "--env.episode-seconds", 0.6, "--no-video"]
    command += ["--evaluation-chunk", 32, "--evaluation-episodes", 32, "--evaluate-every", 0, "--run-dir"]
    found = []
    for name in ("first", "second"):
        folder = RunFolder(tmp_path / name)
        subprocess.run([str(part) for part in [*command, folder.path]], cwd=ROOT, check=True)
        saved = checkpoint.load(folder.latest_checkpoint(), kind="train")
        found.append(plain(saved.leaves))
    assert unequal(*found) == []
