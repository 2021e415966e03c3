"""What a training needs is known before it is allocated: against the process's own peak, and against a full device."""

import dataclasses
import os
import subprocess
import sys
from types import SimpleNamespace

import jax
import pytest
from paths import ROOT
from tiny_env import SMALL, TinyEnv

from dexsim.errors import ConfigError
from dexsim_ppo import make_train
from dexsim_ppo.training import memory, programs

GIB = 2**30


def program(arguments, output, alias, temp):
    sizes = {"argument": arguments, "output": output, "alias": alias, "temp": temp}
    found = SimpleNamespace(**{f"{name}_size_in_bytes": size for name, size in sizes.items()})
    return SimpleNamespace(memory_analysis=lambda: found)


def test_results_in_the_place_of_arguments_count_once():
    assert memory.needed(program(100, 30, 20, 7)) == 117
    assert memory.needed(lambda state: state) is None
    assert memory.needed(SimpleNamespace(memory_analysis=lambda: None)) is None


def test_a_step_that_cannot_fit_is_refused_with_a_number_that_can(monkeypatch):
    monkeypatch.setattr(memory, "available", lambda: 80 * GIB)
    notes = []
    memory.check(program(11 * GIB, 0, 0, 30 * GIB), 32768, notes.append)
    assert (
        len(notes) == 1 and notes[0].startswith("32768 environments need 41 GiB, ") and notes[0].endswith("has 80 GiB")
    )
    memory.check(program(50 * GIB, 0, 0, 30 * GIB), 32768, notes.append)  # exactly all of it
    with pytest.raises(ConfigError, match=r"need 120 GiB, and .* has 80 GiB for JAX: about 16384 should fit") as error:
        memory.check(program(60 * GIB, 0, 0, 60 * GIB), 32768, notes.append)
    assert "--ppo.num-envs 16384" in str(error.value) and len(notes) == 2
    monkeypatch.setattr(memory, "available", lambda: None)
    memory.check(program(GIB, 0, 0, GIB), 8, notes.append)
    assert notes[-1] == "8 environments need 2 GiB"
    memory.check(program(3 * 2**20, 0, 0, 0), 8, notes.append)
    assert notes[-1] == "8 environments need 3 MiB"


def test_the_device_says_what_it_has():
    gpu = SimpleNamespace(platform="gpu", memory_stats=lambda: {"bytes_limit": 7 * GIB})
    silent = SimpleNamespace(platform="gpu", memory_stats=lambda: None)
    assert memory.available(gpu) == 7 * GIB and memory.available(silent) is None
    assert memory.available(jax.devices("cpu")[0]) == os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")


@pytest.mark.slow
def test_twice_the_environments_need_about_twice_as_much(tmp_path, monkeypatch):
    monkeypatch.setenv("DEXSIM_CACHE", str(tmp_path))

    def need(num_envs, identity):
        config = dataclasses.replace(SMALL, num_envs=num_envs, rollout_length=16)
        training = make_train(TinyEnv(), config)
        shapes = training.shapes(jax.random.key(0))
        return memory.needed(programs.compile_step(training.plain_step, shapes, identity, lambda: None))

    small, large = need(4096, None), need(8192, ["large"])
    assert 1.8 < large / small < 2.1
    assert need(8192, ["large"]) in (large, None)  # a program from the cache says the same, or nothing


# The peak of a process's memory beyond what it had before the step: a program of its own, in a process of its own.
MEASURE = """
import dataclasses, re
import jax
from tiny_env import SMALL, TinyEnv
from dexsim_ppo import make_train
from dexsim_ppo.training import memory, programs
config = dataclasses.replace(SMALL, num_envs=32768, rollout_length=16, actor_layers=(64,), critic_layers=(64,))
training = make_train(TinyEnv(), config)
shapes = training.shapes(jax.random.key(0))
step = programs.compile_step(training.plain_step, shapes, None, lambda: None)
peak = lambda: 1024 * int(re.search(r'VmHWM:\\s+(\\d+)', open('/proc/self/status').read())[1])
before = peak()
state = jax.block_until_ready(training.init(jax.random.key(0)))
state, _ = jax.block_until_ready(step(state))
print(memory.needed(step), peak() - before)
"""


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="Linux tells the peak of a process since it began")
def test_it_is_the_peak_that_is_measured():
    path = os.pathsep.join([str(ROOT), str(ROOT / "tests" / "support")])
    environment = {**os.environ, "PYTHONPATH": path}
    done = subprocess.run([sys.executable, "-c", MEASURE], capture_output=True, text=True, env=environment)
    assert done.returncode == 0, done.stderr
    need, measured = map(int, done.stdout.split())
    print(f"needed {need / 1e6:.0f} MB, measured {measured / 1e6:.0f} MB")
    assert 0.7 < measured / need < 1.2, (need, measured)
