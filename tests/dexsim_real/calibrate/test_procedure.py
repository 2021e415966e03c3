"""The plan of the presses; whatever goes wrong in one turns the motors off, or it is made again."""

import dataclasses
import io
import os
import re
import signal
import sys
import time
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
from calibrating import QUICK, SHORT, Typist, arguments, off, on, operator, plates, record
from press_bench import BenchHand

from dexsim.calibration.maps import save_calibration, torque_constants
from dexsim_real.calibrate.bench import Bench, Operator, PressConfig, parse_reading
from dexsim_real.calibrate.press_fit import fit, read_presses
from dexsim_real.calibrate.procedure import PressProcedure, placements
from dexsim_real.control.safety import Safety
from dexsim_real.core.errors import HandError
from dexsim_real.core.log import Kind, LogReader
from dexsim_real.twin.virtual import ideal_calibration
from dexsim_real.wire.frames import Mode
from dexsim_real.wire.link import Identity


def test_every_joint_is_pressed_with_and_every_press_goes_outward(hand):
    """Against C MuJoCo: advancing moves the pressed taxels along their normals, from a posture that can be reached."""
    plan = placements(hand)
    assert {joint for placement in plan for joint in placement.joints} == set(range(12))
    model = mujoco.MjModel.from_xml_path(str(hand.model_path))
    data = mujoco.MjData(model)
    dofs = [model.joint(name).qposadr[0] for name in hand.joint_names]
    for placement in plan:
        tip, taxels = hand.body_names[hand.tip_body[placement.finger]], list(placement.taxels)
        places = []
        for advance in (0.0, 0.01):
            data.qpos[dofs] = placement.posture + advance * placement.direction
            mujoco.mj_kinematics(model, data)
            turn = data.body(tip).xmat.reshape(3, 3).T
            places.append(data.body(tip).xpos + hand.taxel_position[placement.finger, taxels] @ turn)
            normal = hand.taxel_normal[placement.finger, taxels] @ turn
        moved = np.mean(np.sum((places[1] - places[0]) * normal, -1))
        assert np.abs(placement.direction).max() == 1.0 and moved > 0.7 * 0.01 * 0.08, placement.name
        assert np.all(placement.posture >= hand.joint_lower) and np.all(placement.posture <= hand.joint_upper)
    assert {p.name for p in placements(hand, ("thumb",), sides=False)} == {"thumb pad"}
    with pytest.raises(HandError, match="no finger 'toe'"):
        placements(hand, ("toe",))


def test_the_left_hand_is_calibrated_by_the_same_presses(hand, left):
    for one, other in zip(placements(hand), placements(left), strict=True):
        assert (one.name, one.joints, one.task) == (other.name, other.joints, other.task)
        np.testing.assert_array_equal(other.posture, one.posture)
        np.testing.assert_allclose(other.direction, one.direction, atol=1e-5)


def bench_of(port, hand, options):
    return Bench(options, hand, operator(), port=port, clock=port.clock, sleep=port.sleep)


def quick(folder, **options):
    return arguments(folder, **{"press": QUICK, "sides": False, **options})


@pytest.fixture
def pressed(hand):
    """A hand with a plate before its index finger."""
    return BenchHand(hand, plates(hand, "index pad"))


class Interrupted(BenchHand):
    """Something happens while it presses; from then on it may be silent.

    `stopped` is called at the first command to turn the motors off.
    """

    def __init__(self, hand, event, silent=False, stopped=lambda: None):
        super().__init__(hand, plates(hand, "index pad"))
        self.event, self.silent, self.stopped, self.pressing, self.was_on = event, silent, stopped, 0, False

    def exchange(self, command):
        motors_on = bool(np.all(command["mode"] == Mode.POSITION))
        if self.was_on and not motors_on:
            self.stopped()
        self.was_on = motors_on
        self.pressing += self.force[1] > 0.5
        if self.pressing == 30:
            self.pressing += 1
            self.event(self)
        reply = super().exchange(command)
        return None if self.silent and self.pressing > 30 else reply


