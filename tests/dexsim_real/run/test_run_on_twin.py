"""A runner on the emulated hand's pseudo-terminal: wrong angles, and SIGKILL. The hand has no watchdog."""

import signal
import subprocess
import sys
import time

import pytest
from paths import ROOT

pytest.importorskip("serial")
from following_hand import records, summary
from twin_line import Running

from dexsim_real.core.log import Kind
from dexsim_real.twin.wire.faults import Fault


def start(running, folder, *more):
    words = ["grasp", "--port", running.port, "--uncalibrated", "--fixed-object", "--yes", "--quiet", "--no-realtime"]
    words += ["--link.settle", "0", "--link.margin", "0.1", "--safety.stale", "0.5", "--approach", "0.4"]
    words += ["--log", str(folder / "run.log"), "--output", str(folder / "run.json"), *more]
    return subprocess.Popen([sys.executable, "-m", "dexsim_real.run", *words], cwd=ROOT, stderr=subprocess.PIPE)


def wait(condition, seconds):
    until = time.monotonic() + seconds
    while not condition() and time.monotonic() < until:
        time.sleep(0.002)
    assert condition()


@pytest.mark.slow
def test_wrong_angles_move_nothing_as_judged_by_the_true_ones(hand, tmp_path):
    script = (
        "2 angle 4 offset 1.3 0",
        "2.5 angle 4 stuck 1e30 0",
        "3 angle 5 stuck 1.9 0.3",
        "4 angle 7 offset -0.9 0.2",
    )
    with Running(tmp_path, task="grasp", faults=script) as running:
        process = start(running, tmp_path, "--seconds", "5", "--safety.patience", "5", "--safety.watchdog", "1")
        assert process.wait(60) == 0, summary(tmp_path)["end"]
        report = running.twin.report()
    assert report["injected_faults"] == {"angle": 4} and running.plant.violations(hand) == []
    assert summary(tmp_path)["safety"]["implausible: measurement"] >= 4  # One of each, on however busy a machine.
    assert not [note for note in records(tmp_path, Kind.NOTE) if note.startswith("relax: implausible")]


@pytest.mark.slow
def test_a_wrong_angle_that_stays_ends_the_run_with_its_name(hand, tmp_path):
    with Running(tmp_path, task="grasp") as running:
        process = start(running, tmp_path, "--seconds", "30")
        # Once the joint is far away, however long that takes: an angle stuck where the joint is could be true.
        wait(lambda: running.plant.angle[5] > 1.0, 60)
        running.twin.firmware.begin(Fault("angle", joint=5, form="stuck", radians=0.2), now=0.0)
        assert process.wait(60) == 1
        assert not running.twin.firmware.on and running.plant.violations(hand) == []
    assert "index_joint2 reads 0.2 rad" in summary(tmp_path)["end"]


def test_the_guard_turns_the_emulated_hand_off_after_sigkill(hand, tmp_path):
    with Running(tmp_path, task="grasp") as running:
        board = running.twin.firmware
        process = start(running, tmp_path, "--seconds", "60")
        wait(lambda: board.on, 60)
        time.sleep(1.0)
        process.send_signal(signal.SIGKILL)
        process.wait(10)
        wait(lambda: not board.on, 1.0)
        assert not board.trips and running.plant.violations(hand) == []
