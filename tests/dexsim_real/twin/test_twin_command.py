"""The command `python -m dexsim_real.twin`, and the time of its physics."""

import json
import os
import signal
import socket
import subprocess
import sys
import tempfile
import time

import numpy as np
import pytest
from paths import ROOT

pytest.importorskip("serial")
import twin_plant
from twin_plant import ScriptedPlant

from dexsim.calibration.maps import current_from_counts, load_calibration, normalised_torque
from dexsim.core.errors import DexsimError
from dexsim_real.twin import __main__ as twin_command
from dexsim_real.twin.server import PlantClock
from dexsim_real.twin.wire.emulated_sensors import EmulatedCamera, ObjectSensorConfig
from dexsim_real.twin.wire.firmware import FirmwareConfig


def test_physics_follows_the_wall_clock_and_lets_go_what_it_cannot(hand):
    class Slow(ScriptedPlant):
        def advance(self, seconds):
            super().advance(seconds)
            time.sleep(pace * seconds)

    notes, pace = [], 0.0
    clock = PlantClock(Slow(), 10.0, notes.append)
    for now in np.arange(10.0, 10.5, 0.0007):
        clock.catch_up(now, PlantClock.SLICE)
    assert clock.plant.time == pytest.approx(0.5, abs=0.003) and clock.slipped == 0
    # Behind by less than the bound all of it is caught up, in slices; behind by more, the rest is let go.
    for _ in range(100):
        clock.catch_up(10.58, PlantClock.SLICE)
    assert clock.plant.time == pytest.approx(0.58, abs=1e-6)
    clock.catch_up(13.0)
    assert clock.plant.time == pytest.approx(0.59, abs=1e-6) and clock.slipped == pytest.approx(2.41, abs=1e-6)
    assert len(notes) == 1 and "too slow" in notes[0]
    report = clock.report()
    assert report["simulated_s"] + report["slipped_s"] == pytest.approx(3.0, abs=1e-3)


SCRIPTED = """
import sys, twin_plant
from dexsim_real.twin import __main__ as command
command.make_plant = twin_plant.make
sys.exit(command.main(sys.argv[1:]))
"""


def start(*options):
    return subprocess.Popen(
        [sys.executable, "-c", SCRIPTED, "--no-realtime", *options],
        cwd=ROOT,
        env={**os.environ, "PYTHONPATH": f"{ROOT}:{ROOT / 'tests' / 'support'}"},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
    )


def test_the_command_shows_how_to_use_it_and_writes_its_results(tmp_path):
    process = start(
        "--task",
        "grasp",
        "--trials",
        "2",
        "--seconds",
        "0.4",
        "--command",
        "0.6",
        "--output",
        str(tmp_path / "out.json"),
        "--object.optics.position",
        "0.06",
        "0.6",
        "0.09",
    )
    out, error = process.communicate(timeout=60)
    assert process.returncode == 0, error
    shown = out.decode()
    folder = tempfile.gettempdir()
    assert f"python -m dexsim_real.run grasp --port {folder}/dexsim-twin-" in shown and "--command 0.6" in shown
    assert f"--calibration {folder}/dexsim-twin-" in shown and f"--camera unix:{folder}/dexsim-twin-" in shown
    assert "--optics.position 0.06 0.6 0.09" in shown
    report = json.loads((tmp_path / "out.json").read_text())
    assert [row["trial"] for row in report["trials"]] == [0, 1] and report["commands"]["checked"] == 0
    assert not os.path.lexists(shown.split("--port ")[1].split()[0])


def test_the_calibration_beside_the_port_is_one_of_this_hand(hand, tmp_path):
    path = twin_command.write_calibration(tmp_path / "calibration.toml", hand, FirmwareConfig())
    calibration = load_calibration(path, hand)
    np.testing.assert_allclose(calibration.force_per_count, FirmwareConfig().force_per_count)
    counts = np.linspace(-800, 800, 12).astype(np.float32)
    torque = np.asarray(normalised_torque(calibration, current_from_counts(calibration, counts)))
    assert np.all(torque * counts < 0)  # The wire's current is positive when opening.


def test_it_ends_in_good_order_when_it_is_told_to(tmp_path):
    waiting = start("--link", str(tmp_path / "port"), "--output", str(tmp_path / "out.json"))
    assert waiting.stdout.readline().startswith(b"rotate: the emulated hand is at")
    waiting.send_signal(signal.SIGTERM)
    assert waiting.wait(10) == 0 and (tmp_path / "out.json").exists() and not (tmp_path / "port").is_symlink()
    waiting.communicate()


def test_what_is_wrong_is_said_in_one_line(tmp_path, monkeypatch):
    monkeypatch.setattr(twin_command, "make_plant", twin_plant.make)
    (tmp_path / "deep.toml").write_text("model = " + "[" * 5000 + "]" * 5000)
    for options, message in (
        (["--faults.script", "5 melt"], "no kind 'melt'"),
        (["--task", "juggle"], "choose from grasp, rotate"),
        (["--policy", "grasp"], "of the task 'grasp'; give --task grasp"),
        (["--policy", "nobody"], "nobody: no such file"),
        (["--object.imu-mount", "0", "0", "0", "0"], "imu_mount 0 0 0 0: is no orientation"),
        (["--faults.flip", "2"], "between 0 and 1"),
        (["--link", str(tmp_path / "no" / "port")], "no pseudo-terminal"),
        (
            ["--mask-socket", str(tmp_path / "no" / "m")],
            "socket for masks cannot be created",
        ),
        (
            ["--mask-socket", str(tmp_path / ("m" * 150))],
            "socket for masks cannot be created .AF_UNIX path too long",
        ),
    ):
        with pytest.raises(DexsimError, match=message) as found:
            twin_command.main([*options, "--no-realtime"])
        assert "\n" not in str(found.value)


def test_results_that_cannot_be_written_are_refused_before_the_trials(tmp_path):
    (tmp_path / "file").touch()
    for path in (tmp_path, tmp_path / "file" / "results.json"):
        with pytest.raises(OSError, match=str(tmp_path)):
            twin_command.main(["--output", str(path)])


def test_a_socket_on_which_a_program_listens_is_left_alone(tmp_path, monkeypatch):
    monkeypatch.setattr(twin_command, "make_plant", twin_plant.make)
    path = tmp_path / "masks"
    with socket.socket(socket.AF_UNIX) as other:
        other.bind(str(path))
        other.listen()
        with pytest.raises(DexsimError, match="Address already in use"):
            twin_command.main(["--mask-socket", str(path), "--no-realtime"])
        with socket.socket(socket.AF_UNIX) as client:
            client.connect(str(path))
    EmulatedCamera(path, ScriptedPlant(), ObjectSensorConfig(), seed=0, start=0.0).close()
