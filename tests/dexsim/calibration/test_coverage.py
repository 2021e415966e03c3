"""Intervals that keep their promise where presses differ and residuals belong together."""

import numpy as np
import pytest
from scipy.stats import t as student
from virtual_press import varied_presses

from dexsim.calibration.joint import JointPress, find_presses, fit_joint
from dexsim.calibration.sensor import Estimate, TaxelPress, fit_finger
from dexsim.core.robust_line import Line, fit_line, regress

TRIALS = 40


def inside(estimate, truth):
    return estimate[0] <= truth <= estimate[1]


def test_a_sensors_line_and_threshold_hold_the_truth():
    hits = np.zeros(3)
    for seed in range(TRIALS):
        force, total = varied_presses(
            np.random.default_rng([2, seed]), gain=9.0, offset=1.5, shift=1.0, noise=0.8, correlation=0.9, samples=160
        )
        total = np.where(force < 0.3, 0.0, np.round(total))
        found = fit_finger(TaxelPress(force=force, reading=np.maximum(total, 0.0)[:, None]))
        hits += [
            inside((found.gain.low, found.gain.high), 9.0),
            inside((found.offset.low, found.offset.high), 1.5),
            inside((found.threshold.low, found.threshold.high), 0.3),
        ]
    assert np.all(hits >= 0.9 * TRIALS), hits


def test_differences_of_whole_presses_are_students_t():
    """A constant, six presses of one level each: the interval of the mean of six numbers."""
    rng = np.random.default_rng(3)
    level = rng.standard_normal(6)
    group = np.repeat(np.arange(6), 50)
    y = level[group] + 0.01 * rng.standard_normal(300)
    found = regress(np.ones((300, 1)), y, np.array([np.median(y)]), order=np.arange(300.0), group=group)
    half = student.ppf(0.975, 5) * np.std(level, ddof=1) / np.sqrt(6)
    assert found.half[0] == pytest.approx(half, rel=0.3) and found.value[0] == pytest.approx(level.mean(), abs=half)
    alone = fit_line(np.arange(300.0), y)
    both = fit_line(np.arange(300.0), y, group=np.arange(300) // 150)
    assert alone == both  # two repetitions tell nothing


def test_presses_are_counted_from_where_the_force_rises():
    triangle = 8 * (1 - np.abs(2 * (np.arange(600) / 200 % 1) - 1))
    np.testing.assert_array_equal(np.unique(find_presses(triangle)), [0, 1, 2])
    number = find_presses(triangle[100:])  # begins at a peak: half a press is one of its own
    assert list(np.unique(number)) == [0, 1, 2] and number[90] == 0 and number[110] == 1
    assert np.all(find_presses(np.linspace(0, 5, 90)) == 0)


def test_what_no_sample_shows_is_added_in_quadrature():
    line = Line(
        gain=-2.0,
        offset=0.0,
        gain_interval=(-2.06, -1.94),
        offset_interval=(0, 0),
        noise=0.0,
        r_squared=1.0,
        condition=1.0,
        samples=9,
        outliers=0,
    )
    assert line.widened(0.04).gain_interval == pytest.approx((-2.1, -1.9))
    assert Estimate(10.0, 9.7, 10.4).widened(0.03) == Estimate(10.0, pytest.approx(9.5757, abs=1e-4), 10.5)
    force, value = varied_presses(np.random.default_rng(4), gain=0.05)
    plain, known = (fit_joint(JointPress(force, value, gain_error=share), "A") for share in (0.0, 0.3))
    assert np.ptp(known.loading.gain_interval) > 0.03 > np.ptp(plain.loading.gain_interval)
    assert known.loading.offset_interval == plain.loading.offset_interval and known.notes == plain.notes
