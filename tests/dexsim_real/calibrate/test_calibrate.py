"""The calibration command: a hand of known truth gives its torque constants back, and whatever goes wrong leaves the
motors off and files as they were."""

import dataclasses
import io
import json
import queue
import re
import signal
import subprocess
import sys
import time

import mujoco
import numpy as np
import press_bench
import pytest
from paths import ROOT
from press_bench import BenchHand, PlantPort, Plate
from pty_hand import PtyHand
from rich.console import Console

from dexsim.calibration.maps import joint_torque, load_calibration
from dexsim.core import cli
from dexsim.core.errors import CalibrationError, ConfigError
from dexsim_real.calibrate import __main__ as calibrate
from dexsim_real.calibrate import identify_drives
from dexsim_real.calibrate.__main__ import fit_and_report, main
from dexsim_real.calibrate.gauge import Gauge, parse_reading
from dexsim_real.calibrate.hand_loop import Operator
from dexsim_real.calibrate.options import CalibrateArguments, CheckConfig, PressConfig
from dexsim_real.calibrate.plan import placements
from dexsim_real.calibrate.press_fit import fit
from dexsim_real.calibrate.read import read_logs
from dexsim_real.calibrate.report import torque_constant_intervals, torque_constants
from dexsim_real.calibrate.taxel_check import check_rest, dead_taxels, taxel_names
from dexsim_real.control.safety import SafetyConfig
from dexsim_real.core.errors import HandError
from dexsim_real.core.log import Kind, LogError, LogReader, LogWriter
from dexsim_real.wire.frames import Mode

SHORT = PressConfig(cycles=3, seconds=5.0, approach_speed=0.3, first_speed=0.08)
QUICK = PressConfig(cycles=1, seconds=1.0, approach_speed=0.5, first_speed=0.2, pause=0.2)


def plates(hand, *names):
    """A spring before each named placement, which presses on twenty taxels or a dozen."""
    found = []
    for placement in placements(hand):
        if names and placement.name not in names:
            continue
        columns = (3, 4, 5, 6) if placement.name.endswith("pad") else (7, 8, 9)
        taxels = np.array([column * 12 + row for column in columns for row in range(3, 8)])
        share = np.exp(-0.5 * ((taxels % 12 - 5) / 1.2) ** 2)
        found.append(Plate(placement.finger, taxels, share / share.sum(), placement.posture, placement.joints))
    return found


def arguments(folder, **options):
    options = {
        "port": "bench",
        "output": folder / "hand.toml",
        "log": folder / "hand.log",
        "yes": True,
        "press": SHORT,
        "fingers": ("index",),
        "realtime": False,
    } | options
    return CalibrateArguments(**options)


def operator():
    return Operator(Console(file=io.StringIO(), width=200), assume_yes=True)


def record(bench, hand, options, who=None):
    return calibrate.record(options, hand, who or operator(), port=bench, clock=bench.clock, sleep=bench.sleep)


def off(bench):
    return np.all(bench.commands[-1]["mode"] == Mode.PASSIVE)


def on(bench):
    return np.array([np.all(command["mode"] == Mode.POSITION) for command in bench.commands])


# --- a known truth -------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def session(hand, tmp_path_factory):
    """The index pressed with pad and side: bench, arguments, log, what the terminal showed."""
    folder = tmp_path_factory.mktemp("press")
    bench = BenchHand(hand, plates(hand, "index pad", "index side"), dead=((1, 52), (1, 110)))
    options, who = arguments(folder, plot=folder / "hand.png", report=folder / "hand.json"), operator()
    log = record(bench, hand, options, who)
    fit_and_report(options, hand, [log], who)
    return bench, options, log, who.console.file.getvalue()


