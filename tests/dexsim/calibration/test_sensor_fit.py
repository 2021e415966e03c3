"""Known sensors are found again, within intervals that keep their promise; useless recordings are refused."""

import numpy as np
import pytest

from dexsim.calibration.sensor import TaxelPress, fit_finger, fit_skin
from dexsim.core.errors import CalibrationError

TAXELS, AREA = 40, np.full(40, 4e-6)


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
    assert fit.gain.value == pytest.approx(9.0, rel=0.01) and fit.offset.value == pytest.approx(1.5, abs=0.3)
    assert fit.threshold.value == pytest.approx(0.3, abs=0.1)
    assert fit.residual == pytest.approx(np.hypot(0.4, 1 / np.sqrt(12)), rel=0.2)
    assert fit.gain.low < fit.gain.value < fit.gain.high
    np.testing.assert_allclose(fit.correct(np.array([0.0, 46.5])), [0.0, 5.0], atol=0.05)


def test_outliers_do_not_bend_the_line():
    fit = fit_finger(recording(1, outliers=12))
    assert fit.gain.value == pytest.approx(9.0, rel=0.02) and fit.offset.value == pytest.approx(1.5, abs=0.5)
    plain = recording(1, outliers=12)
    least_squares = np.polyfit(plain.force, plain.reading.sum(1), 1)[1]
    assert abs(fit.offset.value - 1.5) < 0.2 * abs(least_squares - 1.5)


@pytest.mark.parametrize("lost", [1, 12])
def test_lost_readings_do_not_cost_the_others(lost):
    """Zeros, one of them at the largest force: the samples below are not silent because of it."""
    press = recording(8, count=600)
    clean = fit_finger(press)
    order = np.argsort(press.force)
    press.reading[order[np.linspace(599, 100, lost).astype(int)]] = 0
    fit = fit_finger(press)
    assert fit.samples == clean.samples - lost and f"{lost} of {clean.samples} samples" in fit.notes[-1]
    assert fit.gain.value == pytest.approx(clean.gain.value, rel=2e-3) and "zero" not in "".join(clean.notes)
    assert fit.residual == pytest.approx(clean.residual, rel=0.05)


def test_the_skins_stiffness_is_found():
    """A flat plate on 24 of 40 taxels, 2 mm of skin, pushed in steps, with 2 % of noise."""
    rng = np.random.default_rng(3)
    depth = np.zeros((80, TAXELS))
    depth[:, :24] = rng.uniform(0.02, 0.5, 80)[:, None] * 0.002
    stretch = 1 - depth / 0.002
    force = np.sum(2 * (stretch**-2 - stretch) * 0.1e6 * AREA, 1) * (1 + 0.02 * rng.normal(size=80))
    stiffness = fit_skin(TaxelPress(force=force, reading=depth), depth, AREA, thickness=0.002)
    assert stiffness.value == pytest.approx(0.1e6, rel=0.02) and stiffness.low <= 0.1e6 <= stiffness.high


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
