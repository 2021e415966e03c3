"""`benchmarks/zero_shot.py`: options are checked before any trial, results are written, processes end with it."""

import importlib
import json
import os
import subprocess
import sys
import time
from pathlib import Path

import pytest
from paths import ROOT

from dexsim.core.errors import DexsimError


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
    ("words", "message"),
    [
        ("--set nope=1", "the emulated hand has no parameter 'nope'"),
        ("--set mass=nan", "mass"),
        ("--set thermal=inside", "no parameter 'thermal' to sample"),
        ("--limit speed=1e9", "must be between 0.01 and 200 rad/s"),
        ("--policy rotate", "of the task 'rotate', not 'grasp'"),
        ("--policy nope", "nope: no such file"),
        ("--set gear_play", "give NAME=VALUE"),
        ("--limit nope=1", "no limit 'nope'"),
        ("--trials 0", "--trials: 0: must be at least 1"),
        ("--seed 0 -3", "-3"),
        ("--seconds nan", "--seconds nan: must be a time above 0 s"),
    ],
)
def test_options_are_checked_before_the_first_trial(zero_shot, capsys, words, message):
    with pytest.raises((DexsimError, SystemExit)) as error:
        zero_shot.main(["--task", "grasp", *words.split()])
    assert message in str(error.value) + capsys.readouterr().err


def test_values_of_options(zero_shot):
    words = "--task grasp --set gear_play=0 --set mass=inside --limit speed=20 --limit margin=0 --seconds 1.5"
    given = zero_shot.arguments(words.split())
    assert given.set == {"gear_play": 0.0, "mass": "inside"} and given.limit == {"speed": 20.0, "margin": 0.0}
    assert (given.seconds, given.trials, given.first, given.seed, given.json) == (1.5, 10, 0, [0], None)


def test_a_json_path_that_cannot_be_written_is_an_error_before_the_first_trial(zero_shot, tmp_path):
    (tmp_path / "file").touch()
    for path in (tmp_path / "file" / "r.json", tmp_path):
        with pytest.raises(OSError):
            zero_shot.main(["--task", "grasp", "--json", str(path)])


def test_json_has_options_metrics_and_trials(zero_shot, tmp_path, monkeypatch, capsys):
    """A metric without a value is null: NaN is not JSON."""
    path = tmp_path / "nodir" / "r.json"
    monkeypatch.setattr(zero_shot, "run_all", lambda *_, **__: [{"trial": 0}])
    monkeypatch.setattr(zero_shot, "metrics", lambda *_: {"held": {"mean": float("nan")}})
    assert zero_shot.main(["--task", "grasp", "--limit", "speed=20", "--json", str(path)]) == 0
    found = json.loads(path.read_text(), parse_constant=pytest.fail)
    assert found["metrics"] == {"held": {"mean": None}} and found["trials"] == [{"trial": 0}]
    assert found["options"]["limit"] == {"speed": 20.0} and "held" in capsys.readouterr().out


def test_losses_are_counted_by_cause_and_drawn_once_each(zero_shot, hand, tmp_path):
    from zero_shot_metrics import draw_losses, metrics, table

    part = {"kind": "box", "size": [0.0275] * 3, "place": [0.0, 0.0, 0.0]}
    before = {
        "joint_position": list(hand.rotate_posture),
        "object_position": [0.05, 0.02, 0.11],
        "object_quat": [0.95, 0.0, 0.3, 0.0],
        "finger_force": [0.0, 0.0, 12.0, 0.0, 0.0],
    }
    counts = dict.fromkeys(("successes", "paper_successes", "seconds_to_fall"), 3) | {"joint_speed": 0.1}
    report = {"task": "rotate", "command": 0.5, "parts": [part], "before": before, "fell": True, **counts}
    ends = ["dropped: trapped", "dropped: trapped", "dropped: slipped"]
    reports = [report | {"end": end} for end in ends] + [
        {**counts, "task": "rotate", "fell": False, "end": "time limit"}
    ]
    found = metrics("rotate", "rotate", reports)
    assert found["lost"] == {"trapped": 2, "slipped": 1}
    assert "lost: trapped 2, slipped 1" in table(found, {}, {})
    pictures = draw_losses(tmp_path, hand, reports)
    assert [path.name for path in pictures] == ["rotate_trapped.png", "rotate_slipped.png"]
    assert all(path.stat().st_size > 5000 for path in pictures)


SCRIPT = """
import os, time
from zero_shot import pool

def work(number):
    print(os.getpid(), flush=True)
    time.sleep(600)

if __name__ == "__main__":
    with pool(2) as workers:
        list(workers.map(work, range(2)))
"""


def alive(pid):
    """Whether a process runs; one that has ended may be left for a container's first process to collect."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False


def test_workers_end_when_their_parent_is_killed(tmp_path):
    (tmp_path / "script.py").write_text(SCRIPT)
    path = os.pathsep.join([str(ROOT), str(ROOT / "benchmarks")])
    command = [sys.executable, "script.py"]
    parent = subprocess.Popen(
        command, cwd=tmp_path, env=os.environ | {"PYTHONPATH": path}, stdout=subprocess.PIPE, text=True
    )
    workers = [int(parent.stdout.readline()) for _ in range(2)]
    assert len(set(workers)) == 2 and all(map(alive, workers))
    parent.kill()
    parent.wait(10)
    until = time.monotonic() + 10
    while any(map(alive, workers)) and time.monotonic() < until:
        time.sleep(0.05)
    assert not any(map(alive, workers))
    parent.communicate()