def test_torque_constants_come_back(hand, session):
    bench, options, _, _ = session
    calibration = load_calibration(options.output, hand)
    # Positive currents open, positive torques close: the hand's sense is in the sign.
    found, intervals = -torque_constants(calibration), -torque_constant_intervals(calibration)
    truth = np.stack([bench.constant * bench.efficiency, bench.constant / bench.back])
    joints = [hand.joint_names.index(name) for name in ("index_bend", "index_joint1", "index_joint2")]
    np.testing.assert_allclose(found[:, joints], truth[:, joints], rtol=0.03)
    assert np.mean(np.abs(found / truth - 1)[:, joints]) < 0.015
    inside = (intervals.min(-1) <= truth) & (truth <= intervals.max(-1))
    assert inside[:, joints].mean() >= 5 / 6
    # Where a run knows the direction, currents become torques; the zero error of the reading is in the offset.
    current = np.zeros(12)
    current[4] = -(0.5 / truth[0, 4] + bench.idle[4] + bench.bias[4])
    assert float(joint_torque(calibration, current, np.ones(12))[4]) == pytest.approx(0.5, rel=0.04)
    # Half the gap between the lines in the middle of the forces, which reach from about 1 N to 8 N.
    assert calibration.real.force_max[4] == pytest.approx(8.0, abs=0.5)
    torque = 4.5 * bench.plates[0].arms[4]
    gap = torque * (1 / truth[0, 4] - 1 / truth[1, 4]) / 2 + bench.idle[4]
    assert calibration.real.friction[4] == pytest.approx(gap, rel=0.15)


def test_the_file_says_what_is_not_known_and_the_report_has_it_all(hand, session):
    _, options, _, shown = session
    notes = "\n".join(load_calibration(options.output, hand).notes)
    assert "ring_joint1: not recorded" in notes and "error of the force sensor" in notes
    # Of the two that read nothing the one in the middle of the press is dead; the other lies beside it.
    assert "index: dead: column 4 row 4:" in notes and "column 9 row 2" not in notes
    assert "motors off, the currents read up to" in notes
    report = json.loads(options.report.read_text())
    joint = report["joints"]["index_joint1"]
    assert joint["press"] == "index pad" and joint["loading"]["r_squared"] > 0.99
    assert joint["loading"]["condition"] < 10 and joint["loading"]["samples"] > 20
    assert report["joints"]["mid_joint1"]["press"] is None
    assert report["newtons_per_count"] == dict.fromkeys(hand.finger_names, 0.1)
    assert "Nm / A" in shown and "index side" in shown and f"calibration: {options.output}" in shown
    assert options.plot.stat().st_size > 20_000


def test_the_motors_come_on_late_stay_within_limits_and_go_off(hand, session):
    bench, options, _, _ = session
    motors = on(bench)
    resting = round(options.check.seconds * options.rate)
    assert not motors[:resting].any() and off(bench) and bench.closed
    sent = np.array([command["position"] for command in bench.commands])[motors]
    assert np.all(sent >= hand.joint_lower - 1e-6) and np.all(sent <= hand.joint_upper + 1e-6)
    assert np.abs(np.diff(sent, axis=0)).max() <= 2.0 / options.rate * 1.2


def test_a_log_gives_the_same_file_without_the_hand(hand, session, tmp_path):
    _, options, log, _ = session
    again = CalibrateArguments(from_log=(log,), output=tmp_path / "again.toml")
    fit_and_report(again, hand, again.from_log, operator())
    assert again.output.read_bytes() == options.output.read_bytes()


def test_logs_add_up(hand, session, scale, tmp_path):
    """What one session left out another has pressed."""
    other = scale[1].log
    both = fit(read_logs([session[2], other], hand), hand)
    assert {both.source[name] for name in ("index_joint1", "mid_joint1", "index_bend")} == {
        "index pad",
        "middle pad",
        "index side",
    }
    assert both.sensors.keys() == {"middle"}
    with pytest.raises(LogError, match="other --hardware options"):
        path = tmp_path / "other.log"
        with LogWriter(path) as log:
            for entry in LogReader(other):
                content = entry.content
                if entry.kind == Kind.META and "hardware" in content:
                    content = {**content, "hardware": {**content["hardware"], "taxel_floor": 2.0}}
                log.add(entry.kind, content, entry.time)
        read_logs([other, path], hand)


class Typist(io.StringIO):
    """A terminal and who sits at it: presses Enter when told to, types in what the scale shows."""

    def __init__(self, bench):
        super().__init__()
        self.bench, self.lines, self.read = bench, queue.SimpleQueue(), 0

    def write(self, text):
        if "Enter presses" in text:
            self.lines.put("\n")
        elif "the gauge shows" in text:
            self.read += 1
            grams = 1e3 * self.bench.force[2] / 9.80665
            # A slip of the finger first: it is asked for again.
            self.lines.put("five\n" if self.read == 2 else f"{grams:.0f} g\n")
        return super().write(text)

    def __iter__(self):
        return self

    def __next__(self):
        return self.lines.get()

    def isatty(self):
        return False


