"""A resumed run is the same training, and what it finds in its folder stays."""

import contextlib
import dataclasses
import datetime
import json
import shutil
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
import tiny_train
from paths import ROOT
from tiny_env import TinyConfig
from tiny_train import PER_ITERATION

from dexsim.core.errors import ConfigError
from dexsim_ppo import checkpoint, train
from dexsim_ppo.learner.curriculum import CurriculumConfig
from dexsim_ppo.policy import load_policy
from dexsim_ppo.training import runlog, trainer
from dexsim_ppo.training.arguments import check_resumed
from dexsim_ppo.training.runlog import RunFolder

QUICK = [*tiny_train.QUICK, "--seed", "3"]


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


CHANGES = {
    "seed": (["--seed", "9"], "--seed 9: a resumed run keeps its 3"),
    "learner": (["--ppo.learning-rate", "1e-3"], "--ppo.learning-rate 0.001: a resumed run keeps its 0.0005"),
    "task": (["--env.gain", "0.5"], "--env.gain 0.5: a resumed run keeps its 0.25"),
    "curriculum": (["--curriculum.on"], "--curriculum.on True: a resumed run keeps its False"),
    "extremes": (["--extremes", "0.5"], "--extremes 0.5: a resumed run keeps its 0"),
    "folder": (["--run-dir", "elsewhere"], "--run-dir"),
}


@pytest.mark.slow
def test_what_would_change_the_training_is_refused_and_the_rest_applies(finished):
    """Nothing of the saved state follows from such an option, and the report would name it all the same."""
    for given, said in CHANGES.values():
        with pytest.raises(ConfigError) as refused:
            train.main(["--resume", str(finished.path), *given])
        assert str(refused.value).startswith(said) and "\n" not in str(refused.value)
    with pytest.raises(ConfigError, match=r"TrainArguments\.seed = 9: a resumed run keeps its 3"):
        train.train_policy(resume=finished.path, seed=9)
    same = ["--seed", "3", "--ppo.learning-rate", "5e-4"]
    looks_on = ["--steps", str(3 * PER_ITERATION), "--evaluation-episodes", "32", "--log-every", "2"]
    assert train.main(["--resume", str(finished.path), *same, *looks_on]) == 0
    report = json.loads(finished.report.read_text())
    assert report["seed"] == 3 and report["trained"]["episodes"] == 32
    assert load_policy(finished.last).training["iteration"] == 3
    saved = checkpoint.load(finished.latest_checkpoint(), kind="train").content["arguments"]
    assert (saved["seed"], saved["log_every"], saved["evaluation_episodes"]) == (3, 2, 32)


def test_only_budget_and_what_looks_on_may_change(finished):
    """Field by field: an option that is added later is part of the training, unless this list grows with it."""
    _, begun = train.parse_arguments(["--resume", str(finished.path)])
    saved = train.default_arguments(None, "auto", begun)
    other = {"seed": 9, "extremes": 0.5, "backend": "c", "preset": "gpu", "task": "other", "policy": "grasp"}
    other |= {"evaluation_share": 0.5, "evaluate_every": 5, "wandb": "mine"}
    other |= {"hand": "mine.toml", "deterministic": True}
    other |= {"run_dir": Path("x"), "resume": Path("x"), "video": True, "env": TinyConfig(gain=0.5)}
    other |= {"ppo": dataclasses.replace(saved.ppo, discount=0.5), "curriculum": CurriculumConfig(on=True)}
    allowed = set()
    for field in dataclasses.fields(saved):
        value = other.get(field.name, 77)
        assert value != getattr(saved, field.name)
        with contextlib.suppress(ConfigError):
            check_resumed(dataclasses.replace(saved, **{field.name: value}), saved)
            allowed.add(field.name)
    assert allowed == {
        *("checkpoint_every", "evaluate_every", "evaluation_chunk", "evaluation_episodes", "hand", "keep_checkpoints"),
        *("devices", "evaluation_share", "log_every", "minutes", "patience", "resume", "steps", "video", "wandb"),
    }


def test_the_report_of_a_finished_run_is_kept(finished):
    first = json.loads(finished.report.read_text())
    for steps in (3, 4):
        assert train.main(["--resume", str(finished.path), "--steps", str(steps * PER_ITERATION)]) == 0
    assert json.loads((finished.path / "report-1.json").read_text()) == first
    second = json.loads((finished.path / "report-2.json").read_text())
    assert second["origin"]["iteration"] == 3
    assert json.loads(finished.report.read_text())["origin"]["iteration"] == 4


def test_runs_that_begin_in_one_second_get_folders_of_their_own(tmp_path, monkeypatch):
    class Now(datetime.datetime):
        @classmethod
        def now(cls, tz=None):
            return cls(2026, 1, 1, 12)

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(runlog.datetime, "datetime", Now)
    with ThreadPoolExecutor(8) as many:
        made = list(many.map(lambda _: runlog.new_folder(None, "tiny"), range(24)))
    assert len(set(made)) == 24 and all(path.is_dir() for path in made)
    assert str(min(made, key=lambda path: len(str(path)))) == "runs/tiny-20260101-120000"


