"""Fit a fingertip's taxels to a gauge: gain, offset and activation threshold, and the skin's stiffness, with intervals.

    fit = fit_finger(TaxelPress(force=gauge, reading=taxels))
    force = fit.correct(reading.sum(-1))

The line is fitted robustly to samples beyond the forces that still read zero: among them noise decides which samples
read at all, which would bend the line. A zero far above them is a reading that was lost and left out. From three
presses on, intervals count presses and not samples.

Shapes: T samples, N taxels.
"""

import dataclasses

import numpy as np
from scipy.special import stdtrit

from dexsim.calibration.joint import find_presses
from dexsim.core.errors import CalibrationError
from dexsim.core.robust_line import LEAST_GROUPS, fit_line, regress

_RESAMPLES = 400
_LEAST = 8  # samples
_NEXT = 0.05  # share of the samples, the next by force, among which
_LOST = 0.13  # no larger share reads zero where all should read
_JUMP = 0.1  # share of the range of forces from one sample to the next above which no press is followed


@dataclasses.dataclass(frozen=True)
class Estimate:
    """A number and its 95 % interval."""

    value: float
    low: float
    high: float

    def __str__(self) -> str:
        return f"{self.value:.4g} [{self.low:.4g}, {self.high:.4g}]"

    def widened(self, share: float) -> "Estimate":
        """With an error of this share (95 %), which the samples cannot show, in the interval."""
        more = abs(share * self.value)
        return Estimate(
            self.value,
            self.value - float(np.hypot(self.value - self.low, more)),
            self.value + float(np.hypot(self.high - self.value, more)),
        )


@dataclasses.dataclass(frozen=True, eq=False)
class TaxelPress:
    """One finger pressed with varying force."""

    force: np.ndarray  # [T] N, reference
    reading: np.ndarray  # [T, N] N or counts, what the taxels said
    press: np.ndarray | None = None
    """[T] int, number of the press, up and down; None: found from the force, samples being in the order of time."""


@dataclasses.dataclass(frozen=True)
class FingerFit:
    """What a finger's sensor does: sum of readings = gain * force + offset, from `threshold` on."""

    gain: Estimate  # reading per N
    offset: Estimate  # reading
    threshold: Estimate  # N, finger force at which the first taxel reads
    residual: float  # reading, rms about the line
    samples: int  # that the line was fitted to
    notes: tuple[str, ...]  # samples left out, and what the intervals leave out

    def correct(self, reading: np.ndarray) -> np.ndarray:
        """Force [...] N from the sum of a finger's readings [...]; zero where nothing reads."""
        force = (np.asarray(reading, float) - self.offset.value) / self.gain.value
        return np.where(np.asarray(reading) == 0, 0.0, force)


def fit_finger(press: TaxelPress) -> FingerFit:
    """Fit one finger.

    Raises:
      CalibrationError: too few samples, a force that does not vary, or readings that do not rise with it.
    """
    force, total = np.asarray(press.force, float), np.asarray(press.reading, float).sum(1)
    if not np.all(np.isfinite(force) & np.isfinite(total)):
        raise CalibrationError("a force or a reading is not finite")
    if len(force) < _LEAST or np.ptp(force) <= 0:
        raise CalibrationError(f"{len(force)} samples, expected at least {_LEAST} at different forces")
    group, notes = _presses(press), []
    if len(np.unique(group)) < LEAST_GROUPS:
        notes.append(f"fewer than {LEAST_GROUPS} presses: the intervals leave out how presses differ")
    threshold = _threshold(force, total, group)
    above = force >= _reading_from(force, total <= 0, threshold.value)
    lost = above & (total <= 0)
    if np.any(lost):
        notes.append(f"{np.sum(lost)} of {np.sum(above)} samples above the activation threshold read zero, left out")
    above &= ~lost
    if above.sum() < _LEAST:
        raise CalibrationError(f"{above.sum()} samples above the activation threshold, expected at least {_LEAST}")
    line = fit_line(force[above], total[above], group=group[above])
    gain, offset = Estimate(line.gain, *line.gain_interval), Estimate(line.offset, *line.offset_interval)
    if gain.low <= 0:
        raise CalibrationError(f"readings do not rise with force (gain {gain}); align both in time")
    residual = float(np.sqrt(np.mean((total[above] - line(force[above])) ** 2)))
    return FingerFit(gain, offset, threshold, residual, int(above.sum()), tuple(notes))


