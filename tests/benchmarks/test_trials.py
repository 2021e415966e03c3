"""Trials through the bytes: the emulated hand and the runner as processes of their own, one short trial."""

import importlib
import json
import os
import subprocess
import sys

import pytest
from paths import ROOT

pytest.importorskip("serial")


def test_paths_are_of_the_present_folder(monkeypatch, tmp_path):
    """As those of trials in virtual time; the modules are the repository's."""
    monkeypatch.syspath_prepend(str(ROOT / "benchmarks"))
    monkeypatch.chdir(tmp_path)
    words = ["-c", "import pathlib, dexsim_real.twin; print(pathlib.Path('hand.xml').resolve())"]
    shown, _ = importlib.import_module("trials").start(words, stdout=subprocess.PIPE).communicate(timeout=60)
    assert shown.strip() == str((tmp_path / "hand.xml").resolve())


@pytest.mark.slow  # Processes of their own in real time: test_soak has them, too.
def test_one_short_trial_through_the_bytes(tmp_path):
    """A grasp at full command: the hand that is emulated is the judge of it."""
    path = os.pathsep.join(filter(None, [str(ROOT), os.environ.get("PYTHONPATH", "")]))
    done = subprocess.run(
        [
            sys.executable,
            "benchmarks/zero_shot.py",
            "--real-time",
            "--no-baseline",
            "--task",
            "grasp",
            "--first",
            "4",
            "--trials",
            "1",
            "--seconds",
            "1.5",
            "--parameters",
            "nominal",
            "--twin=--no-realtime",
            "--json",
            str(tmp_path / "trials.json"),
            "--runner",
            "--no-realtime --safety.stale 1 --link.margin 0.2 --approach 1 --link.settle 0",
        ],
        cwd=ROOT,
        env={**os.environ, "PYTHONPATH": path},
        capture_output=True,
        text=True,
        timeout=240,
    )
    assert done.returncode == 0, done.stderr
    result = json.loads((tmp_path / "trials.json").read_text())
    (trial,) = result["trials"]
    assert (trial["task"], trial["command"], trial["shape"], trial["trial"]) == ("grasp", 1.0, "sphere", 4)
    # It ended by the referee's rules, and within the commands' limits as the other end saw them.
    assert trial["end"] == "time limit" or trial["end"].startswith("dropped")
    assert trial["seconds"] <= 1.5 + 1e-6 and trial["bridge"]["outside_limits"] == 0
    assert trial["bridge"]["exchanges"] > 100
    assert result["metrics"]["held"]["mean"] == float(trial["held"])
    lines = done.stdout.splitlines()
    assert "1 trials in real time" in lines[0] and "emulated hand" in lines[1] and "simulation" in lines[1]
    assert any(line.startswith("held") for line in lines) and "command 1.00 sphere" in done.stderr
