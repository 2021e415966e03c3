"""The training command with the tiny task among its tasks; arguments as on the command line."""

import types

import pytest
from tiny_env import TinyConfig, TinyEnv

import dexsim
from dexsim import registry

ENTRY = types.SimpleNamespace(config_class=TinyConfig, config=TinyConfig, task=TinyEnv, environment=None)

QUICK = "--task tiny --preset cpu --no-video --ppo.num-envs 16 --ppo.rollout-length 8 --ppo.actor-layers 8".split()
QUICK += "--ppo.critic-layers 8 --evaluation-chunk 16 --evaluation-episodes 16".split()
PER_ITERATION = 16 * 8  # steps of QUICK


def make(task, config=None, *, backend="auto", **_):
    assert task == "tiny"
    return TinyEnv(config, backend=backend)


def install(patch):
    """Put the task among the tasks for as long as a `pytest.MonkeyPatch` lasts."""
    patch.setitem(registry.TASKS, "tiny", ENTRY)
    patch.setattr(registry, "make", make)
    patch.setattr(dexsim, "make", make, raising=False)


def finished_run(path, *arguments):
    """The folder of a run that the command has finished: for fixtures that outlive a test's patches."""
    from dexsim_ppo import train
    from dexsim_ppo.training.runlog import RunFolder

    with pytest.MonkeyPatch.context() as patch:
        install(patch)
        assert train.main([*arguments, "--run-dir", str(path)]) == 0
    return RunFolder(path)


if __name__ == "__main__":
    from dexsim.core import cli
    from dexsim_ppo import train

    registry.TASKS["tiny"] = ENTRY
    registry.make = dexsim.make = make
    cli.run(train.main)
