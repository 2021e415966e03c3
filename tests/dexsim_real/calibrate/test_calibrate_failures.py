"""Whatever goes wrong in a calibration leaves the motors off and files as they were."""

import dataclasses
import io
import re
import sys
from types import SimpleNamespace

import numpy as np
import pytest
from calibrating import QUICK, arguments, off, on, operator, plates, record
from press_bench import BenchHand
from pty_hand import PtyHand
from rich.console import Console

from dexsim.calibration.maps import load_calibration
from dexsim.core import cli
from dexsim.core.errors import CalibrationError, ConfigError
from dexsim_real.calibrate import __main__ as calibrate
from dexsim_real.calibrate.__main__ import fit_and_report, main
from dexsim_real.calibrate.gauge import Gauge
from dexsim_real.calibrate.hand_loop import HandLoop, Operator
from dexsim_real.calibrate.options import PressConfig
from dexsim_real.calibrate.press_fit import fit
from dexsim_real.calibrate.press_procedure import PressProcedure
from dexsim_real.calibrate.read import read_logs
from dexsim_real.calibrate.report import torque_constants
from dexsim_real.control.limits import SafetyConfig
from dexsim_real.control.safety import Safety
from dexsim_real.core.errors import HandError
from dexsim_real.core.log import Kind, LogError, LogReader, LogWriter
from dexsim_real.sensors.hand import HandSensing, HardwareConfig
from dexsim_real.wire.frames import Mode


class Interrupted(BenchHand):
    """Something happens in the middle of the third second of pressing."""

    def __init__(self, hand, event, **options):
        super().__init__(hand, plates(hand, "index pad"), **options)
        self.event, self.pressing = event, 0

    def exchange(self, command):
        self.pressing += self.force[1] > 0.5
        if self.pressing == 60:
            self.pressing += 1
            answer = self.event(self)
            if answer is not None:
                return None
        return super().exchange(command)


def raises(error):
    def event(bench):
        raise error

    return event


def heat(bench):
    bench.temperature = 95


@pytest.mark.parametrize(
    ("event", "error", "says"),
    [
        (raises(KeyboardInterrupt()), KeyboardInterrupt, None),
        (raises(SystemExit(143)), SystemExit, "143"),
        (raises(RuntimeError("broken")), RuntimeError, "broken"),
        (heat, HandError, r"too hot: joint thumb_bend \(thumb\), 95 degC"),
    ],
)
def test_however_it_ends_the_motors_are_off_and_the_old_file_is_there(hand, tmp_path, event, error, says):
    (tmp_path / "hand.toml").write_text("precious")
    bench = Interrupted(hand, event)
    with pytest.raises(error, match=says):
        record(bench, hand, arguments(tmp_path, force=True, press=QUICK))
    assert on(bench).any() and off(bench) and bench.closed
    assert (tmp_path / "hand.toml").read_text() == "precious"
    ends = [entry.content for entry in LogReader(tmp_path / "hand.log") if entry.kind == Kind.END]
    assert len(ends) == 1 and ends[0]["end"]


def test_a_silent_hand_ends_it(hand, tmp_path):
    bench = Interrupted(hand, lambda bench: None)
    deaf = [False]
    exchange = bench.exchange

    def answer(command):
        if bench.pressing >= 60:
            deaf[0] = True
        reply = exchange(command)
        return None if deaf[0] else reply

    bench.exchange = answer
    with pytest.raises(HandError, match="stopped: no measurement for 2 s"):
        record(bench, hand, arguments(tmp_path, press=QUICK))
    assert off(bench) and bench.closed


def test_what_it_presses_on_is_missing_or_unfelt(hand, tmp_path):
    with pytest.raises(HandError, match="index pad: met nothing within"):
        record(BenchHand(hand, []), hand, arguments(tmp_path, press=QUICK, log=tmp_path / "a.log"))
    numb = BenchHand(hand, plates(hand, "index pad"), taxel_gain=[1, 0, 1, 1, 1])
    with pytest.raises(HandError, match="index pad: 0.8.* A and no taxel feels it"):
        options = arguments(tmp_path, press=PressConfig(current=0.8, approach_speed=0.5), log=tmp_path / "b.log")
        record(numb, hand, options)
    assert off(numb)


class Helper(Operator):
    """Holds the pen beside the finger until it is told so often that the press was missed."""

    def __init__(self, bench, misses, **options):
        super().__init__(Console(file=io.StringIO(), width=200), **options)
        self.bench, self.misses, self.told, self.plates = bench, misses, 0, bench.plates
        bench.plates = []

    def tell(self, text):
        super().tell(text)
        if text.endswith("again"):
            self.told += 1
        elif text.startswith("index pad"):  # The finger is back where it begins.
            self.bench.plates = self.plates if self.told == self.misses else []


