"""A resumed run is the same training, and what it finds in its folder stays."""

import json
import shutil

import pytest
import tiny_train
from tiny_train import PER_ITERATION

from dexsim.core.errors import ConfigError
from dexsim_ppo import checkpoint, train
from dexsim_ppo.policy import load_policy
from dexsim_ppo.training.runlog import RunFolder

QUICK = [*tiny_train.QUICK, "--seed", "3", "--checkpoint-every", "1"]


@pytest.fixture(autouse=True)
def tiny_task(monkeypatch):
    tiny_train.install(monkeypatch)


@pytest.fixture(scope="module")
def once(tmp_path_factory):
    """A finished run, which tests copy."""
    return tiny_train.finished_run(tmp_path_factory.mktemp("once") / "a", *QUICK, "--steps", str(2 * PER_ITERATION))


@pytest.fixture
def finished(once, tmp_path):
    return RunFolder(shutil.copytree(once.path, tmp_path / "a"))


def test_a_resumed_run_may_change_its_budget_and_keeps_every_report(finished):
    first = json.loads(finished.report.read_text())
    same = ["--seed", "3", "--ppo.learning-rate", "5e-4"]
    looks_on = ["--steps", str(3 * PER_ITERATION), "--evaluation-episodes", "32", "--log-every", "2"]
    assert train.main(["--resume", str(finished.path), *same, *looks_on]) == 0
    assert json.loads((finished.path / "report-1.json").read_text()) == first
    report = json.loads(finished.report.read_text())
    assert report["seed"] == 3 and report["trained"]["episodes"] == 32
    assert load_policy(finished.last).training["iteration"] == 3
    saved = checkpoint.load(finished.latest_checkpoint(), kind="train").content["arguments"]
    assert (saved["seed"], saved["log_every"], saved["evaluation_episodes"]) == (3, 2, 32)


def test_an_older_checkpoint_is_resumed_for_good(finished):
    """The later ones are of another course: kept under another name, so that the next resume does not go back to it."""
    first, later = finished.checkpoint(1), finished.latest_checkpoint()
    assert later == finished.checkpoint(2)
    content = later.read_bytes()
    assert train.main(["--resume", str(first), "--steps", str(3 * PER_ITERATION), "--keep-checkpoints", "1"]) == 0
    assert finished.latest_checkpoint() == finished.checkpoint(3)
    assert (finished.checkpoints / "00000002.aside1.msgpack").read_bytes() == content


def contents(folder):
    return {path: path.read_bytes() for path in folder.path.rglob("*") if path.is_file()}


def test_a_run_that_is_being_trained_is_left_alone(finished):
    before, further = contents(finished), ["--resume", str(finished.path), "--steps", str(3 * PER_ITERATION)]
    with finished.lock(), pytest.raises(ConfigError, match=r"/a: another process is training this run$"):
        train.main(further)
    assert contents(finished) == before
