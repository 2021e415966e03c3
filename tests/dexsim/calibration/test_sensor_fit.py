"""Known sensors are found again, within intervals that keep their promise; useless recordings are refused."""

import numpy as np
import pytest
from virtual_press import varied_presses

from dexsim.calibration.sensor import TaxelPress, fit_finger
from dexsim.core.errors import CalibrationError

TAXELS = 40


def recording(seed, *, gain=9.0, offset=1.5, threshold=0.3, noise=0.4, count=150, outliers=0):
    """A finger read in counts: silent below `threshold` N, then gain * force + offset, spread over the taxels."""
    rng = np.random.default_rng(seed)
    force = rng.uniform(0, 8, count)
    total = np.round(gain * force + offset + noise * rng.normal(size=count))
    total[force < threshold] = 0
    total[rng.choice(count, outliers, replace=False)] += 60
    share = np.zeros((count, TAXELS))
    share[:, :10] = 0.1
    return TaxelPress(force=force, reading=total[:, None] * share)


def test_gain_offset_and_threshold_are_found():
    fit = fit_finger(recording(0))
    assert fit.line.gain == pytest.approx(9.0, rel=0.01) and fit.line.offset == pytest.approx(1.5, abs=0.3)
    assert fit.threshold == pytest.approx(0.3, abs=0.1)
    assert fit.line.noise == pytest.approx(np.hypot(0.4, 1 / np.sqrt(12)), rel=0.2)
    np.testing.assert_allclose(fit.correct(np.array([0.0, 46.5])), [0.0, 5.0], atol=0.05)


def test_intervals_hold_the_truth_of_presses_that_differ():
    hits, trials = np.zeros(2), 40
    for seed in range(trials):
        force, total = varied_presses(
            np.random.default_rng([2, seed]), gain=9.0, offset=1.5, shift=1.0, noise=0.8, correlation=0.9, samples=160
        )
        total = np.maximum(np.where(force < 0.3, 0.0, np.round(total)), 0.0)
        line = fit_finger(TaxelPress(force=force, reading=total[:, None])).line
        hits += [
            low <= truth <= high for (low, high), truth in ((line.gain_interval, 9.0), (line.offset_interval, 1.5))
        ]
    assert np.all(hits >= 0.87 * trials), hits


@pytest.mark.parametrize("lost", [1, 12])
def test_outliers_and_lost_readings_do_not_bend_the_line(lost):
    """Zeros, one of them at the largest force, and 12 readings far too large."""
    press = recording(8, count=600, outliers=12)
    press.reading[np.argsort(press.force)[np.linspace(599, 100, lost).astype(int)]] = 0
    fit = fit_finger(press)
    assert fit.line.gain == pytest.approx(9.0, rel=5e-3) and fit.line.offset == pytest.approx(1.5, abs=0.2)
    assert fit.threshold == pytest.approx(0.3, abs=0.1)


def test_useless_recordings_are_refused():
    good = recording(7)
    for press, words in (
        (TaxelPress(force=good.force[:5], reading=good.reading[:5]), "5 samples"),
        (TaxelPress(force=np.full(150, 2.0), reading=good.reading), "different forces"),
        (TaxelPress(force=good.force, reading=0 * good.reading), "above the activation threshold"),
        (TaxelPress(force=good.force, reading=100 - good.reading), "do not rise"),
        (TaxelPress(force=np.where(good.force > 7, np.nan, good.force), reading=good.reading), "not finite"),
    ):
        with pytest.raises(CalibrationError, match=words):
            fit_finger(press)
