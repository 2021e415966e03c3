"""Presses of a hand with known torque constants, fitted from its log; readings of a gauge."""

import dataclasses
import io
import json
import queue

import numpy as np
import pytest
from calibrating import QUICK, arguments, off, on, operator, plates, record
from press_bench import BenchHand
from rich.console import Console

from dexsim.calibration.maps import calibrated_hand, joint_torque, load_calibration, normalised_torque
from dexsim.core.errors import CalibrationError
from dexsim.touch.estimate import ForceEstimate, estimate_force
from dexsim_real.calibrate.__main__ import fit_and_report
from dexsim_real.calibrate.force_scale import upright
from dexsim_real.calibrate.gauge import parse_reading
from dexsim_real.calibrate.hand_loop import Operator
from dexsim_real.calibrate.options import CalibrateArguments
from dexsim_real.calibrate.press_fit import fit
from dexsim_real.calibrate.read import read_logs
from dexsim_real.calibrate.report import torque_constant_intervals, torque_constants
from dexsim_real.core.errors import HandError
from dexsim_real.core.log import Kind, LogError, LogReader, LogWriter


@pytest.mark.slow
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


def test_the_force_over_the_root_joints_torque_comes_back(hand, session):
    """One over the plate's lever arm, of a hand whose motors and losses are not those of the model."""
    bench, options, _, shown = session
    calibration = load_calibration(options.output, hand)
    value, low, high = np.asarray(calibration.force_per_torque)[:, 1]
    truth = 1.0 / bench.plates[0].arms[4]
    assert low < truth < high and value == pytest.approx(truth, rel=0.02) and high - low < 0.35 * truth
    assert np.all(np.asarray(calibration.force_per_torque)[:, [0, 2, 3, 4]] == 0) and "(hand's TOML)" in shown
    used = calibrated_hand(hand, calibration).force_per_torque
    np.testing.assert_allclose(used[[0, 2, 3, 4]], hand.force_per_torque[[0, 2, 3, 4]])
    assert used[1] == pytest.approx(value) and calibrated_hand(hand, None) is hand
    # What a run reads of a press at 6 N while the finger closes: the estimate is off by the friction alone.
    torque = 6.0 / truth
    current = np.zeros(12)
    current[4] = -(torque / (bench.constant * bench.efficiency)[4] + bench.idle[4] + bench.bias[4])
    read = normalised_torque(calibration, current)
    taxels = np.zeros((5, hand.num_taxels))
    taxels[1, 50] = 1.0
    force = estimate_force(ForceEstimate(torque_share=1.0), calibrated_hand(hand, calibration), taxels, read)[1]
    friction = calibration.real.friction[4] / abs(np.mean(calibration.real.gain[:, 4]))
    assert abs(float(force) - 6.0) < friction * 1.3 + 0.3


def test_the_file_names_the_hand(hand, session):
    calibration = load_calibration(session[1].output, hand)
    assert (calibration.serial, calibration.handedness) == ("2R32BENCH", "right")


def test_the_file_says_what_is_not_known_and_the_report_has_it_all(hand, session):
    _, options, _, shown = session
    notes = "\n".join(load_calibration(options.output, hand).notes)
    assert "ring_joint1: not recorded" in notes and "error of the force sensor" in notes
    # Of the two that read nothing the one in the middle of the press is dead; the other lies beside it.
    assert "index: dead: column 4 row 4 read" in notes and "column 9 row 2" not in notes
    assert "with the motors off the currents read up to" in notes
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


@pytest.mark.slow
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


def test_a_skipped_press_leaves_the_one_of_the_log_before(hand, session, tmp_path):
    who = Operator(Console(file=io.StringIO(), width=200), stream=io.StringIO("s\n"))
    options = arguments(tmp_path, sides=False, yes=False)
    skipped = record(BenchHand(hand, []), hand, options, who)
    alone, both = (read_logs(logs, hand).recordings for logs in ([session[2]], [session[2], skipped]))
    assert not read_logs([skipped], hand).recordings["index pad"].time
    assert both.keys() == alone.keys() == {"index pad", "index side"}
    assert [press.time for press in both.values()] == [press.time for press in alone.values()]
    # One that was pressed again is the new one.
    options = arguments(tmp_path, sides=False, press=QUICK, log=tmp_path / "again.log")
    again = record(BenchHand(hand, plates(hand, "index pad")), hand, options)
    both, new = (read_logs(logs, hand).recordings for logs in ([session[2], again], [again]))
    assert both["index pad"].time == new["index pad"].time and both["index side"].time == alone["index side"].time


