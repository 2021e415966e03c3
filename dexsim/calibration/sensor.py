"""Fit the sensor: gain, offset, activation threshold and skin material per finger, with intervals.

Recorded frames in, numbers with intervals out. A press is what was recorded while one finger was pushed: the force by
a gauge (or by the solver, to check the fit on simulated data), the taxels' readings, and for the material how deep each
taxel was pressed, which a flat plate moved by a known way gives.

    fit = fit_finger(TaxelPress(force=gauge, reading=taxels, depth=depth, area=area), thickness=0.002)
    force = fit.correct(reading.sum(-1))

The line is fitted robustly (`dexsim.core.robust_line`), to samples beyond the forces that still read zero: among them
noise decides which samples read at all, which would bend the line. A zero far above them is a reading that was lost:
it is left out, and the samples below it are not. Samples of one press belong together: from three
presses on, intervals count presses and not samples.

Shapes: T samples, N taxels.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from scipy.special import stdtrit

from dexsim.calibration.joint import find_presses
from dexsim.core.errors import DexsimError
from dexsim.core.robust_line import LEAST_GROUPS, Regression, fit_line, regress

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

    def widened(self, share: float) -> Estimate:
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
    depth: np.ndarray | None = None  # [T, N] m, compression of the skin over each taxel
    area: np.ndarray | None = None  # [N] m^2
    press: np.ndarray | None = None
    """[T] int, number of the press, up and down; None: found from the force, samples being in the order of time."""


@dataclasses.dataclass(frozen=True)
class FingerFit:
    """What a finger's sensor does: sum of readings = gain * force + offset, from `threshold` on."""

    gain: Estimate  # reading per N
    offset: Estimate  # reading
    threshold: Estimate  # N, finger force at which the first taxel reads
    c10: Estimate | None  # Pa
    c01: Estimate | None  # Pa
    residual: float  # reading, rms about the line
    samples: int  # that the line was fitted to
    notes: tuple[str, ...]  # parameters that the data cannot separate, samples left out

    def correct(self, reading: np.ndarray) -> np.ndarray:
        """Force [...] N from the sum of a finger's readings [...]; zero where nothing reads."""
        force = (np.asarray(reading, float) - self.offset.value) / self.gain.value
        return np.where(np.asarray(reading) == 0, 0.0, force)


def fit_finger(
    press: TaxelPress,
    *,
    thickness: float | None = None,
    two_terms: bool = False,
    saturation: float | None = None,
    seed: int = 0,
) -> FingerFit:
    """Fit one finger.

    Args:
      press: the recording; with `depth` and `area` also the material is fitted.
      thickness: of the skin, m; needed for the material.
      two_terms: fit C01 as well. Presses up to moderate compression tell only the sum of C10 and C01; a note says so.
      saturation: largest reading of a taxel; samples in which one reaches it are left out.
      seed: of the resampling for the threshold.

    Raises:
      DexsimError: shapes that do not fit, too few samples, a force that does not vary, or a response that falls.
    """
    force, reading = _checked(press)
    notes = []
    keep = np.ones(len(force), bool)
    if saturation is not None:
        keep = ~np.any(reading >= saturation, axis=1)
        if not np.all(keep):
            notes.append(f"{np.sum(~keep)} of {len(keep)} samples saturated, left out")
    number = _presses(press)
    if len(np.unique(number)) < LEAST_GROUPS:
        notes.append(f"fewer than {LEAST_GROUPS} presses: the intervals leave out how presses differ")
    force, reading, group = force[keep], reading[keep], number[keep]
    if len(force) < _LEAST or np.ptp(force) <= 0:
        raise DexsimError(
            f"sensor fit: {len(force)} of {len(keep)} samples are not saturated; at least {_LEAST} at different forces "
            "needed"
        )
    total = reading.sum(1)

    threshold = _threshold(force, total, group, np.random.default_rng(seed))
    above = force >= _reading_from(force, total <= 0, threshold.value)
    lost = above & (total <= 0)
    if np.any(lost):
        notes.append(f"{np.sum(lost)} of {np.sum(above)} samples above the activation threshold read zero, left out")
    above &= ~lost
    if above.sum() < _LEAST:
        raise DexsimError(f"sensor fit: {above.sum()} samples above the activation threshold, at least {_LEAST} needed")
    line = fit_line(force[above], total[above], group=group[above])
    gain, offset = Estimate(line.gain, *line.gain_interval), Estimate(line.offset, *line.offset_interval)
    if gain.low <= 0:
        raise DexsimError(f"sensor fit: readings do not rise with force (gain {gain}); is the recording aligned?")
    residual = float(np.sqrt(np.mean((total[above] - gain.value * force[above] - offset.value) ** 2)))
    c10 = c01 = None
    if press.depth is not None:
        c10, c01, said = _material(press, keep, group, thickness, two_terms)
        notes += said
    return FingerFit(gain, offset, threshold, c10, c01, residual, int(above.sum()), tuple(notes))


