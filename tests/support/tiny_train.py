"""The training command with the tiny task among its tasks; arguments as on the command line."""

import functools
import types

import pytest
from tiny_env import TinyConfig, TinyEnv, make_env, make_evaluator, make_train

import dexsim
from dexsim import registry
from dexsim_ppo import evaluate
from dexsim_ppo.training import trainer

ENTRY = types.SimpleNamespace(config_class=TinyConfig, config=TinyConfig, task=TinyEnv, environment=None)

# With the learner `tiny_env.SMALL`.
QUICK = "--task tiny --preset cpu --no-video --ppo.num-envs 16 --ppo.rollout-length 8 --ppo.actor-layers 8".split()
QUICK += "--ppo.critic-layers 8 --ppo.minibatches 2 --ppo.epochs 2".split()
QUICK += "--evaluation-chunk 16 --evaluation-episodes 16".split()
PER_ITERATION = 16 * 8  # steps of QUICK


def make(env_class, task, config=None, **_):
    assert task == "tiny"
    return make_env(env_class, config or TinyConfig())


def install(patch, env_class=TinyEnv):
    """Put the task among the tasks for as long as a `pytest.MonkeyPatch` lasts."""
    tiny = functools.partial(make, env_class)
    patch.setitem(registry.TASKS, "tiny", ENTRY)
    patch.setattr(trainer, "make_train", make_train)
    for module in (trainer, evaluate):
        patch.setattr(module, "Evaluator", make_evaluator)
    patch.setattr(dexsim, "make", tiny)  # first: what it restores is imported from the registry at the first look
    patch.setattr(registry, "make", tiny)


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
    registry.make = dexsim.make = functools.partial(make, TinyEnv)
    cli.run(train.main)