@pytest.fixture(scope="module")
def scale(hand, tmp_path_factory):
    """The middle pressed on a kitchen scale; its taxels read 15 % too little."""
    bench = BenchHand(hand, plates(hand, "middle pad"), taxel_gain=[1, 1, 0.85, 1, 1])
    typist = Typist(bench)
    who = Operator(Console(file=typist, width=200), stream=typist)
    options = arguments(tmp_path_factory.mktemp("scale"), fingers=("middle",), gauge="ask", yes=False)
    fit_and_report(options, hand, [record(bench, hand, options, who)], who)
    return bench, options, typist


def test_a_kitchen_scale_gives_the_newtons(hand, scale):
    """Without the scale all torques would be 15 % too small."""
    bench, options, typist = scale
    assert typist.read == 12 and "'five' is no reading" in typist.getvalue()
    calibration = load_calibration(options.output, hand)
    truth = np.stack([bench.constant * bench.efficiency, bench.constant / bench.back])
    np.testing.assert_allclose(-torque_constants(calibration)[:, 6:8], truth[:, 6:8], rtol=0.03)
    # As a run sees them, counts below the floor are cut off, so that the slope is a little steeper than the taxels'.
    assert calibration.force_per_count[2] == pytest.approx(0.1 / 0.85, rel=0.1)
    notes = "\n".join(calibration.notes)
    assert "middle pad:" in notes and "counts per newton by the gauge (11 readings)" in notes
    assert "thumb: not compared with the gauge" in notes and "error of the force sensor" not in notes


def test_too_few_readings_do_not_count(hand, scale):
    session = read_logs([scale[1].log], hand)
    recording = session.recordings["middle pad"]
    recording.gauge = dict(list(recording.gauge.items())[:7])
    found = fit(session, hand)
    assert not found.sensors and np.all(np.asarray(found.calibration.force_per_count) == 0.1)
    assert any("middle pad: 7 readings of the gauge do not count" in note for note in found.calibration.notes)


@pytest.mark.parametrize(
    ("text", "newtons"),
    [("5.2", 5.2), ("5,2 N", 5.2), ("530 g", 5.197525), ("0.53kg", 5.197525), (" .5n ", 0.5), ("0", 0.0)],
)
def test_readings_of_a_gauge(text, newtons):
    assert parse_reading(text) == pytest.approx(newtons)


@pytest.mark.parametrize("text", ["", "five", "5 lb", "-3", "1e3", "nan", "530", "5.2.1"])
def test_what_is_no_reading(text):
    with pytest.raises(HandError, match="no reading|grams need a g"):
        parse_reading(text)


# --- the plan --------------------------------------------------------------------------------------


def test_every_joint_is_pressed_with_and_every_press_goes_outward(hand):
    """Against C MuJoCo: advancing moves the pressed taxels along their normals, from a posture that can be reached."""
    plan = placements(hand)
    assert {joint for placement in plan for joint in placement.joints} == set(range(12))
    model = mujoco.MjModel.from_xml_path(str(hand.model_path))
    data = mujoco.MjData(model)
    dofs = [model.joint(name).qposadr[0] for name in hand.joint_names]
    for placement in plan:
        assert np.abs(placement.direction).max() == 1.0

        def places(advance, placement=placement):
            data.qpos[dofs] = placement.posture + advance * placement.direction
            mujoco.mj_kinematics(model, data)
            body = model.body(hand.body_names[hand.tip_body[placement.finger]]).id
            turn = data.xmat[body].reshape(3, 3)
            taxels = list(placement.taxels)
            return (
                data.xpos[body] + hand.taxel_position[placement.finger, taxels] @ turn.T,
                hand.taxel_normal[placement.finger, taxels] @ turn.T,
            )

        (before, normal), (after, _) = places(0.0), places(0.01)
        moved = np.mean(np.sum((after - before) * normal, -1))
        assert moved > 0.7 * 0.01 * 0.08, placement.name
        assert np.all(placement.posture >= hand.joint_lower) and np.all(placement.posture <= hand.joint_upper)
    assert {p.name for p in placements(hand, ("thumb",), sides=False)} == {"thumb pad"}
    with pytest.raises(HandError, match="no finger 'toe'"):
        placements(hand, ("toe",))


# --- the taxels ------------------------------------------------------------------------------------


