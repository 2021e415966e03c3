"""The command `python -m dexsim_real.twin`, and the time of its physics."""

import json
import os
import signal
import subprocess
import sys

import numpy as np
import pytest
from paths import ROOT

pytest.importorskip("serial")
from twin_plant import ScriptedPlant

from dexsim.calibration.maps import load_calibration
from dexsim_real.twin.__main__ import SLICE, Twin, TwinArguments
from dexsim_real.twin.wire import FORCE_PER_COUNT, SERIALS


def test_physics_follows_the_wall_clock_and_lets_go_what_it_cannot(tmp_path):
    notes = []
    twin = Twin(TwinArguments(), ScriptedPlant(), tmp_path, notes.append)
    twin.now, plant = 10.0, twin.plant
    for now in np.arange(10.0, 10.5, 0.0007):
        twin.catch_up(now, SLICE)
    assert plant.time == pytest.approx(0.5, abs=0.003) and twin.slipped == 0
    # Behind by less than the bound all of it is caught up, in slices; behind by more, the rest is let go.
    for _ in range(100):
        twin.catch_up(10.58, SLICE)
    assert plant.time == pytest.approx(0.58, abs=1e-6)
    twin.catch_up(13.0)
    assert plant.time == pytest.approx(0.59, abs=1e-6) and twin.slipped == pytest.approx(2.41, abs=1e-6)
    assert len(notes) == 1 and "too slow" in notes[0]
    twin.close()


SCRIPTED = """
import sys, twin_plant
from dexsim_real.twin import __main__ as command
command.EmulatedHand = lambda *hand, seconds, **options: twin_plant.ScriptedPlant(seconds or float("inf"))
sys.exit(command.main(sys.argv[1:]))
"""


def start(*options):
    return subprocess.Popen(
        [sys.executable, "-c", SCRIPTED, "--no-realtime", *options],
        cwd=ROOT,
        env={**os.environ, "PYTHONPATH": f"{ROOT}:{ROOT / 'tests' / 'support'}"},
        stdout=subprocess.PIPE,
        text=True,
    )


def test_the_command_offers_a_calibration_and_ends_after_its_trials_or_when_it_is_told_to(hand, tmp_path):
    ends = start(*"--task grasp --trials 2 --seconds 0.4 --output".split(), str(tmp_path / "out.json"))
    waits = start("--folder", str(tmp_path), "--output", str(tmp_path / "waits.json"))
    assert waits.stdout.readline().startswith("rotate: the emulated hand is at")
    shown = waits.stdout.readline()
    assert f"--imu {tmp_path}/imu" in shown
    calibration = load_calibration(shown.split("--calibration ")[1].split()[0], hand)
    np.testing.assert_allclose(calibration.force_per_count, FORCE_PER_COUNT)
    assert (calibration.serial, calibration.handedness) == (SERIALS["right"], "right")
    waits.send_signal(signal.SIGTERM)
    assert waits.wait(10) == 0 and (tmp_path / "waits.json").exists() and not (tmp_path / "hand").is_symlink()
    waits.communicate()
    shown, _ = ends.communicate(timeout=300)
    assert ends.returncode == 0 and "python -m dexsim_real.run grasp --port " in shown and "--camera unix:" in shown
    report = json.loads((tmp_path / "out.json").read_text())
    assert [row["trial"] for row in report["trials"]] == [0, 1]
    assert not os.path.lexists(shown.split("--port ")[1].split()[0])
