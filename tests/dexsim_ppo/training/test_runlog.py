"""Where metrics go, which files of a run stay, and what evaluations during training choose."""

import dataclasses
import json
import sys
import time
from types import SimpleNamespace

import pytest
from tiny_env import SMALL, TinyConfig, TinyEnv

from dexsim.core.files import temporary_beside
from dexsim.errors import CheckpointError
from dexsim_ppo.checkpoint import Checkpoint
from dexsim_ppo.training import runlog, trainer
from dexsim_ppo.training.arguments import TrainArguments
from dexsim_ppo.training.runlog import MetricsLog, RunFolder, policy_of, read_metrics
from dexsim_ppo.training.trainer import Run


def test_checkpoints_are_listed_oldest_first_and_the_newest_are_kept(tmp_path):
    folder = RunFolder(tmp_path)
    folder.checkpoints.mkdir()
    folder.config.touch()
    with pytest.raises(CheckpointError, match="has no checkpoint .*; --config .* starts a new run with its options"):
        folder.latest_checkpoint()
    for iteration in (900, 20, 1000, 100):
        folder.checkpoint(iteration).touch()
    (folder.checkpoints / "00000999.msgpack.tmp").touch()
    (folder.checkpoints / "mine-00000999.msgpack").touch()
    temporary_beside(folder.checkpoint(900)).touch()  # of a process that was killed while it wrote
    policy_of(folder.checkpoint(900)).touch()
    kept = lambda: [int(path.stem) for path in folder.existing_checkpoints()]  # noqa: E731
    assert kept() == [20, 100, 900, 1000] and folder.latest_checkpoint() == folder.checkpoint(1000)
    folder.prune(9)
    assert len(kept()) == 4
    folder.prune(1)
    assert kept() == [1000] and len(list(folder.checkpoints.iterdir())) == 3


def test_what_is_set_aside_is_never_replaced(policy, tmp_path):
    """Of every course that an older checkpoint's resume ends: its later checkpoints, and its best policy."""
    folder = RunFolder(tmp_path)
    folder.checkpoints.mkdir()
    dataclasses.replace(policy, training={"iteration": 8}).save(folder.best)
    best, progress = folder.best.read_bytes(), {"progress": {"best": {"iteration": 8}}}
    for course in ("first", "second", "third"):
        for path in (folder.checkpoint(4), folder.checkpoint(8), folder.metrics):
            path.write_text(course)
        folder.best.write_bytes(best)
        folder.set_aside(Checkpoint(folder.checkpoint(8), "tiny", progress, {}))
        assert folder.best.exists() and len(folder.existing_checkpoints()) == 2, "all of it is before or at 8"
        folder.set_aside(Checkpoint(folder.checkpoint(4), "tiny", {"progress": {"best": {"iteration": 4}}}, {}))
        assert not folder.best.exists() and folder.existing_checkpoints() == [folder.checkpoint(4)]
    assert [path.read_text() for path in sorted(tmp_path.glob("metrics*"))] == ["first", "second", "third"]
    kept = {path.name: path.read_text() for path in folder.checkpoints.glob("00000008.*")}
    assert kept == {f"00000008.aside{n}.msgpack": c for n, c in ((1, "first"), (2, "second"), (3, "third"))}
    assert {path.name for path in tmp_path.glob("best*")} == {f"best.aside{n}.msgpack" for n in (1, 2, 3)}


def test_a_resumed_log_goes_on_after_the_checkpoint_and_to_every_sink(tmp_path, monkeypatch):
    """What came after it is repeated; a line that was cut ends the rows."""
    said = []
    writer = SimpleNamespace(add_scalar=lambda *scalar: said.append(scalar), close=lambda: said.append("closed"))
    run = SimpleNamespace(log=lambda row, step: said.append((row, step)), finish=lambda: said.append("finished"))
    monkeypatch.setattr(runlog, "_tensorboard_writer", lambda path: writer)
    monkeypatch.setitem(sys.modules, "wandb", SimpleNamespace(init=lambda **given: (said.append(given), run)[1]))
    folder = RunFolder(tmp_path)
    folder.metrics.write_text("".join(json.dumps({"iteration": i}) + "\n" for i in (2, 4, 6, 8)) + '{"iterat')
    resumed = Checkpoint(folder.checkpoint(6), "tiny", {}, {".iteration": 6})
    log = MetricsLog(folder, TrainArguments(env=TinyConfig(), ppo=SMALL, wandb="hands", seed=3), resumed)
    log.write({"iteration": 8, "env_steps": 800, "kl": 0.5, "episode/return": float("nan")})
    rows = read_metrics(folder.metrics)  # written at once
    assert [row["iteration"] for row in rows] == [2, 4, 6, 8]
    assert rows[-1] == {"iteration": 8, "env_steps": 800, "kl": 0.5, "episode/return": None}
    log.close()
    begun, *logged = said
    assert begun["project"] == "hands" and begun["config"]["seed"] == 3 and begun["dir"] == tmp_path
    assert logged == [("kl", 0.5, 800), ({"kl": 0.5}, 800), "closed", "finished"], "over environment steps, and no NaN"


# --- evaluations during training: which policy they choose, and when they end a run ------------------------

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
            policy = SimpleNamespace(params=None, save=lambda path, number=number: saved.append((number, path)))
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