def resting(seed=0, count=160):
    rng = np.random.default_rng(seed)
    counts = np.round(rng.uniform(0, 6, (5, 120)) + 0.4 * rng.standard_normal((count, 5, 120)))
    return np.maximum(counts, 0), rng.normal(5, 2, (count, 12))


def test_what_a_hand_at_rest_shows(hand):
    counts, current = resting()
    report = check_rest(hand, counts, current, CheckConfig(), 40.0, tuple(range(5)))
    assert report.notes == ()
    np.testing.assert_allclose(report.tare, counts.mean(0))
    assert np.all(np.abs(report.current - 5) < 1)
    noisy = counts.copy()
    noisy[:, 2, 31] += 8 * (np.random.default_rng(1).random(len(counts)) < 0.5)
    notes = check_rest(hand, noisy, current, CheckConfig(), 40.0, (2,)).notes
    assert len(notes) == 1 and notes[0].startswith("middle: noisy: column 2 row 7 (up to 4")


def test_a_touch_is_told_from_a_taxel_that_is_stuck(hand):
    counts, current = resting()
    stuck = counts.copy()
    stuck[:, 4, 17] = 255
    with pytest.raises(HandError, match="pinky: column 1 row 5 read 255 counts alone and are stuck") as caught:
        check_rest(hand, stuck, current, CheckConfig(), 40.0, ())
    assert "\n" not in str(caught.value)
    touched = counts.copy()
    touched[:, 0, [40, 41, 52, 53]] += 60
    with pytest.raises(HandError, match="4 adjacent taxels of the thumb .* touches it") as caught:
        check_rest(hand, touched, current, CheckConfig(), 40.0, ())
    assert "\n" not in str(caught.value)
    # A light touch hides among what is left at rest, unless it changes.
    swaying = counts.copy()
    swaying[:, 3, 50:60] += np.round(2 + 2 * np.sin(np.arange(len(counts)) / 25))[:, None]
    with pytest.raises(HandError, match="ring's sum moved by .* touches it"):
        check_rest(hand, swaying, current, CheckConfig(), 40.0, ())


def test_dead_taxels_are_those_among_pressed_ones(hand):
    rng = np.random.default_rng(0)
    lattice = np.zeros((50, 10, 12))
    lattice[:, 2:8, 3:9] = rng.uniform(5, 20, (50, 6, 6))
    lattice[:, 4, 5] = lattice[:, 6, 7] = 0.0
    dead = dead_taxels(hand, lattice.reshape(50, 120), 5.0)
    assert taxel_names(hand, dead) == "column 4 row 5, column 6 row 7"


def test_a_touched_hand_is_refused_before_the_motors_come_on(hand, tmp_path):
    bench = BenchHand(hand, plates(hand, "index pad"))
    bench.touched[2, [40, 41, 52, 53]] = 6.0
    with pytest.raises(HandError, match="on the middle .* free the fingertips"):
        record(bench, hand, arguments(tmp_path, press=QUICK))
    assert not on(bench).any() and bench.closed and not (tmp_path / "hand.toml").exists()


def test_a_finger_zeroed_under_load_is_found_out(hand, tmp_path):
    """Somebody holds the index when it is zeroed, too lightly to be seen, and lets go during the press."""
    bench = BenchHand(hand, plates(hand, "index pad"))
    bench.touched[1, 30:60] = 0.3
    exchange = bench.exchange

    def let_go(command):
        if bench.force[1] > 1.0:
            bench.touched[:] = 0
        return exchange(command)

    bench.exchange = let_go
    with pytest.raises(HandError, match="index pad: reads -.* it was touched while it was zeroed"):
        record(bench, hand, arguments(tmp_path, press=QUICK))
    assert off(bench) and bench.closed


# --- what goes wrong -------------------------------------------------------------------------------


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
        (heat, HandError, "too hot: 95 degC"),
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


