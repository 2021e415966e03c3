"""Presses of a hand with known torque constants, fitted from its log; readings of a gauge."""

import dataclasses

import numpy as np
import pytest
from calibrating import Typist, arguments, off, on, operator, plates, record
from press_bench import BenchHand

from dexsim.calibration.maps import (
    calibrated_hand,
    joint_torque,
    load_calibration,
    normalised_torque,
    torque_constants,
)
from dexsim.errors import CalibrationError
from dexsim.touch.reduce import estimate_force
from dexsim_real.calibrate.__main__ import fit_and_report
from dexsim_real.calibrate.bench import CalibrateArguments
from dexsim_real.calibrate.press_fit import fit, read_presses
from dexsim_real.core.log import Kind, LogReader, LogWriter


def truth_of(bench):
    """Torque constants [2, J] loading and unloading. Positive currents open, positive torques close the hand."""
    return -np.stack([bench.constant * bench.efficiency, bench.constant / bench.back])


def test_torque_constants_come_back(hand, session):
    bench, options, _, _ = session
    calibration, truth = load_calibration(options.output, hand), truth_of(session[0])
    constants, errors = torque_constants(calibration)
    joints = [hand.joint_names.index(name) for name in ("index_bend", "index_joint1", "index_joint2")]
    np.testing.assert_allclose(constants[:, joints], truth[:, joints], rtol=0.03)
    assert np.mean(np.abs(constants / truth - 1)[:, joints]) < 0.015
    assert np.mean(np.abs(constants - truth) <= errors, where=np.isin(np.arange(12), joints)) >= 5 / 6
    # Half way between the currents that press and that give way; the zero error of the reading is in the offset.
    current = np.zeros(12)
    current[4] = np.mean(0.5 / truth[:, 4]) - bench.bias[4]
    assert float(joint_torque(calibration, current)[4]) == pytest.approx(0.5, rel=0.04)
    # Half the gap between the lines in the middle of the forces, which reach from about 1 N to 8 N.
    assert calibration.real.force_max[4] == pytest.approx(8.0, abs=0.5)
    torque = 4.5 * bench.plates[0].arms[4]
    gap = torque * (1 / truth[1, 4] - 1 / truth[0, 4]) / 2 + bench.idle[4]
    assert calibration.real.friction[4] == pytest.approx(gap, rel=0.15)


def test_the_force_over_the_root_joints_torque_comes_back(hand, session):
    """One over the plate's lever arm, of a hand whose motors and losses are not those of the model."""
    bench, options, _, shown = session
    calibration = load_calibration(options.output, hand)
    value, low, high = np.asarray(calibration.force_per_torque)[:, 1]
    truth = 1.0 / bench.plates[0].arms[4]
    assert low < truth < high and value == pytest.approx(truth, rel=0.02) and high - low < 0.35 * truth
    assert np.all(np.asarray(calibration.force_per_torque)[:, [0, 2, 3, 4]] == 0) and f"{value:.1f}" in shown
    # The thumb keeps its own, pressed or not.
    found = np.asarray(calibration.force_per_torque) + [9.0, 0, 0, 0, 0]
    used = calibrated_hand(hand, dataclasses.replace(calibration, force_per_torque=found)).force_per_torque
    np.testing.assert_allclose(used[[0, 2, 3, 4]], hand.force_per_torque[[0, 2, 3, 4]])
    assert used[1] == pytest.approx(value) and calibrated_hand(hand, None) is hand
    # What a run reads of a press at 6 N while the finger closes: the estimate is off by the friction alone.
    current = np.zeros(12)
    current[4] = 6.0 / truth / truth_of(bench)[0, 4] - bench.idle[4] - bench.bias[4]
    taxels = np.zeros((5, hand.num_taxels))
    taxels[1, 50] = 1.0
    read = normalised_torque(calibration, current)
    force = estimate_force(1.0, calibrated_hand(hand, calibration), taxels, read)[1]
    friction = calibration.real.friction[4] / abs(np.mean(calibration.real.gain[:, 4]))
    assert abs(float(force) - 6.0) < friction * 1.3 + 0.3


def test_the_calibration_names_its_hand_and_dead_taxels(hand, session):
    _, options, _, shown = session
    calibration = load_calibration(options.output, hand)
    assert (calibration.serial, calibration.handedness) == ("2R32BENCH", "right")
    # Of the two that read nothing the one in the middle of the press is dead; the other lies beside it.
    notes = "\n".join(calibration.notes)
    assert "index: dead: column 4 row 4 read" in notes and "column 9 row 2" not in notes
    assert "index side" in shown


def test_motors_come_on_late_stay_within_limits_and_go_off(hand, session):
    bench, options, _, _ = session
    motors = on(bench)
    assert not motors[: round(2.0 * options.rate)].any() and off(bench) and bench.closed
    sent = np.array([command["position"] for command in bench.commands])[motors]
    assert np.all(sent >= hand.joint_lower - 1e-6) and np.all(sent <= hand.joint_upper + 1e-6)
    assert np.abs(np.diff(sent, axis=0)).max() <= 2.0 / options.rate * 1.2


def test_a_log_gives_the_same_file_without_the_hand(hand, session, tmp_path):
    _, options, log, _ = session
    again = CalibrateArguments(from_log=(log,), output=tmp_path / "again.toml")
    fit_and_report(again, hand, again.from_log, operator())
    assert again.output.read_bytes() == options.output.read_bytes()


