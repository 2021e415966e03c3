"""Training on several devices is the training on one, up to the order of sums."""

import dataclasses
import re

import jax
import numpy as np
import pytest
from tiny_env import SMALL, TinyEnv, leaves

from dexsim.errors import ConfigError
from dexsim_ppo.learner.ppo import make_train
from dexsim_ppo.learner.sharding import make_mesh

# A GRU's carry is split as the environments are; `training/test_devices.py` has a policy without.
CONFIG = dataclasses.replace(SMALL, num_envs=16, memory="gru", memory_size=4)


def trained(devices):
    """All numbers of the state after three iterations, and how many devices hold the environments."""
    training = make_train(TinyEnv(), CONFIG, mesh=make_mesh(devices, CONFIG))
    state = training.init(jax.random.key(0))
    for _ in range(3):
        state, _ = training.step(state)
    used = state.env_state.x.sharding.device_set
    assert state.carry.sharding.device_set == used
    return leaves(state), len(used)


@pytest.mark.skipif(len(jax.devices()) < 2, reason="needs two devices")
def test_two_devices_train_as_one():
    """Else gradients or statistics are those of one device's environments."""
    (two, used), (alone, one) = trained(2), trained(1)
    assert (one, used) == (1, 2)
    for name, leaf in two.items():
        np.testing.assert_allclose(leaf, alone[name], rtol=1e-3, atol=1e-4, err_msg=name)


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