def raises(error):
    def event(bench):
        raise error

    return event


@pytest.mark.parametrize(
    ("event", "silent", "error", "says"),
    [
        (raises(KeyboardInterrupt()), False, KeyboardInterrupt, None),
        (raises(SystemExit(143)), False, SystemExit, "143"),
        (raises(RuntimeError("broken")), False, RuntimeError, "broken"),
        (lambda hand: setattr(hand, "temperature", 95), False, HandError, r"too hot: joint thumb_bend .*, 95 degC"),
        (lambda hand: None, True, HandError, "stopped: no measurement for 2 s"),
    ],
)
def test_however_it_ends_the_motors_are_off_and_the_old_file_is_there(
    hand, tmp_path, monkeypatch, event, silent, error, says
):
    (tmp_path / "hand.toml").write_text("precious")
    bench = Interrupted(hand, event, silent)
    monkeypatch.setattr("dexsim_real.wire.link.time", SimpleNamespace(monotonic=bench.clock))
    with pytest.raises(error, match=says):
        record(bench, hand, quick(tmp_path, force=True))
    assert on(bench).any() and off(bench) and bench.closed
    assert (tmp_path / "hand.toml").read_text() == "precious"
    ends = [entry.content for entry in LogReader(tmp_path / "hand.log") if entry.kind == Kind.END]
    assert len(ends) == 1 and ends[0]["end"]


def test_a_hand_that_never_answers_ends_a_loop(hand, tmp_path):
    """Also where nothing waits for a number of answers: two seconds of silence are the end of it."""
    port = BenchHand(hand, [])
    port.exchange = lambda command: None
    with bench_of(port, hand, arguments(tmp_path)) as bench:
        with pytest.raises(HandError, match="no usable answer in 0.5 s; check the cable"):
            bench.collect(0.5)
        with pytest.raises(HandError, match="stopped: .* for 2 s"):
            bench.collect(3.0)
    assert 2.0 < port.time < 2.2 and port.closed


def interrupt():
    os.kill(os.getpid(), signal.SIGINT)
    time.sleep(0.01)  # The interpreter handles it here.


def test_a_signal_just_before_the_motors_go_off_does_not_keep_them_on(hand, tmp_path, monkeypatch):
    close, calls = Bench.close, []

    def interrupted(loop):
        calls.append(loop.driven)
        if len(calls) == 1:
            interrupt()
        close(loop)

    monkeypatch.setattr(Bench, "close", interrupted)
    bench = Interrupted(hand, raises(RuntimeError("broken")))
    with pytest.raises(KeyboardInterrupt):
        record(bench, hand, quick(tmp_path))
    assert calls == [True, True] and on(bench).any() and off(bench) and bench.closed


def test_a_signal_while_the_motors_go_off_is_ignored(hand, tmp_path):
    calls = []
    bench = Interrupted(hand, raises(RuntimeError("broken")), stopped=lambda: calls.append(interrupt()))
    with pytest.raises(RuntimeError, match="broken"):
        record(bench, hand, quick(tmp_path))
    assert len(calls) == 1 and on(bench).any() and off(bench) and bench.closed


class Helper(Operator):
    """Holds the pen beside the finger until it is told so often that the press was missed."""

    def __init__(self, bench, misses, **options):
        super().__init__(io.StringIO(), **options)
        self.bench, self.misses, self.told, self.plates = bench, misses, 0, bench.plates
        bench.plates = []

    def tell(self, text):
        super().tell(text)
        if text.endswith("again"):
            self.told += 1
        elif text.startswith("index pad"):  # The finger is back where it begins.
            self.bench.plates = self.plates if self.told == self.misses else []


