"""Two processes, one of them killed: the training of one device, up to the order of sums. On a GPU numbers stay finite,
episodes end and begin; `--deterministic` repeats to the bit."""

import os
import socket
import subprocess
import sys
import time

import numpy as np
import pytest
import tiny_train
from paths import ROOT
from tiny_env import leaves

from dexsim_ppo import checkpoint, train
from dexsim_ppo.training.runlog import RunFolder, read_metrics

OPTIONS = [*tiny_train.QUICK, "--checkpoint-every", "5"]
ITERATIONS = 20
STEPS = ["--steps", str(ITERATIONS * 16 * 8)]


def start_two(*options):
    """Two processes of one device each, as Slurm starts them."""
    with socket.socket() as free:
        free.bind(("localhost", 0))
        port = str(free.getsockname()[1])
    job = {"SLURM_JOB_ID": "1", "SLURM_STEP_NODELIST": "localhost", "SLURM_NTASKS": "2", "JAX_COORDINATOR_PORT": port}
    path = {"PYTHONPATH": f"{ROOT}:{ROOT / 'tests/support'}", "PYTHONUNBUFFERED": "1"}
    path["XLA_FLAGS"] = os.environ.get("XLA_FLAGS", "").replace("device_count=2", "device_count=1")
    command = [sys.executable, str(ROOT / "tests/support/tiny_train.py"), *map(str, options), "--devices", "2"]
    numbers = [{"SLURM_PROCID": str(i), "SLURM_LOCALID": str(i)} for i in range(2)]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    return [subprocess.Popen(command, env={**os.environ, **job, **path, **number}, **pipes) for number in numbers]


@pytest.mark.slow
@pytest.mark.usefixtures("tiny_task")
def test_a_killed_process_ends_the_run_and_it_can_be_resumed(tmp_path):
    folder = RunFolder(tmp_path / "run")
    runs = start_two(*OPTIONS, "--minutes", 3, "--keep-checkpoints", 1000, "--run-dir", folder.path)
    try:
        deadline = time.monotonic() + 100
        while not folder.checkpoint(5).exists() and time.monotonic() < deadline:
            time.sleep(0.1)
        runs[1].kill()
        _, error = runs[0].communicate(timeout=100)
    finally:
        for run in runs:
            run.kill()
            run.communicate()
    assert runs[0].returncode == 2, error
    for path in folder.existing_checkpoints():
        if path != folder.checkpoint(5):
            path.unlink()
    assert train.main(["--resume", str(folder.path), *STEPS, "--minutes", "0", "--devices", "1"]) == 0
    alone = tiny_train.finished_run(tmp_path / "alone", *OPTIONS, *STEPS)
    mine, theirs = (leaves(checkpoint.load(run.latest_checkpoint(), kind="train").leaves) for run in (folder, alone))
    assert mine.keys() == theirs.keys() and int(mine["['.iteration']"]) == ITERATIONS
    assert not np.array_equal(mine["['.params.log_std']"], np.full(1, np.log(0.6), np.float32))
    for name, leaf in mine.items():
        np.testing.assert_allclose(leaf, theirs[name], rtol=2e-3, atol=2e-4, err_msg=name)


ENVS, TICKS = 64, 16  # rollouts on a GPU


@pytest.mark.gpu
def test_training_on_a_gpu_repeats_to_the_bit(tmp_path):
    """Each run in a process of its own, which starts XLA anew."""
    command = [sys.executable, "-m", "dexsim_ppo.train", "--task", "grasp", "--deterministic", "--preset", "gpu"]
    command += ["--ppo.num-envs", ENVS, "--ppo.rollout-length", TICKS, "--ppo.iterations-per-call", 1]
    command += ["--steps", ENVS * TICKS * 2, "--env.pool-size", 80, "--env.episode-seconds", 0.6, "--no-video"]
    command += ["--evaluation-chunk", 32, "--evaluation-episodes", 32, "--evaluate-every", 0, "--log-every", 1]
    saved = []
    for name in ("first", "second"):
        folder = RunFolder(tmp_path / name)
        subprocess.run([str(part) for part in [*command, "--run-dir", folder.path]], cwd=ROOT, check=True)
        saved.append(checkpoint.load(folder.latest_checkpoint(), kind="train").leaves)
    bits = [{name: leaf.tobytes() for name, leaf in leaves(one).items()} for one in saved]
    assert bits[0] == bits[1]
    rows = read_metrics(folder.metrics)
    assert len(rows) == 2 and rows[-1]["skipped_updates"] == 0
    for name in ("policy_loss", "value_loss", "kl", "explained_variance"):
        assert all(np.isfinite(row[name]) for row in rows), name
    assert sum(row["episodes"] for row in rows) >= ENVS, "episodes of 20 ticks end within 32 ticks"
    assert np.max(saved[0][".env_state.finger_force"]) > 0.5, "no hand has touched anything"
