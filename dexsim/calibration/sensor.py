"""Fit the sensor: gain, offset, activation threshold and skin material per finger, with intervals.

Recorded frames in, numbers with intervals out. A press is what was recorded while one finger was pushed: the force by
a gauge (or by the solver, to check the fit on simulated data), the taxels' readings, and for the material how deep each
taxel was pressed, which a flat plate moved by a known way gives.

    fit = fit_finger(TaxelPress(force=gauge, reading=taxels, depth=depth, area=area), thickness=0.002)
    force = fit.correct(reading.sum(-1))
    save_fit("sensor.json", {"thumb": fit, ...})

The line is fitted robustly (Huber weights), to samples beyond the largest force that still read zero: below it noise
decides which samples read at all, which would bend the line. Intervals are percentiles over resampled recordings
(Efron's bootstrap), so they hold for quantised and heavy-tailed readings as well. NumPy only.

Shapes: T samples, N taxels.
"""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import numpy as np

from dexsim.core.config import from_dict, to_dict
from dexsim.core.errors import AssetError, DexsimError
from dexsim.core.files import read_bounded

_RESAMPLES = 400
_LEAST = 8  # samples


@dataclasses.dataclass(frozen=True)
class Estimate:
    """A number and its 95 % interval."""

    value: float
    low: float
    high: float

    def __str__(self) -> str:
        return f"{self.value:.4g} [{self.low:.4g}, {self.high:.4g}]"


@dataclasses.dataclass(frozen=True, eq=False)
class TaxelPress:
    """One finger pressed with varying force."""

    force: np.ndarray  # [T] N, reference
    reading: np.ndarray  # [T, N] N or counts, what the taxels said
    depth: np.ndarray | None = None  # [T, N] m, compression of the skin over each taxel
    area: np.ndarray | None = None  # [N] m^2


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
      seed: of the resampling.

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
    force, reading = force[keep], reading[keep]
    total = reading.sum(1)
    rng = np.random.default_rng(seed)

    threshold = _threshold(force, total, rng)
    silent = force[total <= 0]
    above = force > (silent.max() if silent.size else -np.inf)
    if above.sum() < _LEAST:
        raise DexsimError(f"sensor fit: {above.sum()} samples above the activation threshold, at least {_LEAST} needed")
    line = _bootstrap(np.stack([force[above], np.ones(above.sum())], 1), total[above], rng)
    gain, offset = line
    if gain.low <= 0:
        raise DexsimError(f"sensor fit: readings do not rise with force (gain {gain}); is the recording aligned?")
    residual = float(np.sqrt(np.mean((total[above] - gain.value * force[above] - offset.value) ** 2)))
    c10 = c01 = None
    if press.depth is not None:
        c10, c01, said = _material(press, keep, thickness, two_terms, rng)
        notes += said
    return FingerFit(gain, offset, threshold, c10, c01, residual, int(above.sum()), tuple(notes))


def save_fit(path: str | Path, fits: dict[str, FingerFit]) -> Path:
    """Write the fits by finger as JSON."""
    path = Path(path)
    path.write_text(json.dumps({name: to_dict(fit) for name, fit in fits.items()}, indent=1) + "\n")
    return path


def load_fit(path: str | Path) -> dict[str, FingerFit]:
    """Read what `save_fit` wrote.

    Raises:
      AssetError: missing, broken, or a gain that no sensor has.
    """
    try:
        table = json.loads(read_bounded(Path(path)))
        fits = {name: from_dict(FingerFit, entry) for name, entry in table.items()}
    except FileNotFoundError:
        raise AssetError(f"{path}: no such file") from None
    except (OSError, ValueError, AttributeError, TypeError, RecursionError, DexsimError) as error:
        raise AssetError(f"{path}: not a sensor fit ({str(error):.100})") from None
    for name, fit in fits.items():
        # Readings are newtons or counts, of 1 mN to 1 N each.
        if not 0.01 <= fit.gain.value <= 1e3 or not np.isfinite(fit.offset.value):
            gain, offset = fit.gain.value, fit.offset.value
            raise AssetError(
                f"{path}: {name:.40}: gain {gain:g} and offset {offset:g}: must be 0.01 to 1000, and finite"
            )
    return fits


