"""Checks of the tactile sensors: touched at rest, stuck, noisy or dead taxels.

A single taxel that reads high is stuck; several adjacent ones mean a touch. A dead taxel shows only while its
neighbours are pressed, so it is looked for after a press.
"""

import dataclasses
from collections.abc import Sequence

import numpy as np

from dexsim.hand.kinematics import Hand
from dexsim_real.calibrate.options import CheckConfig
from dexsim_real.core.errors import HandError
from dexsim_real.loop import Exchange
from dexsim_real.sensors.hand import HandSensing, HardwareConfig
from dexsim_real.sensors.taxels import judge_rest, taxel_names

_SMOOTH = 10  # samples of the moving mean for the drift


@dataclasses.dataclass(frozen=True)
class RestReport:
    """Taxels and currents of a hand at rest, in raw counts."""

    tare: np.ndarray  # [F, N] counts
    noise: np.ndarray  # [F] counts, standard deviation of the fingertip's sum
    current: np.ndarray  # [J] counts, mean: the zero error of the current sensor
    current_noise: np.ndarray  # [J] counts, standard deviation
    notes: tuple[str, ...]


def raw_sensing(hand: Hand, hardware: HardwareConfig) -> HandSensing:
    """A `HandSensing` whose `taxel_force` are the raw counts, neither tared nor thresholded."""
    return HandSensing(hand, dataclasses.replace(hardware, force_per_count=1.0, taxel_floor=0.0))


def check_rest(
    hand: Hand,
    counts: np.ndarray,
    current: np.ndarray,
    config: CheckConfig,
    hardware: HardwareConfig,
    fingers: tuple[int, ...],
) -> RestReport:
    """Check a recording with the motors off and nothing touching the hand.

    Args:
      counts: [T, F, N] raw taxel counts.
      current: [T, J] raw.
      config: thresholds.
      hardware: limits of what can be tared.
      fingers: indices of the fingers that will be pressed.

    Raises:
      HandError: something touches a fingertip, or a taxel is stuck.
    """
    mean, noise = counts.mean(0), counts.std(0)
    stuck, limit = judge_rest(hand, mean, hardware.tare_limit, hardware.tare_sum), hardware.tare_limit
    notes = []
    for finger, name in enumerate(hand.finger_names):
        if stuck[finger].any():
            raise HandError(
                f"{name}: {taxel_names(hand, stuck[finger])} read {mean[finger].max():.0f} counts alone and are stuck; "
                "power-cycle the hand, or raise --hardware.tare-limit here and in every run"
            )
        drift, usual = _drift(counts[:, finger].sum(-1))
        if drift > config.drift + usual:
            raise HandError(
                f"cannot tare the taxels: the {name}'s sum moved by {drift:.0f} counts at rest: "
                "something touches it; free the fingertip"
            )
        noisy = noise[finger] > config.noise
        if noisy.any():
            notes.append(f"{name}: noisy: {taxel_names(hand, noisy)} (up to {noise[finger].max():.1f} counts)")
        if finger in fingers and mean[finger].max() > limit / 2:
            notes.append(f"{name}: up to {mean[finger].max():.0f} counts at rest, included in the tare")
    return RestReport(mean, counts.sum(-1).std(0), current.mean(0), current.std(0), tuple(notes))


def check_answered(exchanges: Sequence[Exchange], seconds: float) -> Sequence[Exchange]:
    """The exchanges that the taxels are to be tared with, of a time in s.

    Raises:
      HandError: there are none.
    """
    if not exchanges:
        raise HandError(f"cannot tare the taxels: no usable answer in {seconds:g} s; check the cable")
    return exchanges


def check_release(name: str, sums: np.ndarray, config: CheckConfig) -> None:
    """Check that a fingertip reads about zero after a press.

    Args:
      name: of the press.
      sums: [T] counts of the fingertip's sum, tared, not clipped.
      config: thresholds.

    Raises:
      HandError: it reads far below zero, so it was touched when it was tared; or nothing was read.
    """
    if not len(sums):
        raise HandError(f"{name}: the hand did not answer after the press")
    left = float(np.median(sums))
    if left < -config.release:
        raise HandError(
            f"{name}: reads {left:.0f} counts after the press: it was touched while it was tared; free the fingertip"
        )


def dead_taxels(hand: Hand, counts: np.ndarray, threshold: float) -> np.ndarray:
    """Mask [N] of taxels that read nothing although their neighbours did.

    Args:
      hand: its taxel lattice.
      counts: [T, N] of one fingertip, tared.
      threshold: mean of the neighbours' largest counts above which a taxel must read.
    """
    largest = counts.max(0).reshape(hand.taxel_grid)
    padded = np.pad(largest, 1, constant_values=np.nan)
    columns, rows = hand.taxel_grid
    around = np.stack(
        [
            padded[1 + i : 1 + i + columns, 1 + j : 1 + j + rows]
            for i in (-1, 0, 1)
            for j in (-1, 0, 1)
            if (i, j) != (0, 0)
        ]
    )
    # At least half of the neighbours must read, so that taxels at the edge of a press do not count as dead.
    pressed = (np.nanmean(around, 0) >= threshold) & (np.nanmedian(around, 0) > 0.25 * threshold)
    return ((largest <= 0) & pressed).ravel()


def fill_dead(hand: Hand, counts: np.ndarray, dead: np.ndarray) -> np.ndarray:
    """Counts [T, N] in which a dead taxel has the mean of its working neighbours."""
    columns, rows = hand.taxel_grid
    filled, working = counts.copy(), ~dead.reshape(columns, rows)
    lattice = counts.reshape(-1, columns, rows)
    for index in np.flatnonzero(dead):
        column, row = divmod(int(index), rows)
        here = np.s_[max(column - 1, 0) : column + 2, max(row - 1, 0) : row + 2]
        near = lattice[:, *here][:, working[here]]
        if near.size:
            filled[:, index] = near.mean(1)
    return filled


def _drift(sums: np.ndarray) -> tuple[float, float]:
    """Range of the moving mean, and the part of it that noise alone explains."""
    smooth = np.convolve(sums, np.full(_SMOOTH, 1 / _SMOOTH), "valid")
    return float(np.ptp(smooth)), float(6 * np.std(np.diff(sums)) / np.sqrt(2 * _SMOOTH))
