"""`benchmarks/zero_shot.py`: options are checked before any trial, results are written."""

import importlib
import json

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
        ("--limit speed=1e9", "must be between 0.01 and 200 rad/s"),
        ("--policy rotate", "of the task 'rotate', not 'grasp'"),
        ("--trials 0", "--trials: 0: must be at least 1"),
    ],
)
def test_options_are_checked_before_the_first_trial(zero_shot, capsys, words, message):
    with pytest.raises((DexsimError, SystemExit)) as error:
        zero_shot.main(["--task", "grasp", *words.split()])
    assert message in str(error.value) + capsys.readouterr().err


def test_json_has_options_metrics_and_trials(zero_shot, tmp_path, monkeypatch, capsys):
    """A metric without a value is null: NaN is not JSON."""
    path = tmp_path / "nodir" / "r.json"
    monkeypatch.setattr(zero_shot, "run_all", lambda *_, **__: [{"trial": 0}])
    monkeypatch.setattr(zero_shot, "metrics", lambda *_: {"held": {"mean": float("nan")}})
    assert zero_shot.main(["--task", "grasp", "--limit", "speed=20", "--json", str(path)]) == 0
    found = json.loads(path.read_text(), parse_constant=pytest.fail)
    assert found["metrics"] == {"held": {"mean": None}} and found["trials"] == [{"trial": 0}]
    assert found["options"]["limit"] == {"speed": 20.0} and "held" in capsys.readouterr().out
