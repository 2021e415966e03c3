"""Evaluations during training: when they happen, which policy they choose, and when they end a training."""

import copy
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
    """A run whose clock stands at 100 s, and whose evaluations return what `returns` has."""
    monkeypatch.setattr(time, "perf_counter", lambda: 100.0)

    def evaluator(params, *, episodes, seed):
        assert (episodes, seed) == (10, trainer.SELECTION_SEED)
        return {"return": {"value": run.returns.pop(0)}, "held": {"value": 1.0}, "task": {}, "seconds": run.takes}, None

    run = Run(TinyEnv(), ARGUMENTS, RunFolder(tmp_path), 0.0)
    run.evaluator, run.returns, run.takes = evaluator, [], 1.0
    return run


def evaluate(run, monkeypatch, *returns):
    """Evaluate one policy after another; the iterations whose policy became the best."""
    saved = []
    for iteration, value in enumerate(returns):
        policy = types.SimpleNamespace(params=None, save=lambda path, i=iteration: saved.append((i, path)))
        monkeypatch.setattr(run, "_policy", lambda _, policy=policy: policy)
        run.returns.append(value)
        run._evaluate(None, iteration)
    assert all(path == run.folder.best for _, path in saved)
    return [i for i, _ in saved]


def test_the_best_policy_is_the_one_with_the_highest_return(run, monkeypatch):
    assert evaluate(run, monkeypatch, 3.0, 2.0, 5.0, 5.0) == [0, 2]
    assert run.best == {"return": 5.0, "iteration": 2}


def test_training_ends_after_evaluations_in_a_row_without_a_better_return(run, monkeypatch):
    evaluate(run, monkeypatch, 3.0, 2.0, 4.0, 1.0)
    assert not run._is_over(8)
    evaluate(run, monkeypatch, 4.0)
    assert run._is_over(8)
    run.arguments = dataclasses.replace(ARGUMENTS, patience=0)
    assert not run._is_over(8)


def test_evaluations_keep_to_their_share_of_the_time(run, monkeypatch):
    """A tenth of 100 s: one evaluation must leave room for the one at the end. The first one's time is compilation."""
    assert run._is_evaluation_due(2) and not run._is_evaluation_due(3)
    run.takes = 60.0
    evaluate(run, monkeypatch, 1.0)
    assert run._is_evaluation_due(4)
    run.takes = 3.0
    evaluate(run, monkeypatch, 1.0)
    assert run._is_evaluation_due(6), "3 s, and two more"
    evaluate(run, monkeypatch, 1.0)
    assert not run._is_evaluation_due(8), "6 s, and two more"


def test_a_return_that_is_not_a_number_is_no_best_to_beat(run, monkeypatch):
    nan = float("nan")
    assert evaluate(run, monkeypatch, nan, 3.0, nan, 2.0, 4.0) == [0, 1, 4]


@pytest.mark.parametrize("own", [False, True])
def test_an_evaluation_is_of_the_task_as_configured(own, tmp_path, monkeypatch):
    """Not of training's corners."""
    import dexsim

    made = []
    monkeypatch.setattr(dexsim, "make", lambda *a, **options: made.append((a, options)) or TinyEnv(), raising=False)
    env = TinyEnv()
    env.backend, env.hand = "c", "the hand"
    arguments = dataclasses.replace(ARGUMENTS, evaluation_chunk=6)
    if own:
        monkeypatch.setattr(trainer, "training_config", lambda arguments: copy.copy(arguments.env))
    run = Run(env, arguments, RunFolder(tmp_path), 0.0)
    if own:
        options = {"backend": "c", "hand": "the hand"}
        assert made == [(("tiny", arguments.env), options)] and run.evaluator.env is not env
    else:
        assert not made and run.evaluator.env is env
    assert run.evaluator.chunk == 6