def test_an_interrupted_press_leaves_the_one_of_the_log_before(hand, session, tmp_path):
    """Cut in the middle of the last press, before the fingertip was free."""
    entries = list(LogReader(session[2]))
    marks = [k for k, e in enumerate(entries) if e.kind == Kind.TICK and e.content["press"] == "index pad"]
    with LogWriter(tmp_path / "cut.log") as log:
        for entry in entries[: marks[len(marks) * 3 // 5]]:
            log.add(entry.kind, entry.content, entry.time)
    whole, cut, both = (read_logs(logs, hand) for logs in ([session[2]], [log.path], [session[2], log.path]))
    assert cut.recordings["index pad"].time and not cut.recordings["index pad"].finished
    assert both.recordings["index pad"].time == whole.recordings["index pad"].time
    assert not any("interrupted" in note for note in fit(both, hand).calibration.notes)
    assert any(note.startswith("index pad: was interrupted") for note in fit(cut, hand).calibration.notes)


def test_a_press_that_no_taxel_feels_is_left_out(hand, session, scale):
    """Six taxels of one count each are contact enough for the procedure; the current ends the press."""
    faint = np.zeros(hand.num_taxels)
    faint[50:56] = 1.0
    recorded = read_logs([session[2], scale[1].log], hand)
    pad, gauged = recorded.recordings["index pad"], recorded.recordings["middle pad"]
    gauged.counts = [faint] * len(gauged.counts)
    found = fit(recorded, hand)
    assert set(found.source.values()) == {"index pad", "index side"} and not found.sensors
    assert any(
        note.startswith("middle pad: left out: no taxel read 2 counts or more") for note in found.calibration.notes
    )
    recorded.recordings = {"index pad": pad}
    pad.counts = [faint] * len(pad.counts)
    with pytest.raises(CalibrationError, match="index pad: left out: no taxel read 2 counts"):
        fit(recorded, hand)


def test_no_file_of_a_command_overwrites_another(hand, session, tmp_path):
    (tmp_path / "link").symlink_to(tmp_path)
    same = tmp_path / "link" / "hand.toml"
    for options, says in (
        ({"report": same}, "link/hand.toml is given for both --output and --report"),
        ({"plot": tmp_path / "a.png", "report": tmp_path / "a.png"}, "for both --report and --plot"),
        ({"log": tmp_path / "hand.toml"}, "for both --output and --log"),
        ({"port": None, "from_log": (same, session[2]), "force": True}, "for both --from-log and --output"),
        (
            {"port": None, "from_log": (session[2],), "report": session[2], "force": True},
            "for both --from-log and --rep",
        ),
        ({"report": session[2]}, "already exists: give another --report, or --force to overwrite it"),
        ({"identify": True, "calibration": same, "force": True}, "for both --calibration and --output"),
    ):
        with pytest.raises(HandError, match=says):
            arguments(tmp_path, **options)
    options = arguments(tmp_path, report=tmp_path / "hand.json")
    options.report.write_text("precious")  # It came while the hand was pressing.
    with pytest.raises(HandError, match="hand.json already exists: .* fits these presses into another --report"):
        fit_and_report(options, hand, [session[2]], operator())
    assert options.report.read_text() == "precious" and not options.output.exists()
    fit_and_report(dataclasses.replace(options, force=True), hand, [session[2]], operator())
    assert options.output.exists() and options.report.read_text() != "precious"


class Typist(io.StringIO):
    """A terminal and who sits at it: presses Enter when told to, types in what the scale shows."""

    def __init__(self, bench):
        super().__init__()
        self.bench, self.lines, self.read = bench, queue.SimpleQueue(), 0

    def write(self, text):
        if "Enter presses" in text:
            self.lines.put("\n")
        elif "reading of the gauge" in text:
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
    assert typist.read == 12 and "'five' is not a reading" in typist.getvalue()
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
    assert any("middle pad: 7 gauge readings are ignored" in note for note in found.calibration.notes)


def test_without_the_scale_its_error_is_in_the_intervals(hand, scale):
    """The taxels read 15 % too little, and nothing in the presses shows it."""
    bench, options, _ = scale
    session = read_logs([options.log], hand)
    truth = np.stack([bench.constant * bench.efficiency, bench.constant / bench.back])[:, 6:8]
    for recording in session.recordings.values():
        recording.gauge = {}
    found = fit(session, hand).calibration
    low, high = np.sort(-torque_constant_intervals(found)[:, 6:8], -1).transpose(2, 0, 1)
    assert np.all((low < truth) & (truth < high)) and np.all(high - low < 0.8 * truth)
    assert np.all(np.abs(-torque_constants(found)[:, 6:8] / truth - 1) > 0.1)
    assert any(note.startswith("no gauge: ") for note in found.notes)
    # One joint of each strength was pressed, so nothing is known of how others differ.
    other = torque_constant_intervals(found)[:, 0]
    assert np.all(other.min(-1) < 0) and np.all(found.real.samples[:, 0] == 0)
    assert any("% low" in note for note in found.notes)  # the bias of the method


def test_a_joint_that_shear_loads_is_left_out(hand, scale):
    """The fit takes all force along the normal; by the taxels' x and y most of it is not."""
    session = read_logs([scale[1].log], hand)
    recording = session.recordings["middle pad"]
    plain = torque_constant_intervals(fit(session, hand).calibration)[:, 6]
    sums = np.array(recording.counts).sum(-1)
    recording.shear = list(np.outer(sums, [0.0, 0.3]))
    shifted = torque_constant_intervals(fit(session, hand).calibration)[:, 6]
    assert np.all(np.ptp(shifted, -1) > np.ptp(plain, -1))
    recording.shear = list(np.outer(sums, [0.0, 20.0]))
    with pytest.raises(CalibrationError, match="mid_joint1: loaded by shear while the middle pad was pressed"):
        fit(session, hand)


def test_the_gauge_stands_still_while_the_fingertip_turns(hand):
    position = np.zeros((3, 12))
    position[:, 6] = 0.3, 0.3, 0.5  # rad, about the knuckle
    counts = np.zeros((3, hand.num_taxels))
    counts[:, 65] = 5.0, 20.0, 40.0
    np.testing.assert_allclose(upright(hand, 2, counts, position), [1.0, 1.0, np.cos(0.2)], atol=5e-4)


@pytest.mark.parametrize(
    ("text", "newtons"),
    [("5.2", 5.2), ("5,2 N", 5.2), ("530 g", 5.197525), ("0.53kg", 5.197525), (" .5n ", 0.5), ("0", 0.0)],
)
def test_readings_of_a_gauge(text, newtons):
    assert parse_reading(text) == pytest.approx(newtons)


@pytest.mark.parametrize("text", ["", "five", "5 lb", "-3", "1e3", "nan", "530", "5.2.1"])
def test_what_is_no_reading(text):
    with pytest.raises(HandError, match="not a reading|grams need a g"):
        parse_reading(text)
