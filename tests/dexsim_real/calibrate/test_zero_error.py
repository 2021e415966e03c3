"""Taxels and gauge: readings at zero force, dead taxels, shear at rest, a gauge of the user's that is slow or fails."""

import dataclasses
import sys
import threading
import time
from types import ModuleType

import numpy as np
import pytest
from calibrating import QUICK, arguments, off, on, operator, plates, record
from press_bench import BenchHand

from dexsim_real.calibrate import gauge, press_fit
from dexsim_real.calibrate.force_scale import force_scale, upright
from dexsim_real.calibrate.gauge import Gauge
from dexsim_real.calibrate.press_fit import fit
from dexsim_real.calibrate.read import PressSession, Recording, read_logs
from dexsim_real.core.errors import HandError
from dexsim_real.core.log import Kind, LogReader

GAIN, ZERO = 8.0, 20.0  # counts per newton, counts at zero force


def pressed(forces: np.ndarray, hand) -> Recording:
    """A press of the index finger whose middle taxels read GAIN F + ZERO."""
    press = Recording(name="index pad", finger=1, joints=(4,), rate=83.0)
    for level, force in enumerate(forces):
        for sample in range(5):
            counts = np.zeros(hand.num_taxels)
            counts[[41, 42, 43, 53, 54, 55, 65, 66, 67]] = (GAIN * force + ZERO) / 9
            press.phase.append(f"level {level}")
            press.time.append(level + 0.1 * sample)
            press.counts.append(counts)
            press.shown.append(float(counts.sum()))
            press.position.append(np.zeros(12))
        press.gauge[f"level {level}"] = float(force)
    return press


def test_a_zero_error_is_taken_from_the_force(hand, tmp_path):
    forces = np.linspace(0.5, 8.0, 12)
    options = arguments(tmp_path)
    session = PressSession(options.hardware, options.check, "serial", "right", 83.0, {}, np.empty(0))
    gain, offset = force_scale(session, hand, [pressed(forces, hand)]).newtons["index pad"]
    for force in (1.0, 5.0):
        assert gain * (GAIN * force + ZERO) + offset == pytest.approx(force, rel=0.01)


def test_the_scale_is_of_sums_with_the_dead_taxels_filled_in(hand, tmp_path):
    """The fit applies it to such sums."""
    options = arguments(tmp_path)
    session = PressSession(options.hardware, options.check, "serial", "right", 83.0, {}, np.empty(0))
    whole = pressed(np.linspace(0.5, 8.0, 12), hand)
    broken = dataclasses.replace(whole, counts=[counts.copy() for counts in whole.counts])
    for counts in broken.counts:
        counts[54] = 0.0
    alive, dead = (force_scale(session, hand, [press]).newtons["index pad"][0] for press in (whole, broken))
    assert dead == pytest.approx(alive, rel=0.01)


def test_levels_that_the_taxels_do_not_feel_have_no_direction(hand):
    """Their sum may be negative, and none of the forces changes its sign for that."""
    counts = np.zeros((4, hand.num_taxels))
    counts[:, [53, 54, 65, 66]] = np.array([-0.5, 5.0, 20.0, 40.0])[:, None]
    counts[1:, 3] = -1.0
    position = np.full((4, 12), 0.3)
    np.testing.assert_allclose(upright(hand, 1, counts, position), 1.0, atol=1e-3)
    np.testing.assert_array_equal(upright(hand, 1, counts[:1], position[:1]), 1.0)


class Slanted(BenchHand):
    """Every taxel reads one count along x."""

    def state(self):
        block = super().state()
        block["tip"]["taxel"]["x"] = 1
        return block


@pytest.mark.slow
def test_shear_that_is_there_at_rest_is_none(hand, session, tmp_path):
    log = record(Slanted(hand, plates(hand, "index pad")), hand, arguments(tmp_path, sides=False))
    presses = read_logs([log], hand)
    np.testing.assert_array_equal(presses.recordings["index pad"].shear, 0.0)
    found = fit(presses, hand)
    assert {"index_joint1", "index_joint2"} <= set(found.source)
    assert not any("shear" in note for note in found.calibration.notes if note.startswith("index"))


def test_the_force_that_the_gauge_adds_acts_where_the_taxels_do(hand, session, monkeypatch):
    presses, arms = read_logs([session[2]], hand), []
    for offset in (0.0, -1.0):

        def shifted(*parts, offset=offset):
            scale = force_scale(*parts)
            return dataclasses.replace(
                scale, newtons={name: (gain, offset) for name, (gain, _) in scale.newtons.items()}
            )

        monkeypatch.setattr(press_fit, "force_scale", shifted)
        press = fit(presses, hand).sim["index_joint1"]
        high = press.force > 0.5 * press.force.max()
        arms.append(np.sum(press.value[high]) / np.sum(press.force[high]))
    assert arms[1] == pytest.approx(arms[0], rel=0.01)


def of_user(monkeypatch, function):
    module = ModuleType("gauge_of_user")
    module.read = function
    monkeypatch.setitem(sys.modules, "gauge_of_user", module)
    return "gauge_of_user:read"


def test_the_hand_goes_on_while_a_slow_gauge_answers(hand, tmp_path, monkeypatch):
    bench, readings = BenchHand(hand, plates(hand, "index pad")), []

    def slow():
        begin = len(bench.commands)
        until = time.monotonic() + 5.0
        while len(bench.commands) < begin + 20 and time.monotonic() < until:
            time.sleep(0.001)
        readings.append(len(bench.commands) - begin)
        return float(bench.force[1])

    options = arguments(tmp_path, gauge=of_user(monkeypatch, slow), levels=5, sides=False, press=QUICK)
    log = record(bench, hand, options)
    assert len(readings) == 9 and min(readings) >= 20
    motors = on(bench)
    assert np.sum(np.diff(motors.astype(int)) < 0) == 1 and off(bench)  # They go off once, at the end.
    assert sum("gauge" in entry.content for entry in LogReader(log) if entry.kind == Kind.TICK) == 9


def test_a_gauge_that_hangs_or_fails_ends_it_in_one_line(monkeypatch):
    def fail():
        raise ConnectionError("scale unplugged")

    hang, calls = threading.Event(), []
    monkeypatch.setattr(gauge, "_SLOWEST", 0.2)
    for function, says in (
        (fail, r"the function of --gauge failed \(ConnectionError: scale unplugged\)"),
        (lambda: sys.exit(3), r"failed \(SystemExit: 3\)"),
        (lambda: None, "returned None; it must return newtons"),
        (lambda: float("nan"), "returned nan; it must return newtons"),
        (lambda: "five", "returned 'five'; it must return newtons"),
        (lambda: 530.0, "returned 530.0; it must return newtons, and a fingertip presses with less than 100"),
        (hang.wait, "did not return within 0.2 s"),
    ):
        with pytest.raises(HandError, match=says) as caught:
            Gauge(of_user(monkeypatch, function), operator()).read(lambda: calls.append(time.sleep(0.01)))
        assert "\n" not in str(caught.value)
    hang.set()
    assert 5 < len(calls) < 40
