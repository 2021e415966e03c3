"""Fit a fingertip's taxels to a gauge: gain, offset and activation threshold.

    fit = fit_finger(TaxelPress(force=gauge, reading=taxels))
    force = fit.correct(reading.sum(-1))

Shapes: T samples, N taxels.
"""

import dataclasses

import numpy as np

from dexsim.calibration.joint import find_presses
from dexsim.calibration.line import Line, fit_line
from dexsim.core.errors import CalibrationError

_LEAST = 8  # samples
_JUMP = 0.1  # share of the range of forces from one sample to the next above which no press is followed


@dataclasses.dataclass(frozen=True, eq=False)
class TaxelPress:
    """One finger pressed with varying force."""

    force: np.ndarray  # [T] N, reference
    reading: np.ndarray  # [T, N] N or counts, what the taxels said


@dataclasses.dataclass(frozen=True)
class FingerFit:
    """What a finger's sensor does: sum of readings = line(force), from `threshold` on."""

    line: Line  # reading over N
    threshold: float  # N, finger force at which the first taxel reads

    def correct(self, reading: np.ndarray) -> np.ndarray:
        """Force [...] N from the sum of a finger's readings [...]; zero where nothing reads."""
        force = (np.asarray(reading, float) - self.line.offset) / self.line.gain
        return np.where(np.asarray(reading) == 0, 0.0, force)


def fit_finger(press: TaxelPress) -> FingerFit:
    """Fit one finger.

    The line is fitted to forces above the threshold: below, noise decides which samples read at all, which would bend
    it. A zero far above is a reading that was lost, an outlier.

    Raises:
      CalibrationError: too few samples, a force that does not vary, or readings that do not rise with it.
    """
    force, total = np.asarray(press.force, float), np.asarray(press.reading, float).sum(1)
    if not np.all(np.isfinite(force) & np.isfinite(total)):
        raise CalibrationError("a force or a reading is not finite")
    if len(force) < _LEAST or np.ptp(force) <= 0:
        raise CalibrationError(f"{len(force)} samples, expected at least {_LEAST} at different forces")
    threshold = _threshold(force, total > 0)
    above = force >= threshold
    if above.sum() < _LEAST or np.median(total[above]) <= 0:
        raise CalibrationError(f"{above.sum()} samples above the activation threshold, expected at least {_LEAST}")
    # Held forces, which jump from sample to sample, are each a press of its own.
    slow = np.median(np.abs(np.diff(force))) < _JUMP * np.ptp(force)
    line = fit_line(force[above], total[above], (find_presses(force) if slow else np.arange(len(force)))[above])
    if line.gain_interval[0] <= 0:
        raise CalibrationError(f"readings do not rise with force (gain {line.gain:.4g}); align both in time")
    return FingerFit(line, threshold)


def _threshold(force: np.ndarray, active: np.ndarray) -> float:
    """The force N with the fewest silent samples above and reading ones below; the least force if all read."""
    order = np.argsort(force, kind="stable")
    force, active = force[order], active[order]
    wrong = np.concatenate([[0], np.cumsum(active)]) + np.sum(~active) - np.concatenate([[0], np.cumsum(~active)])
    best = np.flatnonzero(wrong == wrong.min())
    split = int(best[len(best) // 2])
    return float(force[max(split - 1, 0)] + force[min(split, len(force) - 1)]) / 2
