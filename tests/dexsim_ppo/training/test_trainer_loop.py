"""What the training loop keeps account of, around a step that learns nothing: when it logs, saves, evaluates, ends."""

import copy
import dataclasses
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import pytest
from tiny_env import SMALL, TinyConfig, TinyEnv

from dexsim.core.pytree import pytree_dataclass
from dexsim_ppo.training import trainer
from dexsim_ppo.training.arguments import TrainArguments
from dexsim_ppo.training.runlog import RunFolder
from dexsim_ppo.training.trainer import Run

CONFIG = dataclasses.replace(SMALL, iterations_per_call=2)
PER_ITERATION = 64
STEP_S, EVALUATION_S, SAVE_S = 2.0, 100.0, 1000.0


@pytree_dataclass
class State:
    """What the loop reads of a state."""

    iteration: jax.Array
    skipped_updates: jax.Array


@pytest.fixture
def loop(tmp_path, monkeypatch):
    """`loop(first, **options)` runs the loop on a clock that only its parts move on; returns the run, whose
    `evaluated`, `saved`, `shown`, `logged` and `notes` say what it did."""
    clock = SimpleNamespace(now=50.0)
    monkeypatch.setattr(trainer, "time", SimpleNamespace(perf_counter=lambda: clock.now))

    def run(first=0, stop_after=10**6, **options):
        clock.now = 50.0
        free = {"evaluation_chunk": 1, "evaluation_share": 1.0}  # what evaluations may cost has tests of its own
        arguments = TrainArguments(env=TinyConfig(), ppo=CONFIG, task="tiny", **free, **options)
        found = Run(TinyEnv(), arguments, RunFolder(tmp_path), 20.0)
        found.evaluated, found.saved, found.shown, found.logged, found.notes, calls = [], [], [], [], [], []

        def step(state):
            calls.append(1)
            clock.now += STEP_S
            state = State(state.iteration + 2, state.skipped_updates)
            return state, {"reward": jnp.array([1.0, 3.0]), "skipped_updates": jnp.zeros(2)}

        def evaluate(state, iteration, display):
            clock.now += EVALUATION_S
            found.evaluated.append((iteration, int(state.iteration)))
            found.best = {"return": 7.0, "iteration": iteration}
            return {"evaluation/return": 7.0}

        def save(state, iteration):
            clock.now += SAVE_S
            found.saved.append((iteration, int(state.iteration)))

        monkeypatch.setattr(found, "_evaluate", evaluate)
        monkeypatch.setattr(found, "_save", save)
        display = SimpleNamespace(note=found.notes.append, show=found.shown.append, working=lambda text: None)
        state = State(jnp.int32(first), jnp.int32(0))
        log = SimpleNamespace(write=found.logged.append)
        found._loop(state, step, display, log, lambda: len(calls) >= stop_after)
        return found

    return run


def both(*iterations):
    """The loop's own count agrees with the state's."""
    return [(i, i) for i in iterations]


def test_each_thing_is_done_when_it_is_due(loop):
    run = loop(steps=13 * PER_ITERATION, log_every=6, evaluate_every=8, checkpoint_every=4)
    assert run.evaluated == both(8, 14) and run.saved == both(4, 8, 12, 14)
    assert [row["iteration"] for row in run.logged] == [2, 6, 8, 12], "the first, every sixth, and what was evaluated"
    assert run.shown == run.logged
    assert [row.get("evaluation/return") for row in run.logged] == [None, None, 7.0, None]
    row = run.logged[1]
    rate = 2 * PER_ITERATION / STEP_S
    assert row["reward"] == 2.0 and row["env_steps"] == 6 * PER_ITERATION and row["env_steps_per_s"] == rate
    assert row["seconds"] == 30.0 + 3 * STEP_S + SAVE_S, "since the run was started, compilation included"
    assert row["updates"] == 6 * CONFIG.epochs * CONFIG.minibatches


def test_a_run_that_was_evaluated_last_is_not_evaluated_again(loop):
    assert loop(steps=8 * PER_ITERATION, evaluate_every=4).evaluated == both(4, 8)
    assert loop(steps=8 * PER_ITERATION).evaluated == []
    resumed = loop(first=10, steps=14 * PER_ITERATION, log_every=100)
    assert [row["iteration"] for row in resumed.logged] == [12] and resumed.saved == both(14)
    assert loop(minutes=(30.0 + 3 * STEP_S) / 60).saved == both(6), "from the start of the run"
    assert loop(stop_after=3, evaluate_every=100).saved == both(6)


def test_the_rate_leaves_out_evaluations_checkpoints_and_the_first_call(loop):
    run = loop(steps=8 * PER_ITERATION, evaluate_every=4, checkpoint_every=4)
    assert run.clock["setup_s"] == 30.0
    assert run.clock["first_update_s"] == 30.0 + STEP_S and run.clock["first_call_s"] == STEP_S
    assert "first update 32.0 s after the start, 2.0 s of it" in run.notes[0] and len(run.notes) == 1
    assert run.clock["training_s"] == 4 * STEP_S + 2 * (EVALUATION_S + SAVE_S)
    assert run.clock["step_s"] == 4 * STEP_S
    assert run.clock["env_steps_per_s"] == 6 * PER_ITERATION / (3 * STEP_S)


@pytest.mark.parametrize(("own", "backend"), [(False, "jax"), (True, "jax"), (True, "warp")])
def test_an_evaluation_is_of_the_task_as_configured(own, backend, tmp_path, monkeypatch):
    """Not of training's corners; and Warp's buffers are of the batch's size."""
    import dexsim

    made = []
    monkeypatch.setattr(dexsim, "make", lambda *a, **options: made.append((a, options)) or TinyEnv(), raising=False)
    env = TinyEnv()
    env.backend, env.hand = backend, "the hand"
    arguments = TrainArguments(env=TinyConfig(), ppo=CONFIG, task="tiny", evaluation_chunk=6)
    if own and backend == "jax":
        monkeypatch.setattr(trainer, "training_config", lambda arguments: copy.copy(arguments.env))
    run = Run(env, arguments, RunFolder(tmp_path), 0.0)
    if own:
        options = {"backend": backend, "num_envs": 6, "hand": "the hand"}
        assert made == [(("tiny", arguments.env), options)] and run.evaluator.env is not env
    else:
        assert not made and run.evaluator.env is env
    assert run.evaluator.chunk == 6