def _checked(press: TaxelPress) -> tuple[np.ndarray, np.ndarray]:
    force, reading = np.asarray(press.force, float), np.asarray(press.reading, float)
    if force.ndim != 1 or reading.ndim != 2 or len(force) != len(reading):
        raise DexsimError(f"sensor fit: force {force.shape} and reading {reading.shape}, expected [T] and [T, N]")
    if not (np.all(np.isfinite(force)) and np.all(np.isfinite(reading))):
        raise DexsimError("sensor fit: a force or a reading is not finite")
    if len(force) < _LEAST or np.ptp(force) <= 0:
        raise DexsimError(
            f"sensor fit: {len(force)} samples between {force.min(initial=0):g} and "
            f"{force.max(initial=0):g} N; at least {_LEAST} at different forces needed"
        )
    return force, reading


def _threshold(force: np.ndarray, total: np.ndarray, rng: np.random.Generator) -> Estimate:
    """The force that best parts silent from reading samples."""
    pick = rng.integers(len(force), size=(_RESAMPLES, len(force)))
    several = np.array([_best_split(force[rows], total[rows] > 0) for rows in pick])
    value = _best_split(force, total > 0)
    return Estimate(value, *_interval(several, value))


def _best_split(force: np.ndarray, active: np.ndarray) -> float:
    """Midpoint between two sorted forces with the fewest silent samples above and reading ones below."""
    order = np.argsort(force, kind="stable")
    force, active = force[order], active[order]
    wrong = np.concatenate([[0], np.cumsum(active)]) + np.sum(~active) - np.concatenate([[0], np.cumsum(~active)])
    best = np.flatnonzero(wrong == wrong.min())
    split = int(best[len(best) // 2])
    if split in (0, len(force)):
        return float(force[0] if split == 0 else force[-1])
    return float((force[split - 1] + force[split]) / 2)


def _bootstrap(design: np.ndarray, target: np.ndarray, rng: np.random.Generator) -> list[Estimate]:
    """Huber regression [T, K] -> [T] with intervals over resampled rows."""
    value = _huber(design[None], target[None])[0]
    pick = rng.integers(len(target), size=(_RESAMPLES, len(target)))
    several = _huber(design[pick], target[pick])
    return [Estimate(float(v), *_interval(several[:, k], v)) for k, v in enumerate(value)]


def _interval(several: np.ndarray, value: float) -> tuple[float, float]:
    low, high = np.percentile(several, [2.5, 97.5])
    return float(min(low, value)), float(max(high, value))


def _huber(design: np.ndarray, target: np.ndarray, rounds: int = 20) -> np.ndarray:
    """Coefficients [R, K] of R regressions at once by reweighting; 1.345 robust deviations keep full weight."""
    scale = np.sqrt(np.mean(design**2, axis=1, keepdims=True)) + 1e-300
    x, weight = design / scale, np.ones_like(target)
    for _ in range(rounds):
        normal = np.einsum("rtk,rt,rtl->rkl", x, weight, x) + 1e-12 * np.eye(x.shape[-1])
        right = np.einsum("rtk,rt,rt->rk", x, weight, target)
        answer = np.linalg.solve(normal, right[..., None])[..., 0]
        error = np.abs(target - np.einsum("rtk,rk->rt", x, answer))
        deviation = 1.4826 * np.median(error, axis=1, keepdims=True) + 1e-9 * np.abs(target).max()
        weight = np.minimum(1.0, 1.345 * deviation / np.maximum(error, 1e-300))
    return answer / scale[:, 0]


def _material(
    press: TaxelPress, keep: np.ndarray, thickness: float | None, two_terms: bool, rng: np.random.Generator
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
    zero, notes = Estimate(0.0, 0.0, 0.0), list[str]()
    if not two_terms:
        return _bootstrap(basis[:, :1], force[touching], rng)[0], zero, notes
    c10, c01 = _bootstrap(basis, force[touching], rng)
    width = max(c10.high - c10.low, c01.high - c01.low)
    if width > 0.5 * max(abs(c10.value + c01.value), 1e-300):
        total = _bootstrap(basis.mean(1, keepdims=True), force[touching], rng)[0]
        notes.append(
            f"C10 and C01 cannot be told apart up to {deepest:.0%} compression; their sum is about {total.value:.4g} Pa"
        )
    return c10, c01, notes
