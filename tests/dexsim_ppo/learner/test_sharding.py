"""Training on several devices is the training on one, up to the order of sums."""

import dataclasses
import os
import re
import subprocess
import sys

import jax
import numpy as np
import pytest
from paths import ROOT
from tiny_env import SMALL, TinyEnv

from dexsim.core.errors import ConfigError
from dexsim_ppo.learner.ppo import make_train
from dexsim_ppo.learner.sharding import make_mesh

# A GRU's carry is split as the environments are; `training/test_devices.py` has a policy without.
CONFIG = dataclasses.replace(SMALL, num_envs=16, memory="gru", memory_size=4)


def trained(devices, iterations):
    """All numbers of the state after some iterations, and how many devices hold the environments."""
    training = make_train(TinyEnv(), CONFIG, mesh=make_mesh(devices, CONFIG))
    state = training.init(jax.random.key(0))
    for _ in range(iterations):
        state, _ = training.step(state)
    used = len(state.env_state.x.sharding.device_set)
    assert state.carry.sharding.device_set == state.env_state.x.sharding.device_set
    keys = dataclasses.replace(state.env_state, key=jax.random.key_data(state.env_state.key))
    state = dataclasses.replace(state, key=jax.random.key_data(state.key), env_state=keys)
    return [np.asarray(leaf) for leaf in jax.tree.leaves(state)], used


def run(tmp_path, devices, iterations):
    """`trained` in a process with so many devices."""
    done = subprocess.run(
        [sys.executable, __file__, str(tmp_path), str(devices), str(iterations)],
        env={
            **os.environ,
            "PYTHONPATH": f"{ROOT}:{ROOT / 'tests/support'}",
            "XLA_FLAGS": f"{os.environ.get('XLA_FLAGS', '')} --xla_force_host_platform_device_count={devices}",
        },
        capture_output=True,
        text=True,
        timeout=400,
    )
    assert done.returncode == 0, done.stderr
    return np.load(tmp_path / f"{devices}.npz")


def test_two_devices_train_as_one(tmp_path):
    """Else gradients or statistics are those of one device's environments."""
    two, (alone, used) = run(tmp_path, 2, 3), trained(1, 3)
    assert used == 1 and int(two["used"]) == 2
    for i, leaf in enumerate(alone):
        np.testing.assert_allclose(two[str(i)], leaf, rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize(
    ("changes", "devices", "processes", "message"),
    [
        ({"num_envs": 12, "minibatches": 16, "memory": "none"}, 4, 1, "PPOConfig.minibatches = 16: leaves 6 rows each"),
        ({}, 5, 1, "TrainArguments.devices = 5: expected at most 4 in 1 processes"),
        ({}, 2, 2, "devices = 2: expected at most 4 in 2 processes"),  # one without a device would wait for ever
    ],
)
def test_every_device_gets_as_many_environments_and_rows(changes, devices, processes, message, monkeypatch):
    monkeypatch.setattr(jax, "devices", lambda: list("abcd"))
    monkeypatch.setattr(jax, "process_count", lambda: processes)
    with pytest.raises(ConfigError, match=re.escape(message)):
        make_mesh(devices, dataclasses.replace(CONFIG, **changes))


if __name__ == "__main__":
    folder, devices, iterations = sys.argv[1], int(sys.argv[2]), int(sys.argv[3])
    leaves, used = trained(devices, iterations)
    np.savez(f"{folder}/{devices}.npz", used=used, **{str(k): leaf for k, leaf in enumerate(leaves)})
