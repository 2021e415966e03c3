"""The command: options and files."""

import re

import numpy as np
import pytest
from calibrating import arguments, operator
from pty_hand import PtyHand

from dexsim.calibration.maps import load_calibration
from dexsim.core import cli
from dexsim.errors import DexsimError
from dexsim_real.calibrate import __main__ as calibrate
from dexsim_real.calibrate.__main__ import fit_and_report, main
from dexsim_real.calibrate.bench import PressConfig
from dexsim_real.calibrate.press_fit import read_presses
from dexsim_real.control.limits import SafetyConfig
from dexsim_real.core.errors import HandError
from dexsim_real.core.log import Kind, LogError, LogReader, LogWriter
from dexsim_real.wire.frames import Mode


def test_options_that_do_not_go_together(tmp_path):
    log, same = tmp_path / "a.log", tmp_path / "link" / "hand.toml"
    (tmp_path / "link").symlink_to(tmp_path)
    log.write_text("precious")
    for options, says in (
        ({"press": PressConfig(current=1.9)}, "must be below --safety.current"),
        ({"press": PressConfig(peak=20.0), "safety": SafetyConfig(finger_force=20.0)}, "well below"),
        ({"log": same}, "--log .*is the file of --output, too"),
        ({"port": None, "from_log": (log,), "output": log, "force": True}, "--output .*is the --from-log"),
        ({"output": log}, "already exists: give another --output, or --force"),
    ):
        with pytest.raises(DexsimError, match=says):
            arguments(tmp_path, **options)


def test_nothing_is_overwritten_and_a_figure_that_fails_leaves_the_calibration(hand, session, tmp_path, monkeypatch):
    def fail(*_):
        raise OSError("no figure")

    options, path, known = arguments(tmp_path), tmp_path / "hand.toml", load_calibration(session[1].output, hand)
    monkeypatch.setattr(calibrate, "read_presses", lambda *_: ((), ()))
    monkeypatch.setattr(calibrate, "fit", lambda *_: (known, {}))
    monkeypatch.setattr(calibrate, "plot_calibration", fail)
    path.write_text("precious")
    with pytest.raises(HandError, match=f"already exists: --from-log {re.escape(str(session[2]))} fits these"):
        fit_and_report(options, hand, [session[2]], operator())  # It came while the hand was pressing.
    assert path.read_text() == "precious"
    with pytest.raises(OSError, match="no figure"):
        fit_and_report(arguments(tmp_path, force=True, plot=tmp_path / "hand.png"), hand, [session[2]], operator())
    assert load_calibration(path, hand).joint_names == hand.joint_names


def command(*options):
    """The command in this process; its exit code."""
    with pytest.raises(SystemExit) as stop:
        cli.run(lambda _: main(list(options)))
    return stop.value.code


def test_where_nothing_can_be_written_nothing_moves(tmp_path, monkeypatch, capsys):
    (tmp_path / "file").touch()
    touched = []
    monkeypatch.setattr(calibrate, "prepare_jax", lambda: None)
    monkeypatch.setattr(calibrate, "record", lambda *_: touched.append("hand"))
    figure, output = tmp_path / "file" / "hand.png", tmp_path / "hand.toml"
    assert command("--port", "x", "--output", str(output), "--plot", str(figure)) == 2
    assert command("--port", "x", "--output", str(figure)) == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 2 and all(line.startswith("error: ") for line in lines) and not touched


def test_the_command_refuses_a_touched_hand_in_one_line(tmp_path, monkeypatch, capsys):
    pytest.importorskip("serial")
    monkeypatch.setattr(calibrate, "prepare_jax", lambda: None)
    with PtyHand() as peer:
        peer.state["tip"]["taxel"]["z"][3, 40:43] = 90
        output, log = tmp_path / "hand.toml", tmp_path / "hand.log"
        options = f"--port {peer.port} --yes --output {output} --log {log} --link.settle 0 --link.no-paced".split()
        assert command(*options, "--no-realtime") == 2
        assert all(np.all(block["mode"] == Mode.PASSIVE) for block in peer.commands)
    lines = capsys.readouterr().err.strip().splitlines()
    assert "serial number 2R32SCRIPTED" in lines[0]
    assert lines[-1].startswith("error: cannot tare the taxels: 3 adjacent taxels of the ring read above 40 counts")
    assert not output.exists()


def test_logs_that_do_not_belong_together_or_are_of_something_else(hand, session, tmp_path):
    """By what they begin with."""
    meta = next(entry.content for entry in LogReader(session[2]) if entry.kind == Kind.META)

    def log_of(name, **values):
        with LogWriter(tmp_path / name) as log:
            log.add(Kind.META, meta | values)
        return log.path

    ours = log_of("ours")
    for values, says in (
        ({"rate": 82.0}, "another --rate than the logs before: 82.0"),
        ({"identity": ("2R32OTHER", "right")}, "another hand than the logs before: .*2R32OTHER"),
        ({"task": "grasp"}, "this is a log of 'grasp'; give one of 'calibrate'"),
    ):
        with pytest.raises(LogError, match=says):
            read_presses([ours, log_of(f"{list(values)[0]}.log", **values)], hand)
    with LogWriter(tmp_path / "early.log") as log:
        log.add(Kind.NOTE, "end: no answer")
    with pytest.raises(LogError, match="ends before the hand was ready"):
        read_presses([log.path], hand)