def test_a_press_is_taken_from_the_last_log_that_finished_it(hand, session, tmp_path):
    entries = list(LogReader(session[2]))
    marks = [k for k, e in enumerate(entries) if e.kind == Kind.TICK and e.content["press"] == "index pad"]
    for name, last in (("skipped", marks[0]), ("cut", marks[len(marks) * 4 // 5])):
        with LogWriter(tmp_path / name) as log:  # Before the press; in the middle of it.
            for entry in entries[:last]:
                log.add(entry.kind, entry.content, entry.time)
    (_, alone), (source, cut) = (read_presses([path], hand) for path in (session[2], log.path))
    together = read_presses([session[2], tmp_path / "skipped", log.path], hand)[1]
    assert [press.time.tolist() for press in together.values()] == [press.time.tolist() for press in alone.values()]
    assert not cut["index pad"].finished
    assert any(note.startswith("index pad: was interrupted") for note in fit(source, cut, hand)[0].notes)
    # One that was pressed again is the new one.
    with LogWriter(tmp_path / "again") as log:
        for entry in entries:
            if entry.kind != Kind.TICK or entry.content["press"] != "index side":
                log.add(entry.kind, entry.content, entry.time + 1000)
    both = read_presses([session[2], log.path], hand)[1]
    assert both["index pad"].time[0] == alone["index pad"].time[0] + 1000
    assert both["index side"].time[0] == alone["index side"].time[0]


def test_a_press_that_no_taxel_feels_is_left_out(hand, session, scale):
    """Six taxels of one count each are contact enough for the procedure; the current ends the press."""
    faint = np.zeros(hand.num_taxels)
    faint[50:56] = 1.0
    source, recorded = read_presses([session[2], scale[1].log], hand)
    pad, gauged = recorded["index pad"], recorded["middle pad"]
    gauged.counts = np.tile(faint, (len(gauged.counts), 1))
    calibration, joints = fit(source, recorded, hand)
    assert {found.press for found in joints.values()} == {"index pad", "index side"}
    assert any(note.startswith("middle pad: left out: no taxel") for note in calibration.notes)
    pad.counts = np.tile(faint, (len(pad.counts), 1))
    with pytest.raises(CalibrationError, match="index pad: left out: no taxel read 2 counts"):
        fit(source, {"index pad": pad}, hand)


# --- a gauge ---------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def scale(hand, tmp_path_factory):
    """The middle pressed on a kitchen scale; its taxels read 15 % too little."""
    bench = BenchHand(hand, plates(hand, "middle pad"), taxel_gain=[1, 1, 0.85, 1, 1])
    typist = Typist(lambda: bench.force[2])
    folder = tmp_path_factory.mktemp("scale")
    options = arguments(folder, fingers=("middle",), gauge=True, yes=False, plot=folder / "hand.png")
    fit_and_report(options, hand, [record(bench, hand, options, typist.operator())], typist.operator())
    return bench, options, typist


def test_a_kitchen_scale_gives_the_newtons(hand, scale):
    """Without the scale all torques would be 15 % too small."""
    bench, options, typist = scale
    assert typist.read == 12 and "'five' is not a reading" in typist.getvalue()
    assert options.plot.stat().st_size > 20_000
    calibration = load_calibration(options.output, hand)
    np.testing.assert_allclose(torque_constants(calibration)[0][:, 6:8], truth_of(bench)[:, 6:8], rtol=0.03)
    assert calibration.force_per_count[2] == pytest.approx(0.1 / 0.85, rel=0.02)
    notes = "\n".join(calibration.notes)
    assert "middle pad:" in notes and "counts per newton by the gauge (11 readings)" in notes
    assert "thumb: not compared with the gauge" in notes


def test_without_enough_readings_the_scales_error_is_in_the_intervals(hand, scale):
    """The taxels read 15 % too little, and nothing in the presses shows it."""
    bench, options, _ = scale
    source, recordings = read_presses([options.log], hand)
    truth = truth_of(bench)[:, 6:8]
    recording = recordings["middle pad"]
    recording.gauge = dict(list(recording.gauge.items())[:7])
    calibration = fit(source, recordings, hand)[0]
    constants, errors = torque_constants(calibration)
    assert np.all(np.abs(constants[:, 6:8] - truth) < errors[:, 6:8]) and np.all(errors[:, 6:8] < 0.4 * np.abs(truth))
    assert np.all(np.abs(constants[:, 6:8] / truth - 1) > 0.1)
    assert np.all(np.asarray(calibration.force_per_count) == 0.1)
    assert any(note.startswith("no gauge: ") for note in calibration.notes)
    # One joint of each strength was pressed, so nothing is known of how others differ.
    assert np.all(errors[:, 0] > np.abs(constants[:, 0]))


def test_a_joint_that_shear_loads_is_left_out(hand, scale):
    """The fit takes all force along the normal; by the taxels' x and y most of it is not."""
    session = read_presses([scale[1].log], hand)
    recording = session[1]["middle pad"]
    plain = torque_constants(fit(*session, hand)[0])[1][:, 6]
    sums = recording.counts.sum(-1)
    recording.shear = np.outer(sums, [0.0, 0.3])
    assert np.all(torque_constants(fit(*session, hand)[0])[1][:, 6] > plain)
    recording.shear = np.outer(sums, [0.0, 20.0])
    with pytest.raises(CalibrationError, match="mid_joint1: loaded by shear while the middle pad was pressed"):
        fit(*session, hand)
