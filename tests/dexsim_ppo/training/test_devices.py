"""The command in two processes, and one of them killed: the training of one device, up to the order of sums."""

import os
import socket
import subprocess
import sys
import time

import jax
import numpy as np
import pytest
import tiny_train
from paths import ROOT

from dexsim_ppo import checkpoint, train
from dexsim_ppo.training.runlog import RunFolder

OPTIONS = [*tiny_train.QUICK, "--checkpoint-every", "5"]
ITERATIONS = 20
STEPS = ["--steps", str(ITERATIONS * 16 * 8)]


@pytest.fixture(autouse=True)
def tiny_task(monkeypatch):
    tiny_train.install(monkeypatch)


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


def last_state(folder):
    """All numbers of the last checkpoint, by path; random keys as their data."""
    leaves = checkpoint.load(folder.latest_checkpoint(), kind="train").leaves
    return {
        name: np.asarray(jax.random.key_data(x) if jax.numpy.issubdtype(x.dtype, jax.dtypes.prng_key) else x)
        for name, x in leaves.items()
    }


@pytest.mark.slow
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
    mine, theirs = last_state(folder), last_state(tiny_train.finished_run(tmp_path / "alone", *OPTIONS, *STEPS))
    assert mine.keys() == theirs.keys() and int(mine[".iteration"]) == ITERATIONS
    assert not np.array_equal(mine[".params.log_std"], np.full(1, np.log(0.6), np.float32))
    for name, leaf in mine.items():
        np.testing.assert_allclose(leaf, theirs[name], rtol=2e-3, atol=2e-4, err_msg=name)
