"""Evaluations during training: when they happen, which policy they choose, and when they end a training run."""

import dataclasses
import time
import types

import pytest
from tiny_env import SMALL, TinyConfig, TinyEnv

from dexsim_ppo.training import trainer
from dexsim_ppo.training.arguments import TrainArguments
from dexsim_ppo.training.runlog import RunFolder
from dexsim_ppo.training.trainer import Run

ARGUMENTS = TrainArguments(
    env=TinyConfig(), ppo=SMALL, task="tiny", evaluate_every=2, evaluation_chunk=10, patience=2, evaluation_share=0.1
)


@pytest.fixture
def run(tmp_path, monkeypatch):
    """A run at 100 s; `run.evaluate(return, ...)` evaluates one policy after another, and gives the numbers of those
    that were saved as the best."""
    monkeypatch.setattr(time, "perf_counter", lambda: 100.0)
    run, saved = Run(TinyEnv(), ARGUMENTS, RunFolder(tmp_path), 0.0), []

    def evaluate(*returns, takes=1.0):
        for number, value in enumerate(returns):
            report = {"return": {"value": value}, "held": {"value": 1.0}, "task": {}, "seconds": takes}
            run.evaluator = lambda *_, report=report, **given: (report, given["seed"] == trainer.SELECTION_SEED)
            policy = types.SimpleNamespace(params=None, save=lambda path, number=number: saved.append((number, path)))
            monkeypatch.setattr(run, "_policy", lambda _, policy=policy: policy)
            run._evaluate(None, number)
        assert all(path == run.folder.best for _, path in saved)
        return [number for number, _ in saved]

    run.evaluate = evaluate
    return run


def test_the_best_policy_is_the_one_with_the_highest_return(run):
    assert run.evaluate(float("nan"), 3.0, float("nan"), 2.0, 4.0, 4.0) == [0, 1, 4]
    assert run.best == {"return": 4.0, "iteration": 4}


def test_training_ends_after_evaluations_in_a_row_without_a_better_return(run):
    run.evaluate(3.0, 2.0, 4.0, 1.0)
    assert not run._is_over(8)
    run.evaluate(4.0)
    assert run._is_over(8)
    run.arguments = dataclasses.replace(ARGUMENTS, patience=0)
    assert not run._is_over(8)
