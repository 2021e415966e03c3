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
from dexsim_ppo.learner.sharding import make_mesh
from dexsim_ppo.learner.ppo import make_train

sys.path.insert(0, str(ROOT / "benchmarks"))
from collectives import received

# A GRU's memory is split as the environments are; `training/test_devices.py` has a policy without.
CONFIG = dataclasses.replace(SMALL, num_envs=16, iterations_per_call=10, memory="gru", memory_size=4)
CASES = (2, "jax"), (8, "jax"), (4, "warp")  # with Warp each device collects in a program of its own
PLAIN = dataclasses.replace(CONFIG, memory="none")


def make(devices, backend="jax", config=CONFIG):
    return make_train(TinyEnv(backend=backend), config, mesh=make_mesh(devices, config))


def trained(training):
    """All numbers of the state after 20 iterations, and how many devices hold the environments."""
    state = training.init(jax.random.key(0))
    for _ in range(2):
        state, _ = training.step(state)
    used = len(state.env_state.x.sharding.device_set)
    assert state.memory.sharding.device_set == state.env_state.x.sharding.device_set
    state = dataclasses.replace(state, key=jax.random.key_data(state.key))
    state = dataclasses.replace(
        state, env_state=dataclasses.replace(state.env_state, key=jax.random.key_data(state.env_state.key))
    )
    return [np.asarray(leaf) for leaf in jax.tree.leaves(state)], used


def communicated(devices, backend="jax"):
    """Bytes that a device receives in a call of a training without memory, and the arrays in each of its reductions."""
    training = make(devices, backend, PLAIN)
    text = training.step.lower(training.shapes(jax.random.key(0))).compile().as_text()
    return received(text)[0], [shapes.count("[") for shapes in re.findall(r"= (.*?) all-reduce(?:-start)?\(", text)]


@pytest.mark.slow
def test_one_two_and_eight_devices_agree_and_each_repeats_itself_to_the_bit(tmp_path):
    """In a process with eight devices, against the training without a mesh in this one."""
    done = subprocess.run(
        [sys.executable, __file__, str(tmp_path)],
        env={
            **os.environ,
            "PYTHONPATH": f"{ROOT}:{ROOT / 'tests/support'}",
            "XLA_FLAGS": f"{os.environ.get('XLA_FLAGS', '')} --xla_force_host_platform_device_count=8",
        },
        capture_output=True,
        text=True,
        timeout=200,
    )
    assert done.returncode == 0, done.stderr
    alone, used = trained(make(1))
    assert used == 1 and communicated(1) == (0, [])
    for devices, backend in CASES:
        first, again = (np.load(tmp_path / f"{devices}-{backend}-{name}.npz") for name in ("first", "again"))
        assert int(first["used"]) == devices
        for i, leaf in enumerate(alone):
            np.testing.assert_allclose(first[str(i)], leaf, rtol=2e-3, atol=2e-4)
            np.testing.assert_array_equal(again[str(i)], first[str(i)])
        # Of the experience only the rewards, of which one may be a fault; else gradients and sums.
        shapes = make_train(TinyEnv(), PLAIN).shapes(jax.random.key(0)).params
        gradients = CONFIG.epochs * CONFIG.minibatches * sum(leaf.size for leaf in jax.tree.leaves(shapes))
        iterations = 1 if backend == "warp" else CONFIG.iterations_per_call  # in the program
        least = iterations * 4 * (devices - 1) / devices * (CONFIG.steps_per_iteration + 2 * gradients)
        assert least < float(first["received"]) < 1.25 * least
        # Each array of a reduction costs processes on CPUs milliseconds: all gradients are one.
        assert first["arrays"].sum() <= 25


def test_what_does_not_divide_is_refused():
    with pytest.raises(ConfigError, match=r"TrainArguments\.devices = 4096: there are"):
        make_mesh(4096, CONFIG)
    assert make_mesh(1, CONFIG) is None


@pytest.mark.parametrize(
    ("changes", "devices", "message"),
    [
        ({}, 0, None),
        ({}, 3, "PPOConfig.num_envs = 16: must be a multiple of the 3 devices"),
        (
            {"num_envs": 12, "minibatches": 16, "memory": "none"},
            4,
            "PPOConfig.minibatches = 16: leaves 6 steps each, no multiple of the 4",
        ),
        ({}, 5, "TrainArguments.devices = 5: there are 4, in 1 processes"),
    ],
)
def test_every_device_gets_as_many_environments_and_rows(changes, devices, message, monkeypatch):
    monkeypatch.setattr(jax, "devices", lambda: list("abcd"))
    monkeypatch.setattr(jax, "make_mesh", lambda shape, names, *, devices, **_: (shape, devices))
    config = dataclasses.replace(CONFIG, **changes)
    if message:
        with pytest.raises(ConfigError, match=re.escape(message)):
            make_mesh(devices, config)
    else:
        assert make_mesh(devices, config) == ((4,), list("abcd"))
        assert make_mesh(2, config) == ((2,), list("ab"))
        monkeypatch.setattr(jax, "process_count", lambda: 2)
        with pytest.raises(ConfigError, match="devices = 2: there are 4, in 2 processes"):
            make_mesh(2, config)  # a process without a device would wait for ever


if __name__ == "__main__":
    for devices, backend in CASES:
        training, (size, arrays) = make(devices, backend), communicated(devices, backend)
        for name in ("first", "again"):
            leaves, used = trained(training)
            numbers = {str(k): leaf for k, leaf in enumerate(leaves)}
            file = f"{sys.argv[1]}/{devices}-{backend}-{name}.npz"
            np.savez(file, used=used, received=size, arrays=arrays, **numbers)
