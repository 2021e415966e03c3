"""Checks of the tactile sensors."""

import re

import numpy as np
import pytest
from calibrating import QUICK, arguments, off, on, operator, plates, record
from press_bench import BenchHand

from dexsim_real.calibrate.options import CheckConfig
from dexsim_real.calibrate.press_procedure import PressProcedure
from dexsim_real.calibrate.read import read_logs
from dexsim_real.calibrate.taxel_check import check_release, check_rest, dead_taxels, taxel_names
from dexsim_real.core.errors import HandError
from dexsim_real.sensors.hand import HardwareConfig


def resting(seed=0, count=160):
    rng = np.random.default_rng(seed)
    left = rng.uniform(0, 6, (5, 120)) * (rng.random((5, 120)) < 0.05)
    counts = np.round(left + 0.2 * rng.standard_normal((count, 5, 120)))
    return np.maximum(counts, 0), rng.normal(5, 2, (count, 12))


def test_what_a_hand_at_rest_shows(hand):
    counts, current = resting()
    report = check_rest(hand, counts, current, CheckConfig(), HardwareConfig(), tuple(range(5)))
    assert report.notes == ()
    np.testing.assert_allclose(report.tare, counts.mean(0))
    assert np.all(np.abs(report.current - 5) < 1)
    noisy = counts.copy()
    noisy[:, 2, 31] += 8 * (np.random.default_rng(1).random(len(counts)) < 0.5)
    notes = check_rest(hand, noisy, current, CheckConfig(), HardwareConfig(), (2,)).notes
    assert len(notes) == 1 and notes[0].startswith("middle: noisy: column 2 row 7 (up to 4")


def test_a_touch_is_told_from_a_taxel_that_is_stuck(hand):
    counts, current = resting()
    stuck = counts.copy()
    stuck[:, 4, 17] = 255
    with pytest.raises(HandError, match="pinky: column 1 row 5 read 255 counts alone and are stuck") as caught:
        check_rest(hand, stuck, current, CheckConfig(), HardwareConfig(), ())
    assert "\n" not in str(caught.value)
    touched = counts.copy()
    touched[:, 0, [40, 41, 52, 53]] += 60
    with pytest.raises(HandError, match="4 adjacent taxels of the thumb .* touches it") as caught:
        check_rest(hand, touched, current, CheckConfig(), HardwareConfig(), ())
    assert "\n" not in str(caught.value)
    pressed = counts.copy()
    pressed[:, 2, 30:60] += 8  # 24 N in all, less than a taxel may read at rest each.
    with pytest.raises(HandError, match="those of the middle read 2.. counts together, limit 50: something touches it"):
        check_rest(hand, pressed, current, CheckConfig(), HardwareConfig(), ())
    # A light touch hides among what is left at rest, unless it changes.
    swaying = counts.copy()
    swaying[:, 3, 50:60] += np.round(2 + 2 * np.sin(np.arange(len(counts)) / 25))[:, None]
    with pytest.raises(HandError, match="ring's sum moved by .* touches it"):
        check_rest(hand, swaying, current, CheckConfig(), HardwareConfig(), ())


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
    with pytest.raises(HandError, match="of the middle .* free the fingertips"):
        record(bench, hand, arguments(tmp_path, press=QUICK))
    assert not on(bench).any() and bench.closed and not (tmp_path / "hand.toml").exists()


@pytest.mark.parametrize("after", [0.0, 0.39])
def test_a_hand_that_is_silent_while_it_is_tared_ends_it_in_one_line(hand, tmp_path, monkeypatch, after):
    """From the begin of the tare in the air, or from the end of its first part, with pauses of 0.2 s."""
    bench, tare, silent = BenchHand(hand, plates(hand, "index pad")), PressProcedure._tare_in_air, [np.inf]
    exchange = bench.exchange

    def answer(command):
        reply = exchange(command)
        return None if silent[0] <= reply.sent < silent[0] + 1.0 else reply

    def begin(procedure):
        silent[0] = bench.time + after
        tare(procedure)

    bench.exchange = answer
    monkeypatch.setattr(PressProcedure, "_tare_in_air", begin)
    with pytest.raises(HandError, match="cannot tare the taxels: no usable answer in 0.2 s; check the cable") as caught:
        record(bench, hand, arguments(tmp_path, press=QUICK, sides=False))
    assert "\n" not in str(caught.value) and on(bench).any() and off(bench) and bench.closed


def test_a_finger_zeroed_under_load_is_found_out(hand, tmp_path):
    """Somebody holds the index when it is zeroed, too lightly to be seen, and lets go during the press: again."""
    bench, who = BenchHand(hand, plates(hand, "index pad")), operator()
    bench.touched[1, 30:60] = 0.3
    exchange, let_go_at = bench.exchange, []

    def let_go(command):
        if bench.force[1] > 1.0 and bench.touched.any():
            bench.touched[:] = 0
            let_go_at.append(bench.time)
        return exchange(command)

    bench.exchange = let_go
    log = record(bench, hand, arguments(tmp_path, press=QUICK, sides=False), who)
    said = who.console.file.getvalue()
    assert re.search(r"index pad: reads -\d+ counts .* it was touched while it was tared; .*; again", said)
    (recording,) = read_logs([log], hand).recordings.values()
    assert recording.time[0] > let_go_at[0] + 1.0 and len(recording.time) > 50
    assert off(bench) and bench.closed


def test_a_fingertip_is_free_after_a_press():
    check_release("index", np.array([-3.0, 2.0, 40.0]), CheckConfig())
    with pytest.raises(HandError, match="index: reads -900 counts after the press"):
        check_release("index", np.full(5, -900.0), CheckConfig())
    with pytest.raises(HandError, match="index: the hand did not answer after the press"):
        check_release("index", np.array([]), CheckConfig())