def test_logs_that_are_none_of_presses(hand, tmp_path):
    with LogWriter(tmp_path / "run.log") as log:
        log.add(Kind.META, {"task": "grasp"})
    with pytest.raises(LogError, match="is the log of something else .grasp."):
        read_logs([tmp_path / "run.log"], hand)
    with LogWriter(tmp_path / "early.log") as log:
        log.add(Kind.NOTE, "end: no answer")
    with pytest.raises(LogError, match="ends before the hand was ready"):
        read_logs([tmp_path / "early.log"], hand)
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
    ):
        with pytest.raises(HandError, match=says):
            arguments(tmp_path, **options)
    with pytest.raises(ConfigError, match="PressConfig.peak"):
        PressConfig(peak=60.0)
    with pytest.raises(HandError, match="no_such_module"):
        Gauge("no_such_module:f", operator())
    with pytest.raises(HandError, match="--gauge ask needs answers"):
        Gauge("ask", operator())


def test_nobody_at_the_terminal(hand, tmp_path):
    bench = BenchHand(hand, plates(hand, "index pad"))
    who = Operator(Console(file=io.StringIO()), stream=io.StringIO(""))
    with pytest.raises(HandError, match="standard input is closed .--yes asks nothing."):
        record(bench, hand, arguments(tmp_path, yes=False, press=QUICK), who)
    assert off(bench) and bench.closed


# --- the command over bytes --------------------------------------------------------------------------


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
        options = [
            "--port",
            peer.port,
            "--yes",
            "--output",
            str(tmp_path / "hand.toml"),
            "--log",
            str(tmp_path / "hand.log"),
            "--link.settle",
            "0",
            "--link.no-paced",
            "--check.seconds",
            "0.5",
            "--no-realtime",
        ]
        assert command(*options) == 2
        assert all(np.all(block["mode"] == Mode.PASSIVE) for block in peer.commands)
    lines = capsys.readouterr().err.strip().splitlines()
    assert "firmware 1.3.9" in lines[0]
    assert lines[-1].startswith("error: cannot tare the taxels: 3 adjacent taxels of the ring read above 40 counts")
    assert not (tmp_path / "hand.toml").exists()
    assert command("--port", "x", "--output", str(tmp_path / "hand.log")) == 2
    assert "already exists" in capsys.readouterr().err


# --- identification ----------------------------------------------------------------------------------


def identifying(bench, hand, folder, monkeypatch, **options):
    """Record with a fit that only keeps what it was given; the logs, by joint."""
    kept = {}

    def keep(log, start, **rest):
        kept[log.name] = log, start, rest
        raise CalibrationError("enough")

    monkeypatch.setattr(identify_drives, "identify", keep)
    options = arguments(folder, identify=True, output=folder / "hand.json", joints=("mid_joint1",), **options)
    with pytest.raises(CalibrationError, match="enough"):
        identify_drives.identify_hand(options, hand, operator(), port=bench, clock=bench.clock, sleep=bench.sleep)
    return kept["mid_joint1"]


def test_an_identification_gets_what_was_sent_and_answered(hand, tmp_path, monkeypatch):
    sign, offset = np.ones(12), np.zeros(12)
    sign[6], offset[6] = -1.0, 0.2
    hardware = dataclasses.replace(arguments(tmp_path).hardware, joint_sign=tuple(sign), joint_offset=tuple(offset))
    bench = BenchHand(hand, [])
    bench.position[6] = -0.3
    limits = dataclasses.replace(hand, joint_lower=np.full(12, -3.0), joint_upper=np.full(12, 3.0))
    bench.hand, states, exchange = limits, [], bench.exchange

    def lossy(command):
        reply = exchange(command)
        states.append(reply.state["joint"]["position"][6])
        return None if len(states) % 150 == 0 else reply

    bench.exchange = lossy
    log, start, rest = identifying(bench, hand, tmp_path, monkeypatch, hardware=hardware)
    assert off(bench) and bench.closed
    sent = np.array([command["position"][6] for command in bench.commands]) * -1.0 + 0.2
    answered = -np.array(states) + 0.2
    # The longest stretch of the commands that is the log's: every sample is there, also where no answer came.
    at = next(i for i in range(len(sent)) if np.allclose(sent[i : i + len(log.target)], log.target, atol=1e-6))
    wanted, lost = answered[at : at + len(log.target)], np.arange(at + 1, at + len(log.target) + 1) % 150 == 0
    np.testing.assert_allclose(log.position[~lost], wanted[~lost], atol=1e-6)
    assert 0 < lost.sum() < 20 and np.abs(log.position - wanted)[lost].max() < 0.05
    assert log.period == 1 / 83 and np.ptp(log.target) == pytest.approx(0.6, abs=0.01) and log.torque is None
    assert rest["holdout"] is not None and rest["dead_band"] is None and rest["substeps"] == 2
    # The inertia is the model's: a finger of 63 g and 56 mm with another link.
    assert 2e-4 < start["inertia"] < 2e-3 and start["stall_torque"] == pytest.approx(1.1)