def test_a_missed_pen_is_pressed_again(hand, tmp_path):
    """Twice beside it, then the press is as good as any; three times with nobody to ask end it."""
    bench = BenchHand(hand, plates(hand, "index pad"))
    helper = Helper(bench, 2, assume_yes=True)
    options = arguments(tmp_path, press=QUICK, sides=False, log=tmp_path / "a.log")
    (recording,) = read_logs([record(bench, hand, options, helper)], hand).recordings.values()
    assert helper.told == 2 and np.max(recording.shown) > 60 and off(bench)
    bench = BenchHand(hand, plates(hand, "index pad"))
    helper = Helper(bench, 3, assume_yes=True)
    with pytest.raises(HandError, match="index pad: met nothing within"):
        record(bench, hand, dataclasses.replace(options, log=tmp_path / "b.log"), helper)
    assert helper.told == 2 and off(bench)


def test_a_missed_pen_can_be_skipped(hand, tmp_path):
    bench = BenchHand(hand, plates(hand, "index pad"))
    helper = Helper(bench, 9, stream=io.StringIO("\n\n\n\ns\n"))
    options = arguments(tmp_path, press=QUICK, sides=False, yes=False)
    (recording,) = read_logs([record(bench, hand, options, helper)], hand).recordings.values()
    assert helper.told == 4 and not recording.time and off(bench) and bench.closed


@pytest.mark.slow
def test_motors_that_give_no_more_turn_round(hand, tmp_path):
    """A current limit far below what 8 N need: the press ends where the force ends."""
    hardware = dataclasses.replace(arguments(tmp_path).hardware, torque_max=90)  # 0.45 A on the bench
    bench = BenchHand(hand, plates(hand, "index pad"))
    options = arguments(tmp_path, hardware=hardware, sides=False)
    log = record(bench, hand, options)
    found = fit(read_logs([log], hand), hand)
    # As much as the joint gives by itself, or, pushed by the other one, as much as it holds.
    gives, holds = (
        (0.45 - 0.02) * bench.constant[4] * part / bench.plates[0].arms[4]
        for part in (bench.efficiency[4], 1.15 / bench.back[4])
    )
    assert gives < found.calibration.real.force_max[4] < holds < 7
    truth = bench.constant[4] * bench.efficiency[4]
    assert -torque_constants(found.calibration)[0, 4] == pytest.approx(truth, rel=0.05)


class Squeezed(BenchHand):
    """Somebody squeezes the ring finger with 20 N for half a second when the index is first pressed with 3 N."""

    def __init__(self, hand):
        super().__init__(hand, plates(hand, "index pad"))
        self.since, self.seen = None, []  # seen: numbers of the exchanges before which the hand reported it

    def exchange(self, command):
        if self.touched.any():
            self.seen.append(self.sequence + 1)
        if self.since is None and self.force[1] > 3.0:
            self.since = self.time
        self.touched[3, 40:60] = 1.0 if self.since is not None and self.time < self.since + 0.5 else 0.0
        return super().exchange(command)


def test_a_press_waits_while_safety_holds_the_hand(hand, tmp_path, monkeypatch):
    """Its target stays where it is, none of the samples is one of the press, and then the press continues."""
    bench, asked, set_target = Squeezed(hand), {}, Safety.set_target

    def ask(safety, position, *rest):
        asked[bench.sequence + 1] = np.array(position)
        set_target(safety, position, *rest)

    monkeypatch.setattr(Safety, "set_target", ask)
    log = record(bench, hand, arguments(tmp_path, press=QUICK, sides=False))
    entries, held = list(LogReader(log)), bench.seen
    assert len(held) > 20 and "hold: the fingertip force is too high" in [entry.content for entry in entries]
    moved = [asked[number + 1] - asked[number] for number in range(held[0] - 2, held[-1] + 3)]
    # Two steps before the hold's first request, none until the first request after it, and two more.
    for step in (moved[1], *moved[-2:]):
        np.testing.assert_allclose(step, moved[0], atol=1e-9)
    assert moved[0][4] > 0 and not np.any(moved[2:-2])
    marks = [entry.content for entry in entries if entry.kind == Kind.TICK]
    loading = {mark["sequence"] for mark in marks if mark.get("phase") == "loading"}
    assert {held[0] - 1, held[-1] + 1} < loading and not set(held) & loading