def test_an_older_checkpoint_is_resumed_for_good(finished):
    """The later ones are of another course: kept under another name, so that the next resume does not go back to it."""
    first, later = finished.checkpoint(1), finished.latest_checkpoint()
    assert later == finished.checkpoint(2)
    # As `--checkpoint-every 1` would have left it.
    assert train.main([*QUICK, "--steps", str(PER_ITERATION), "--run-dir", str(finished.path.parent / "b")]) == 0
    first.write_bytes(RunFolder(finished.path.parent / "b").latest_checkpoint().read_bytes())
    content = later.read_bytes()
    assert train.main(["--resume", str(first), "--steps", str(3 * PER_ITERATION), "--keep-checkpoints", "1"]) == 0
    assert finished.latest_checkpoint() == finished.checkpoint(3)
    assert (finished.checkpoints / "00000002.aside1.msgpack").read_bytes() == content


@pytest.mark.slow
def test_the_best_policy_of_a_course_that_is_left_is_kept_and_not_reported(tmp_path):
    often = ["--evaluate-every", "1", "--evaluation-share", "1", "--checkpoint-every", "1", "--run-dir"]
    assert train.main([*QUICK, "--steps", str(3 * PER_ITERATION), *often, str(tmp_path / "a")]) == 0
    folder = RunFolder(tmp_path / "a")
    load_policy(folder.last).save(folder.best)  # the third iteration's, as if it had the highest return
    content = folder.best.read_bytes()
    no_more = ["--evaluate-every", "0", "--steps", str(PER_ITERATION)]
    assert train.main(["--resume", str(folder.checkpoint(1)), *no_more]) == 0
    assert (folder.path / "best.aside1.msgpack").read_bytes() == content
    assert json.loads(folder.report.read_text())["origin"]["iteration"] == 1


def test_a_best_policy_that_is_set_aside_is_none_to_beat(tmp_path, monkeypatch):
    """The file of the one before it is gone; of those that follow one must be kept, though their returns are lower."""
    returns = iter([5.0, 6.0, 3.0, 2.0])
    monkeypatch.setattr(trainer, "headline", lambda report: {"return": {"value": next(returns)}})
    often = ["--evaluate-every", "1", "--evaluation-share", "1", "--checkpoint-every", "1", "--run-dir"]
    assert train.main([*QUICK, "--steps", str(2 * PER_ITERATION), *often, str(tmp_path / "a")]) == 0
    folder = RunFolder(tmp_path / "a")
    assert load_policy(folder.best).training["iteration"] == 2
    assert train.main(["--resume", str(folder.checkpoint(1)), "--steps", str(3 * PER_ITERATION)]) == 0
    assert (folder.path / "best.aside1.msgpack").exists() and load_policy(folder.best).training["iteration"] == 2
    assert json.loads(folder.report.read_text())["policy"] == "best.msgpack"


def test_a_checkpoint_is_resumed_from_within_its_folder_and_not_from_elsewhere(finished, monkeypatch, tmp_path):
    lonely = tmp_path / "x" / "y" / "00000002.msgpack"
    lonely.parent.mkdir(parents=True)
    lonely.write_bytes(finished.latest_checkpoint().read_bytes())
    with pytest.raises(ConfigError, match="/x has no config.json"):
        train.main(["--resume", str(lonely)])
    assert [path.name for path in (tmp_path / "x").iterdir()] == ["y"]
    monkeypatch.chdir(finished.checkpoints)
    assert train.main(["--resume", "00000002.msgpack", "--steps", str(3 * PER_ITERATION)]) == 0
    assert finished.latest_checkpoint() == finished.checkpoint(3)


def contents(folder):
    return {path: path.read_bytes() for path in folder.path.rglob("*") if path.is_file()}


def test_a_run_that_another_process_trains_is_left_alone(finished):
    before, further = contents(finished), ["--resume", str(finished.path), "--steps", str(3 * PER_ITERATION)]
    script = f"import sys; from pathlib import Path; from {RunFolder.__module__} import RunFolder\n"
    script += "with RunFolder(Path(sys.argv[1])).lock(): print(flush=True); sys.stdin.read()"
    other = subprocess.Popen(
        [sys.executable, "-c", script, str(finished.path)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, cwd=ROOT
    )
    try:
        other.stdout.readline()
        with pytest.raises(ConfigError, match=r"/a: another process is training this run$"):
            train.main(further)
        assert contents(finished) == before
    finally:
        other.kill()  # What a killed process held is free.
        other.communicate()
    assert train.main(further) == 0
    assert load_policy(finished.last).training["iteration"] == 3


def test_python_takes_paths_and_words_alike(finished, tmp_path):
    tuned = train.train_policy(policy=finished.last, steps=PER_ITERATION, run_dir=str(tmp_path / "tuned"), video=False)
    assert tuned.folder == tmp_path / "tuned" and tuned.report["arguments"]["policy"] == str(finished.last)