@pytest.mark.parametrize(
    ("misses", "stream"), [(1, None), (3, None), (9, "\ns\n")], ids=["missed", "nobody to ask", "skipped"]
)
def test_a_missed_pen_is_pressed_again(hand, pressed, tmp_path, misses, stream):
    """Once beside it, then the press is as good as any; three times with nobody to ask end it; s skips it."""
    helper = Helper(pressed, misses, assume_yes=stream is None, stream=stream and io.StringIO(stream))
    options = quick(tmp_path, yes=stream is None)
    if misses == 3:
        with pytest.raises(HandError, match="index pad: met nothing within"):
            record(pressed, hand, options, helper)
    else:
        presses = read_presses([record(pressed, hand, options, helper)], hand)[1]
        assert (presses["index pad"].counts.sum(-1).max() > 60) if misses == 1 else not presses
    assert helper.told == min(misses, 2 if stream is None else 1) and off(pressed) and pressed.closed


def test_motors_that_give_no_more_turn_round(hand, pressed, tmp_path):
    """A current limit far below what 8 N need: the press ends where the force ends."""
    hardware = dataclasses.replace(arguments(tmp_path).hardware, torque_max=90)  # 0.45 A on the bench
    press = dataclasses.replace(SHORT, seconds=5.0)
    log = record(pressed, hand, arguments(tmp_path, hardware=hardware, sides=False, press=press, rate=83.0))
    calibration = fit(*read_presses([log], hand), hand)[0]
    # As much as the joint gives by itself, or, pushed by the other one, as much as it holds.
    gives, holds = (
        (0.45 - 0.02) * pressed.constant[4] * part / pressed.plates[0].arms[4]
        for part in (pressed.efficiency[4], 1.15 / pressed.back[4])
    )
    assert gives < calibration.real.force_max[4] < holds < 7
    truth = pressed.constant[4] * pressed.efficiency[4]
    assert -torque_constants(calibration)[0][0, 4] == pytest.approx(truth, rel=0.05)


class Squeezed(BenchHand):
    """Somebody squeezes the ring finger with 20 N for half a second when the index is first pressed with 3 N."""

    def __init__(self, hand):
        super().__init__(hand, plates(hand, "index pad"))
        self.since, self.squeezed, self.sent = None, [], []  # exchanges before which the hand reported it; times

    def exchange(self, command):
        self.sent.append(self.time)
        if self.touched.any():
            self.squeezed.append(self.sequence + 1)
        if self.since is None and self.force[1] > 3.0:
            self.since = self.time
        self.touched[3, 40:60] = 1.0 if self.since is not None and self.time < self.since + 0.5 else 0.0
        return super().exchange(command)


def test_a_press_waits_while_safety_holds_the_hand(hand, tmp_path, monkeypatch):
    """Its target stays where it is, none of the samples is one of the press, and then the press continues."""
    bench, targets, set_target = Squeezed(hand), {}, Safety.set_target

    def spy(safety, position, *rest):
        targets[bench.sequence + 1] = np.array(position)
        set_target(safety, position, *rest)

    monkeypatch.setattr(Safety, "set_target", spy)
    log = record(bench, hand, quick(tmp_path))
    entries, held = list(LogReader(log)), bench.squeezed
    assert len(held) > 20 and "hold: the fingertip force is too high" in [entry.content for entry in entries]
    moved = [targets[number + 1] - targets[number] for number in range(held[0] - 2, held[-1] + 3)]
    # Two steps before the hold's first request, none until the first request after it, and two more.
    for step in (moved[1], *moved[-2:]):
        np.testing.assert_allclose(step, moved[0], atol=1e-9)
    assert moved[0][4] > 0 and not np.any(moved[2:-2])
    marks = [entry.content for entry in entries if entry.kind == Kind.TICK]
    loading = {bench.sent.index(mark["sent"]) + 1 for mark in marks if mark.get("phase") == "loading"}
    assert {held[0] - 1, held[-1] + 1} < loading and not set(held) & loading