@pytest.mark.slow
def test_nothing_is_overwritten(hand, session, tmp_path):
    _, _, log, _ = session
    path = tmp_path / "hand.toml"
    options = arguments(tmp_path)
    path.write_text("precious")
    with pytest.raises(HandError, match="already exists: give another --output, or --force"):
        arguments(tmp_path)
    with pytest.raises(HandError, match=f"already exists: --from-log {re.escape(str(log))} fits these"):
        fit_and_report(options, hand, [log], operator())  # It came while the hand was pressing.
    assert path.read_text() == "precious"
    fit_and_report(arguments(tmp_path, force=True), hand, [log], operator())
    assert load_calibration(path, hand).joint_names == hand.joint_names


@pytest.mark.parametrize(("option", "name"), [("plot", "hand.png"), ("report", "report.json")])
def test_a_figure_or_report_that_cannot_be_written_leaves_the_calibration(hand, session, tmp_path, option, name):
    (tmp_path / "file").touch()
    options = arguments(tmp_path, **{option: tmp_path / "file" / name})
    with pytest.raises(OSError, match="file"):
        fit_and_report(options, hand, [session[2]], operator())
    assert load_calibration(options.output, hand).joint_names == hand.joint_names


@pytest.mark.parametrize(
    ("option", "path", "says"),
    [
        ("--plot", "hand.abc", "error: --plot .*hand.abc: give a file that ends in .png, .pdf or .svg"),
        ("--plot", "hand", "give a file that ends in"),
        ("--plot", "file/hand.png", "error: .*file: File exists"),
        ("--report", "file/hand.json", "error: .*file: File exists"),
        ("--output", "file/hand.toml", "error: .*file(/hand.toml)?: (File exists|Not a directory)"),
        ("--plot", "folder.png", "error: .*folder.png: Is a directory"),
    ],
)
def test_where_nothing_can_be_written_nothing_moves(tmp_path, monkeypatch, capsys, option, path, says):
    (tmp_path / "file").touch()
    (tmp_path / "folder.png").mkdir()
    touched = []
    monkeypatch.setattr(calibrate, "prepare_jax", lambda: None)
    monkeypatch.setattr(calibrate, "record", lambda *_: touched.append("hand") or tmp_path / "no.log")
    output = [] if option == "--output" else ["--output", str(tmp_path / "hand.toml")]
    assert command("--port", "x", *output, option, str(tmp_path / path)) == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert re.search(says, line) and not touched


def test_the_folder_of_a_figure_is_made(tmp_path, monkeypatch):
    monkeypatch.setattr(calibrate, "prepare_jax", lambda: None)
    monkeypatch.setattr(calibrate, "record", lambda *_: tmp_path / "hand.log")
    monkeypatch.setattr(calibrate, "fit_and_report", lambda *_: None)
    options = ["--output", str(tmp_path / "hand.toml"), "--plot", str(tmp_path / "new" / "hand.PNG")]
    assert main(["--port", "x", *options]) == 0 and (tmp_path / "new").is_dir()


def test_logs_that_are_none_of_presses(hand, tmp_path):
    with LogWriter(tmp_path / "run.log") as log:
        log.add(Kind.META, {"task": "grasp"})
    with pytest.raises(LogError, match="this is a log of .grasp."):
        read_logs([tmp_path / "run.log"], hand)
    with LogWriter(tmp_path / "early.log") as log:
        log.add(Kind.NOTE, "end: no answer")
    with pytest.raises(LogError, match="ends before the hand was ready"):
        read_logs([tmp_path / "early.log"], hand)
    with LogWriter(tmp_path / "forged.log") as log:
        log.add(Kind.META, {"task": "calibrate"})
    with pytest.raises(LogError, match="forged.log: a record is not as the bridge writes it .KeyError"):
        read_logs([tmp_path / "forged.log"], hand)
    with pytest.raises(CalibrationError, match="no press was recorded"):
        bench = BenchHand(hand, [])
        with pytest.raises(HandError, match="met nothing"):
            record(bench, hand, arguments(tmp_path, press=QUICK))
        fit(read_logs([tmp_path / "hand.log"], hand), hand)