def fit_skin(press: TaxelPress, depth: np.ndarray, area: np.ndarray, thickness: float) -> Estimate:
    """Mooney-Rivlin coefficient C10 + C01 of the skin in Pa, from a flat plate pressed in by a known way.

    Up to moderate compression only the sum of both coefficients shows, so the force is taken as all of the first term.
    `depth` [T, N] m is the compression of the skin over each taxel, `area` [N] m^2 its area, `thickness` m the skin's.
    """
    touching = depth.max(1) > 0
    stretch = 1 - np.maximum(depth[touching], 0) / thickness
    # sigma = 2 (lambda - lambda^-2) C10, in compression, on the deformed area: force per Pa.
    rise = np.sum(2 * (stretch**-2 - stretch) * area, 1)
    force, size = np.asarray(press.force, float)[touching], rise.max()
    start = np.linalg.lstsq(rise[:, None] / size, force, rcond=None)[0]
    fit = regress(rise[:, None] / size, force, start, order=rise, group=_presses(press)[touching])
    value, half = float(fit.value[0] / size), float(fit.half[0] / size)
    return Estimate(value, value - half, value + half)


def _presses(press: TaxelPress) -> np.ndarray:
    """Number [T] of the press of each sample; each is its own where the force jumps, as between held forces."""
    force = np.asarray(press.force, float)
    if press.press is not None:
        return np.asarray(press.press)
    slow = np.median(np.abs(np.diff(force))) < _JUMP * np.ptp(force)
    return find_presses(force) if slow else np.arange(len(force))


def _threshold(force: np.ndarray, total: np.ndarray, group: np.ndarray) -> Estimate:
    """The force that best parts silent from reading samples."""
    last, first = _best_split(force, total > 0)
    presses = [group == k for k in np.unique(group)]
    if len(presses) >= LEAST_GROUPS and min(np.sum(rows) for rows in presses) >= _LEAST:
        several = np.array([np.mean(_best_split(force[rows], total[rows] > 0)) for rows in presses])
        half = stdtrit(len(several) - 1, 0.975) * np.std(several, ddof=1) / np.sqrt(len(several))
        low, high = np.mean(several) - half, np.mean(several) + half
    else:
        pick = np.random.default_rng(0).integers(len(force), size=(_RESAMPLES, len(force)))
        several = np.array([np.mean(_best_split(force[rows], total[rows] > 0)) for rows in pick])
        low, high = np.percentile(several, [2.5, 97.5])
    # Nothing is known between two neighbouring forces.
    return Estimate((last + first) / 2, float(min(low, last)), float(max(high, first)))


def _reading_from(force: np.ndarray, silent: np.ndarray, threshold: float) -> float:
    """The least force N, above the threshold, from which on next to all samples read; infinite if there is none."""
    if not np.any(silent & (force <= threshold)):
        threshold = -np.inf  # The press began above it.
    order = np.argsort(force)
    count = np.concatenate([[0], np.cumsum(silent[order])])
    levels, first = np.unique(force[order], return_index=True)
    end = np.minimum(first + max(_LEAST, round(_NEXT * len(force))), len(force))
    quiet = (levels > threshold) & (count[end] - count[first] <= _LOST * (end - first))
    return float(levels[np.argmax(quiet)]) if np.any(quiet) else np.inf


def _best_split(force: np.ndarray, active: np.ndarray) -> tuple[float, float]:
    """The two neighbouring forces with the fewest silent samples above and reading ones below."""
    order = np.argsort(force, kind="stable")
    force, active = force[order], active[order]
    wrong = np.concatenate([[0], np.cumsum(active)]) + np.sum(~active) - np.concatenate([[0], np.cumsum(~active)])
    best = np.flatnonzero(wrong == wrong.min())
    split = int(best[len(best) // 2])
    return float(force[max(split - 1, 0)]), float(force[min(split, len(force) - 1)])
