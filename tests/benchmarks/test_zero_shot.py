"""The options of `benchmarks/zero_shot.py`: what cannot work is refused in one line before any trial runs."""

import importlib
import json
import subprocess
import sys

import pytest
from paths import ROOT

from dexsim.core.cli import UsageError


@pytest.fixture
def zero_shot(monkeypatch):
    # The flags that other tests compile with stay as they are.
    monkeypatch.setattr("dexsim_real.control.controller.prepare_jax", lambda: None)
    monkeypatch.syspath_prepend(str(ROOT / "benchmarks"))
    module = importlib.import_module("zero_shot")

    def never(*_, **__):
        raise AssertionError("a trial ran")

    monkeypatch.setattr(module, "run_trial", never)
    return module


@pytest.mark.parametrize(
    ("words", "says"),
    [
        ("--set gear_play", "--set gear_play: give NAME=VALUE"),
        ("--set =1", "--set =1: give NAME=VALUE"),
        ("--set nope=1", "--set: the emulated hand has no parameter 'nope'; choose from box_half, "),
        ("--set mass=abc", "--set mass=abc: the value must be a number or outside or inside or nominal"),
        ("--set mass=nan", "--set mass=nan: the value must be a number"),
        ("--set thermal=inside", "--set: thermal = 'inside': give a number"),
        ("--set mass", "--set mass: give NAME=VALUE"),
        ("--limit nope=1", "--limit nope: choose from margin, "),
        ("--limit speed", "--limit speed: give NAME=VALUE"),
        ("--limit speed=abc", "--limit speed=abc: the value must be a number"),
        ("--limit speed=1e9", "--limit speed = 1000000000 rad/s: must be between 0.01 and 200 rad/s"),
        ("--limit ignored_errors=1", "--limit ignored_errors: choose from"),
        ("--trials 0", "--trials 0: must be at least 1"),
        ("--trials many", "argument --trials: invalid int value: 'many'; see --help"),
        ("--first -1", "--first -1: must be at least 0"),
        ("--seconds -1", "--seconds -1: must be a time above 0 s"),
        ("--seconds nan", "--seconds nan: must be"),
        ("--seed 0 -3", "--seed -3: must be at least 0"),
        ("--processes 0", "--processes 0: must be at least 1"),
        ("--policy rotate", "--policy: "),
        ("--policy nope", "--policy: nope: no such file"),
        ("--twin=--quiet", "--twin and --runner need --real-time"),
    ],
)
def test_what_cannot_work_is_refused_in_one_line(zero_shot, words, says):
    with pytest.raises(UsageError) as error:
        zero_shot.main(["--task", "grasp", *words.split()])
    assert str(error.value).startswith(says) and "\n" not in str(error.value)
    assert words != "--policy rotate" or "of the task 'rotate', not 'grasp'" in str(error.value)


def test_the_command_prints_that_line():
    done = subprocess.run(
        [sys.executable, "benchmarks/zero_shot.py", "--task", "grasp", "--trials", "0"],
        cwd=ROOT,
        env={"PYTHONPATH": str(ROOT), "PATH": "/usr/bin:/bin"},
        capture_output=True,
        text=True,
    )
    assert (done.returncode, done.stdout, done.stderr) == (2, "", "error: --trials 0: must be at least 1\n")


def test_values_that_are_in_order(zero_shot):
    words = "--task grasp --set gear_play=0 --set mass=inside --limit speed=20 --limit margin=0 --seconds 1.5"
    given = zero_shot.arguments("", words.split())
    assert given.set == {"gear_play": 0.0, "mass": "inside"} and given.limit == {"speed": 20.0, "margin": 0.0}
    assert (given.seconds, given.trials, given.first, given.seed, given.json) == (1.5, 10, 0, [0], None)


def test_a_file_that_cannot_be_written_is_refused_before_the_first_trial(zero_shot, tmp_path):
    (tmp_path / "file").touch()
    for path in (tmp_path / "file" / "r.json", tmp_path):
        with pytest.raises(OSError):
            zero_shot.main(["--task", "grasp", "--json", str(path)])


def test_results_are_written_where_there_was_no_folder(zero_shot, tmp_path, monkeypatch, capsys):
    """A metric without a value is null: NaN is not JSON."""
    path = tmp_path / "nodir" / "r.json"

    def run_all(*_, **__):
        assert path.parent.is_dir()
        return [{"trial": 0}]

    monkeypatch.setattr(zero_shot, "run_all", run_all)
    monkeypatch.setattr(zero_shot, "metrics", lambda *_: {"held": {"mean": float("nan")}})
    assert zero_shot.main(["--task", "grasp", "--limit", "speed=20", "--json", str(path)]) == 0
    found = json.loads(path.read_text(), parse_constant=pytest.fail)
    assert found["metrics"] == {"held": {"mean": None}} and found["trials"] == [{"trial": 0}]
    assert found["options"]["limit"] == {"speed": 20.0} and "held" in capsys.readouterr().out