def _checked(press: TaxelPress) -> tuple[np.ndarray, np.ndarray]:
    force, reading = np.asarray(press.force, float), np.asarray(press.reading, float)
    if force.ndim != 1 or reading.ndim != 2 or len(force) != len(reading):
        raise DexsimError(f"sensor fit: force {force.shape} and reading {reading.shape}, expected [T] and [T, N]")
    if press.press is not None and np.shape(press.press) != force.shape:
        raise DexsimError(f"sensor fit: press {np.shape(press.press)}, expected a number for each force {force.shape}")
    if not (np.all(np.isfinite(force)) and np.all(np.isfinite(reading))):
        raise DexsimError("sensor fit: a force or a reading is not finite")
    if len(force) < _LEAST or np.ptp(force) <= 0:
        raise DexsimError(
            f"sensor fit: {len(force)} samples between {force.min(initial=0):g} and "
            f"{force.max(initial=0):g} N; at least {_LEAST} at different forces needed"
        )
    return force, reading


def _presses(press: TaxelPress) -> np.ndarray:
    """Number [T] of the press of each sample; each is its own where the force jumps, as between held forces."""
    force = np.asarray(press.force, float)
    if press.press is not None:
        return np.asarray(press.press)
    slow = np.median(np.abs(np.diff(force))) < _JUMP * np.ptp(force)
    return find_presses(force) if slow else np.arange(len(force))


def _threshold(force: np.ndarray, total: np.ndarray, group: np.ndarray, rng: np.random.Generator) -> Estimate:
    """The force that best parts silent from reading samples."""
    last, first = _best_split(force, total > 0)
    presses = [group == k for k in np.unique(group)]
    if len(presses) >= LEAST_GROUPS and min(np.sum(rows) for rows in presses) >= _LEAST:
        several = np.array([np.mean(_best_split(force[rows], total[rows] > 0)) for rows in presses])
        half = stdtrit(len(several) - 1, 0.975) * np.std(several, ddof=1) / np.sqrt(len(several))
        low, high = np.mean(several) - half, np.mean(several) + half
    else:
        pick = rng.integers(len(force), size=(_RESAMPLES, len(force)))
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


def _estimates(design: np.ndarray, target: np.ndarray, group: np.ndarray) -> list[Estimate]:
    """Robust regression of the target [T] on the columns of a design [T, K] through zero, with intervals."""
    size = np.max(np.abs(design), 0)
    start = np.linalg.lstsq(design / size, target, rcond=None)[0]
    fit: Regression = regress(design / size, target, start, order=design[:, 0], group=group)
    return [
        Estimate(float(v), float(v - half), float(v + half))
        for v, half in zip(fit.value / size, fit.half / size, strict=True)
    ]


def _material(
    press: TaxelPress, keep: np.ndarray, group: np.ndarray, thickness: float | None, two_terms: bool
) -> tuple[Estimate, Estimate, list[str]]:
    """Mooney-Rivlin coefficients from depth and gauge force: the force is linear in both."""
    depth = np.asarray(press.depth, float)
    if press.area is None or thickness is None:
        raise DexsimError("sensor fit: the material needs the taxels' areas and the skin's thickness beside the depth")
    if depth.shape != np.shape(press.reading) or np.shape(press.area) != depth.shape[1:]:
        raise DexsimError(
            f"sensor fit: depth {depth.shape} and area {np.shape(press.area)} do not go with readings "
            f"{np.shape(press.reading)}"
        )
    depth, force = depth[keep], np.asarray(press.force, float)[keep]
    deepest = float(depth.max()) / thickness
    touching = depth.max(1) > 0
    if touching.sum() < _LEAST or deepest >= 1:
        raise DexsimError(
            f"sensor fit: {touching.sum()} samples touch, deepest compression {deepest:.0%}; at least "
            f"{_LEAST} below 100 % needed"
        )
    stretch = 1 - np.maximum(depth[touching], 0) / thickness
    rise = 2 * (stretch**-2 - stretch) * press.area
    basis = np.stack([rise.sum(1), (rise / stretch).sum(1)], 1)
    force, group = force[touching], group[touching]
    zero, notes = Estimate(0.0, 0.0, 0.0), list[str]()
    if not two_terms:
        return _estimates(basis[:, :1], force, group)[0], zero, notes
    c10, c01 = _estimates(basis, force, group)
    width = max(c10.high - c10.low, c01.high - c01.low)
    if width > 0.5 * max(abs(c10.value + c01.value), 1e-300):
        total = _estimates(basis.mean(1, keepdims=True), force, group)[0]
        notes.append(
            f"C10 and C01 cannot be told apart up to {deepest:.0%} compression; their sum is about {total.value:.4g} Pa"
        )
    return c10, c01, notes
