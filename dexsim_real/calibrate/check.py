"""Health of the tactile sensors: what lies on them at rest, which taxels are stuck, noisy or dead.

A taxel that reads high by itself is stuck; several side by side are a touch. Whether a taxel is dead shows only
when its neighbours are pressed, so that is looked at after a press.
"""

import dataclasses

import numpy as np

from dexsim.hand.kinematics import Hand
from dexsim_real.calibrate.options import CheckConfig
from dexsim_real.core.errors import HandError
from dexsim_real.sensors.hand import HandSensing, HardwareConfig

_TOUCH = 3  # raised taxels side by side that make a touch
_SMOOTH = 10  # samples of the moving mean in which drift is looked for


@dataclasses.dataclass(frozen=True)
class RestReport:
    """Taxels and currents of a hand that rests, by raw counts."""

    tare: np.ndarray  # [F, N] counts
    noise: np.ndarray  # [F] counts, of the fingertip's sum
    current: np.ndarray  # [J] counts, mean: the zero error of the reading
    current_noise: np.ndarray  # [J] counts
    notes: tuple[str, ...]


def raw_sensing(hand: Hand, hardware: HardwareConfig) -> HandSensing:
    """A sensing whose `taxel_force` are the counts as they come, neither zeroed nor cut off."""
    return HandSensing(hand, dataclasses.replace(hardware, force_per_count=1.0, taxel_floor=0.0))


def check_rest(
    hand: Hand, counts: np.ndarray, current: np.ndarray, config: CheckConfig, limit: float, fingers: tuple[int, ...]
) -> RestReport:
    """Look at a reading with the motors off and nothing touched.

    Args:
      counts: [T, F, N] raw taxel counts.
      current: [T, J] raw.
      limit: counts beyond which a taxel cannot be zeroed (`HardwareConfig.tare_limit`).
      fingers: indices of those that will be pressed.

    Raises:
      HandError: a fingertip is touched, or has a taxel stuck so high that no run could zero it.
    """
    mean, noise = counts.mean(0), counts.std(0)
    notes = []
    for finger, name in enumerate(hand.finger_names):
        high = mean[finger] > limit
        patch = _largest_patch(high.reshape(hand.taxel_grid))
        if patch >= _TOUCH:
            raise HandError(
                f"cannot zero the taxels: {patch} taxels side by side on the {name} read above "
                f"{limit:.0f} counts: something touches it; free the fingertips"
            )
        if high.any():
            raise HandError(
                f"{name}: {taxel_names(hand, high)} read {mean[finger].max():.0f} counts alone: stuck; "
                "power-cycle the hand, or raise --hardware.tare-limit here and in every run"
            )
        drift, usual = _drift(counts[:, finger].sum(-1))
        if drift > config.drift + usual:
            raise HandError(
                f"cannot zero the taxels: the {name}'s sum moved by {drift:.0f} counts while it should "
                "rest: something touches it; let it come to rest"
            )
        restless = noise[finger] > config.noise
        if restless.any():
            notes.append(f"{name}: noisy: {taxel_names(hand, restless)} (up to {noise[finger].max():.1f} counts)")
        if finger in fingers and mean[finger].max() > limit / 2:
            notes.append(f"{name}: up to {mean[finger].max():.0f} counts at rest, taken as zero")
    return RestReport(mean, counts.sum(-1).std(0), current.mean(0), current.std(0), tuple(notes))


def check_release(name: str, sums: np.ndarray, config: CheckConfig) -> None:
    """After a press the fingertip is free again: does it read zero?

    Args:
      sums: [T] counts of the fingertip's sum, tared and not clipped.

    Raises:
      HandError: far below zero: it was touched when it was zeroed.
    """
    left = float(np.median(sums))
    if left < -config.release:
        raise HandError(
            f"{name}: reads {left:.0f} counts after the press: it was touched while it was zeroed; "
            "free the fingertip and begin again"
        )


def dead_taxels(hand: Hand, counts: np.ndarray, threshold: float) -> np.ndarray:
    """Which taxels [N] read nothing although those around them did.

    Args:
      counts: [T, N] of one fingertip, tared.
      threshold: counts that the neighbours' largest readings must have on average.
    """
    most = counts.max(0).reshape(hand.taxel_grid)
    padded = np.pad(most, 1, constant_values=np.nan)
    columns, rows = hand.taxel_grid
    around = np.stack(
        [
            padded[1 + i : 1 + i + columns, 1 + j : 1 + j + rows]
            for i in (-1, 0, 1)
            for j in (-1, 0, 1)
            if (i, j) != (0, 0)
        ]
    )
    # At least half of those around must read: beside the edge of a press nothing is no fault.
    pressed = (np.nanmean(around, 0) >= threshold) & (np.nanmedian(around, 0) > 0.25 * threshold)
    return ((most <= 0) & pressed).ravel()


def fill_dead(hand: Hand, counts: np.ndarray, dead: np.ndarray) -> np.ndarray:
    """Counts [T, N] with the mean of its sound neighbours for each dead taxel: so much of the force it carries."""
    columns, rows = hand.taxel_grid
    filled, sound = counts.copy(), ~dead.reshape(columns, rows)
    lattice = counts.reshape(-1, columns, rows)
    for index in np.flatnonzero(dead):
        column, row = divmod(int(index), rows)
        here = np.s_[max(column - 1, 0) : column + 2, max(row - 1, 0) : row + 2]
        near = lattice[:, *here][:, sound[here]]
        if near.size:
            filled[:, index] = near.mean(1)
    return filled


def taxel_names(hand: Hand, which: np.ndarray) -> str:
    """ "column 3 row 7, ..." of a mask [N], counted from 0 as in the layout file."""
    rows = hand.taxel_grid[1]
    named = [f"column {i // rows} row {i % rows}" for i in np.flatnonzero(which)]
    return ", ".join(named[:6]) + (f" and {len(named) - 6} more" if len(named) > 6 else "")


def _drift(sums: np.ndarray) -> tuple[float, float]:
    """Range of the moving mean, and what noise alone may make of it."""
    smooth = np.convolve(sums, np.full(_SMOOTH, 1 / _SMOOTH), "valid")
    return float(np.ptp(smooth)), float(6 * np.std(np.diff(sums)) / np.sqrt(2 * _SMOOTH))


def _largest_patch(mask: np.ndarray) -> int:
    from scipy.ndimage import label

    labels, count = label(mask, np.ones((3, 3)))
    return int(np.bincount(labels.ravel())[1:].max()) if count else 0