def test_a_line_that_loses_too_much_identifies_nothing(hand, tmp_path):
    bench, count = BenchHand(hand, []), [0]
    exchange = bench.exchange

    def lossy(command):
        count[0] += 1
        reply = exchange(command)
        return None if count[0] % 20 == 0 else reply

    bench.exchange = lossy
    options = arguments(tmp_path, identify=True, output=tmp_path / "hand.json", joints=("mid_joint1",))
    with pytest.raises(LogError, match="mid_joint1: .* exchanges are missing"):
        identify_drives.identify_hand(options, hand, operator(), port=bench, clock=bench.clock, sleep=bench.sleep)
    with pytest.raises(LogError, match="is the log of something else .identify."):
        read_logs([options.log], hand)
    with pytest.raises(HandError, match="no joint 'knee'"):
        wrong = dataclasses.replace(options, joints=("knee",), log=tmp_path / "b.log")
        identify_drives.identify_hand(wrong, hand, operator())


# --- the emulated hand -------------------------------------------------------------------------------


@pytest.mark.long
@pytest.mark.parametrize("seed", [0, 1])
def test_the_emulated_hand_gives_its_torque_constants_back(hand, tmp_path, seed):
    """Gears with play, ripple, heat, taxels with faults, parameters outside the ranges of training; a gauge."""
    from dexsim_real.twin.press import PressBench

    plant = PressBench(hand, seed)
    bench, press_bench.GAUGE = PlantPort(plant), lambda: float(max(-plant._spring @ plant._normal, 0.0))
    options = arguments(tmp_path, fingers=("middle",), press=PressConfig(), gauge="press_bench:read_gauge")
    fit_and_report(options, hand, [record(bench, hand, options)], operator())
    found, truth = -torque_constants(load_calibration(options.output, hand)), plant.truth()
    error = np.array([found[0] / truth["loading_nm_per_a"], found[1] / truth["unloading_nm_per_a"]])[:, 6:8] - 1
    # Its motors warm up by 15 K and so lose 1.5 %; ripple is 3 %; contact and taxels differ by a millimetre.
    assert np.abs(error).max() < 0.08 and abs(error.mean()) < 0.05
    # The scale of the taxels is drawn up to 13 % off, and is known afterwards.
    scale = 0.1 / load_calibration(options.output, hand).force_per_count[2]
    assert scale == pytest.approx(truth["taxel_gain"][2], rel=0.06)


@pytest.mark.long
def test_the_command_on_the_emulated_hand_through_the_bytes(hand, tmp_path):
    """Two processes and a terminal between them."""
    twin = subprocess.Popen(
        [
            sys.executable,
            "-m",
            "dexsim_real.twin",
            "--plant",
            "dexsim_real.twin.press",
            "--link",
            str(tmp_path / "port"),
            "--imu-link",
            str(tmp_path / "imu"),
            "--parameters",
            "nominal",
            "--output",
            str(tmp_path / "truth.json"),
        ],
        cwd=ROOT,
    )
    try:
        until = time.monotonic() + 60
        while not (tmp_path / "port").exists() and time.monotonic() < until:
            time.sleep(0.1)
        done = subprocess.run(
            [
                sys.executable,
                "-m",
                "dexsim_real.calibrate",
                "--port",
                str(tmp_path / "port"),
                "--yes",
                "--fingers",
                "middle",
                "--output",
                str(tmp_path / "hand.toml"),
                "--log",
                str(tmp_path / "hand.log"),
            ],
            cwd=ROOT,
            capture_output=True,
            text=True,
            timeout=300,
        )
        assert done.returncode == 0, done.stderr
    finally:
        twin.send_signal(signal.SIGINT)
        twin.wait(30)
    report = json.loads((tmp_path / "truth.json").read_text())
    truth, found = report["trials"][0], -torque_constants(load_calibration(tmp_path / "hand.toml", hand))
    error = np.array([found[0] / truth["loading_nm_per_a"], found[1] / truth["unloading_nm_per_a"]])[:, 6:8] - 1
    assert np.abs(error).max() < 0.1
    assert report["commands"]["outside_limits"] == 0