def test_options_that_do_not_go_together(tmp_path):
    for options, says in (
        ({"port": None}, "--port for a hand, or --from-log"),
        ({"from_log": (tmp_path / "a.log",)}, "--port for a hand, or --from-log"),
        ({"press": PressConfig(current=1.9)}, "must be below --safety.current"),
        ({"press": PressConfig(peak=20.0), "safety": SafetyConfig(finger_force=20.0)}, "well below"),
        ({"joints": ("mid_joint1",)}, "--joints needs --identify"),
        ({"dead_band": True}, "--dead-band needs --identify"),
        ({"identify": True, "fingers": ("index",)}, "--fingers is for presses: not with --identify"),
        ({"identify": True, "report": tmp_path / "report.json"}, "--report is for presses: not with --identify"),
    ):
        with pytest.raises(HandError, match=says):
            arguments(tmp_path, **options)
    with pytest.raises(ConfigError, match="PressConfig.peak"):
        PressConfig(peak=60.0)
    with pytest.raises(HandError, match="no_such_module"):
        Gauge("no_such_module:f", operator())
    with pytest.raises(HandError, match="--gauge ask needs answers"):
        Gauge("ask", operator())


@pytest.mark.parametrize("stream", [io.StringIO(""), None], ids=["at its end", "closed"])
def test_nobody_at_the_terminal(hand, tmp_path, monkeypatch, stream):
    monkeypatch.setattr(sys, "stdin", None)  # As Python has it after `<&-`.
    bench = BenchHand(hand, plates(hand, "index pad"))
    who = Operator(Console(file=io.StringIO()), stream=stream)
    with pytest.raises(HandError, match="standard input is closed .--yes asks nothing."):
        record(bench, hand, arguments(tmp_path, yes=False, press=QUICK), who)
    assert off(bench) and bench.closed


def command(*options):
    """The command in this process, with its exit code and the last line on standard error."""
    with pytest.raises(SystemExit) as stop:
        cli.run(lambda _: main(list(options)))
    return stop.value.code


def test_the_command_refuses_a_touched_hand_in_one_line(tmp_path, monkeypatch, capsys):
    pytest.importorskip("serial")
    monkeypatch.setattr(calibrate, "prepare_jax", lambda: None)
    with PtyHand() as peer:
        peer.state["tip"]["taxel"]["z"][3, 40:43] = 90
        output, log = tmp_path / "hand.toml", tmp_path / "hand.log"
        options = f"--port {peer.port} --yes --output {output} --log {log} --link.settle 0 --link.no-paced".split()
        options += "--check.seconds 0.5 --no-realtime".split()
        assert command(*options) == 2
        assert all(np.all(block["mode"] == Mode.PASSIVE) for block in peer.commands)
    lines = capsys.readouterr().err.strip().splitlines()
    assert "firmware 1.3.9" in lines[0]
    assert lines[-1].startswith("error: cannot tare the taxels: 3 adjacent taxels of the ring read above 40 counts")
    assert not (tmp_path / "hand.toml").exists()
    assert command("--port", "x", "--output", str(tmp_path / "hand.log")) == 2
    assert "already exists" in capsys.readouterr().err


@pytest.mark.parametrize("engaged", [False, True])
def test_a_hand_that_never_answers_ends_a_loop_whether_its_motors_are_on_or_not(hand, tmp_path, engaged):
    """Also where nothing waits for a number of answers: two seconds of silence are the end of it."""
    bench = BenchHand(hand, [])
    bench.exchange, clock = lambda command: None, SimpleNamespace(now=0.0)
    safety = Safety(hand, SafetyConfig())
    sleep = lambda seconds: setattr(clock, "now", clock.now + seconds)  # noqa: E731
    log = LogWriter(tmp_path / "a.log")
    loop = HandLoop(bench, HandSensing(hand, HardwareConfig()), safety, log, 50.0, clock=lambda: clock.now, sleep=sleep)
    if engaged:
        safety.engage()
    try:
        with pytest.raises(HandError, match="stopped: .* for 2 s"):
            for _ in range(round(3.0 * 50)):
                loop.step()
    finally:
        log.close()
    assert 2.0 < clock.now < 2.2


def test_a_level_that_the_current_does_not_allow_is_not_sought_beyond_it():
    """`_seek` is alone between the gauge's levels: the taxels may read too low, and then only the current ends it."""
    config = PressConfig(current=0.8)
    advanced, current = [0.0], lambda: 10.0 * advanced[0]  # A, the motor winds up; the taxels feel nothing
    procedure = object.__new__(PressProcedure)
    procedure.config, procedure._advance = config, 0.0
    procedure.loop = SimpleNamespace(pace=SimpleNamespace(period=0.01))
    procedure._force, procedure._current = lambda exchange: 0.0, lambda exchange: current()

    def step(advance, phase):
        procedure._advance = advanced[0] = advance
        return object()

    procedure._step = step
    procedure._seek(2.0, 0.1)
    assert current() == pytest.approx(0.8, abs=0.02) and procedure._advance < config.travel