def test_a_finger_tared_under_load_is_found_out(hand, pressed, tmp_path):
    """Somebody holds the index when it is tared, too lightly to be seen, and lets go during the press: again."""
    who, exchange, let_go_at = operator(), pressed.exchange, []
    pressed.touched[1, 30:60] = 0.3

    def let_go(command):
        if pressed.force[1] > 1.0 and pressed.touched.any():
            pressed.touched[:] = 0
            let_go_at.append(pressed.time)
        return exchange(command)

    pressed.exchange = let_go
    log = record(pressed, hand, quick(tmp_path), who)
    said = who.out.getvalue()
    assert re.search(r"index pad: reads -\d+ counts .* it was touched while it was tared; again", said)
    (recording,) = read_presses([log], hand)[1].values()
    assert recording.time[0] > let_go_at[0] + 1.0 and len(recording.time) > 50


def test_presses_that_no_taxel_feels_end_at_their_current(hand, tmp_path):
    """Before the contact, and between the gauge's levels: the taxels may read too low, and only the current ends it."""
    numb = [BenchHand(hand, plates(hand, "index pad"), taxel_gain=[1, 0, 1, 1, 1]) for _ in range(2)]
    options = arguments(tmp_path, press=PressConfig(current=0.8, approach_speed=0.5))
    with pytest.raises(HandError, match="index pad: 0.8.* A and no taxel feels it"):
        record(numb[0], hand, options)
    assert off(numb[0])
    with bench_of(numb[1], hand, dataclasses.replace(options, log=tmp_path / "b.log")) as bench:
        procedure = PressProcedure(bench)
        procedure.check()
        bench.await_motors()
        procedure._placement = next(p for p in placements(hand) if p.name == "index pad")
        procedure._start()
        procedure._seek(2.0, 0.3)
        current = np.abs(numb[1].current).max()
    assert current == pytest.approx(0.8, abs=0.05) and procedure._advance < 0.8


def test_another_hand_is_refused_before_the_motors_come_on(hand, tmp_path):
    save_calibration(tmp_path / "known.toml", dataclasses.replace(ideal_calibration(hand), serial="2R32B"))
    port = BenchHand(hand, [])
    port.identity = Identity("2R32A", "right")
    options = arguments(tmp_path, calibration=tmp_path / "known.toml", identify=True, log=tmp_path / "b.log")
    with pytest.raises(HandError, match="this is hand 2R32A, the calibration is of hand 2R32B"):
        bench_of(port, hand, options).__enter__()
    assert port.closed and not on(port).any()


@pytest.mark.parametrize("stream", [io.StringIO(""), None], ids=["at its end", "closed"])
def test_nobody_at_the_terminal(hand, pressed, tmp_path, monkeypatch, stream):
    monkeypatch.setattr(sys, "stdin", None)  # As Python has it after `<&-`.
    with pytest.raises(HandError, match="standard input is closed; run in a terminal, or give --yes"):
        record(pressed, hand, quick(tmp_path, yes=False), Operator(io.StringIO(), stream=stream))
    assert off(pressed) and pressed.closed


def test_readings_of_a_gauge():
    for text, newtons in (("5.2", 5.2), ("5,2 N", 5.2), ("530 g", 5.197525), ("0.53kg", 5.197525), (" .5n ", 0.5)):
        assert parse_reading(text) == pytest.approx(newtons)
    for text in ("", "five", "5 lb", "-3", "1e3", "nan", "530", "5.2.1"):
        with pytest.raises(HandError, match="not a reading|grams need a g"):
            parse_reading(text)


def test_the_hand_goes_on_while_somebody_reads_the_gauge(hand, pressed, tmp_path):
    readings = []

    class Slow(Typist):
        def readline(self):
            begin, line = len(pressed.commands), super().readline()
            while len(pressed.commands) < begin + 20:
                time.sleep(0.001)
            readings.append(len(pressed.commands) - begin)
            return line

    options = quick(tmp_path, gauge=True, yes=False)
    log = record(pressed, hand, options, Slow(lambda: pressed.force[1]).operator())
    assert len(readings) == 13 and min(readings) >= 20  # Enter, and eleven forces with one slip.
    assert np.sum(np.diff(on(pressed).astype(int)) < 0) == 1 and off(pressed)  # The motors go off once, at the end.
    assert len(read_presses([log], hand)[1]["index pad"].gauge) == 11
