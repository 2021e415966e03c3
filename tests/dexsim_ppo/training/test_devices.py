"""The command on several devices and in two processes: the training of one device, up to the order of sums."""

import json
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
from dexsim_ppo.policy import load_policy
from dexsim_ppo.training.runlog import RunFolder

OPTIONS = [*tiny_train.QUICK, "--checkpoint-every", "5"]
ITERATIONS = 20
STEPS = ["--steps", str(ITERATIONS * 16 * 8)]


@pytest.fixture(autouse=True)
def tiny_task(monkeypatch):
    tiny_train.install(monkeypatch)


@pytest.fixture(scope="module")
def alone(tmp_path_factory):
    """A finished run on one device."""
    return tiny_train.finished_run(tmp_path_factory.mktemp("alone") / "run", *OPTIONS, *STEPS)


def start(*options, devices=1, **environment):
    """The command in a process of its own, with this many CPU devices."""
    flags = f"{os.environ.get('XLA_FLAGS', '')} --xla_force_host_platform_device_count={devices}"
    environment |= {"PYTHONPATH": f"{ROOT}:{ROOT / 'tests/support'}", "XLA_FLAGS": flags, "PYTHONUNBUFFERED": "1"}
    return subprocess.Popen(
        [sys.executable, str(ROOT / "tests/support/tiny_train.py"), *map(str, options)],
        env={**os.environ, **environment},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def start_two(*options):
    """Two processes of one device each, as Slurm starts them."""
    with socket.socket() as free:
        free.bind(("localhost", 0))
        port = str(free.getsockname()[1])
    job = {"SLURM_JOB_ID": "1", "SLURM_STEP_NODELIST": "localhost", "SLURM_NTASKS": "2", "JAX_COORDINATOR_PORT": port}
    numbers = [{"SLURM_PROCID": str(i), "SLURM_LOCALID": str(i)} for i in range(2)]
    return [start(*options, "--devices", 2, **job, **number) for number in numbers]


def last_state(folder):
    """All numbers of the last checkpoint, by path; random keys as their data."""
    leaves = checkpoint.load(folder.latest_checkpoint(), kind="train").leaves
    return {
        name: np.asarray(jax.random.key_data(x) if jax.numpy.issubdtype(x.dtype, jax.dtypes.prng_key) else x)
        for name, x in leaves.items()
    }


def assert_same_training(folder, other):
    mine, theirs = last_state(folder), last_state(other)
    assert mine.keys() == theirs.keys() and int(mine[".iteration"]) == ITERATIONS
    assert not np.array_equal(mine[".params.log_std"], np.full(1, np.log(0.6), np.float32))
    for name, leaf in mine.items():
        np.testing.assert_allclose(leaf, theirs[name], rtol=2e-3, atol=2e-4, err_msg=name)


@pytest.mark.slow
def test_two_processes_train_as_one_and_the_first_alone_writes(alone, tmp_path):
    runs = start_two(*OPTIONS, *STEPS, "--run-dir", tmp_path / "run")
    said = [run.communicate(timeout=120) for run in runs]
    assert [run.returncode for run in runs] == [0, 0], said
    folder = RunFolder(tmp_path / "run")
    assert_same_training(folder, alone)
    assert "report:" in said[0][0] and "report" not in said[1][0]
    assert load_policy(folder.last).training["iteration"] == ITERATIONS
    report = json.loads(folder.report.read_text())
    assert report["trained"]["return"]["value"] == pytest.approx(
        json.loads(alone.report.read_text())["trained"]["return"]["value"], rel=1e-2
    )


@pytest.mark.slow
def test_a_killed_process_ends_the_run_and_it_can_be_resumed(alone, tmp_path):
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
    assert_same_training(folder, alone)
