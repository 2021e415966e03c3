"""Where metrics go, and which files of a run stay."""

import json
import sys
from types import SimpleNamespace

import jax
import pytest
from tiny_env import SMALL, TinyConfig, TinyEnv, training_of

from dexsim.core.errors import CheckpointError
from dexsim_ppo.policy import Policy
from dexsim_ppo.training import runlog
from dexsim_ppo.training.arguments import TrainArguments
from dexsim_ppo.training.runlog import MetricsLog, RunFolder, policy_of, read_metrics


def test_checkpoints_are_listed_oldest_first_and_the_newest_are_kept(tmp_path):
    folder = RunFolder(tmp_path)
    folder.checkpoints.mkdir()
    with pytest.raises(CheckpointError, match="has no checkpoint"):
        folder.latest_checkpoint()
    for iteration in (900, 20, 1000, 100):
        folder.checkpoint(iteration).touch()
    (folder.checkpoints / "00000999.msgpack.tmp").touch()
    (folder.checkpoints / "mine-00000999.msgpack").touch()
    policy_of(folder.checkpoint(900)).touch()
    kept = lambda: [int(path.stem) for path in folder.existing_checkpoints()]  # noqa: E731
    assert kept() == [20, 100, 900, 1000] and folder.latest_checkpoint() == folder.checkpoint(1000)
    folder.prune(9)
    assert len(kept()) == 4
    folder.prune(1)
    assert kept() == [1000] and len(list(folder.checkpoints.iterdir())) == 3


def test_what_is_set_aside_is_never_replaced(tmp_path):
    """Of every course that an older checkpoint's resume ends: its later checkpoints, and its best policy."""
    folder = RunFolder(tmp_path)
    folder.checkpoints.mkdir()
    policy = Policy.from_training(TinyEnv(), SMALL, training_of().init(jax.random.key(0)), {"iteration": 8})
    for course in ("first", "second", "third"):
        for iteration in (4, 8):
            folder.checkpoint(iteration).write_text(course)
        policy.save(folder.best)
        folder.set_aside(8)
        assert folder.best.exists() and len(folder.existing_checkpoints()) == 2, "all of it is before or at 8"
        folder.set_aside(6)
        assert not folder.best.exists() and folder.existing_checkpoints() == [folder.checkpoint(4)]
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
    log = MetricsLog(folder, 6, TrainArguments(env=TinyConfig(), ppo=SMALL, wandb="hands", seed=3))
    log.write({"iteration": 8, "env_steps": 800, "kl": 0.5, "episode/return": float("nan")})
    rows = read_metrics(folder.metrics)  # written at once
    assert [row["iteration"] for row in rows] == [2, 4, 6, 8]
    assert rows[-1] == {"iteration": 8, "env_steps": 800, "kl": 0.5, "episode/return": None}
    log.close()
    begun, *logged = said
    assert begun["project"] == "hands" and begun["config"]["seed"] == 3 and begun["dir"] == tmp_path
    assert logged == [("kl", 0.5, 800), ({"kl": 0.5}, 800), "closed", "finished"], "over environment steps, and no NaN"
