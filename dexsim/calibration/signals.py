"""Recorded signals: those that cannot be what they are said to be, and where a force rises and falls."""

from collections.abc import Mapping

import numpy as np
from scipy.ndimage import median_filter
from scipy.signal import find_peaks

from dexsim.core.errors import CalibrationError

_LARGEST = {"A": 20.0, "Nm": 50.0, "N": 500.0, "rad": 2 * np.pi}  # beyond these the unit must be another


def check_signals(
    where: str, least: int, signals: Mapping[str, tuple[np.ndarray, str]], saturated: float, top: float = 1 - 1e-9
) -> None:
    """Check the signals of one recording.

    Args:
      where: named in errors.
      least: samples that are needed.
      signals: array [T] and its unit, by name.
      saturated: largest share of the samples that may be at the maximum; not of angles, which rest.
      top: share of the maximum from which on a sample is at it.

    Raises:
      CalibrationError: too short, of different lengths, not numbers, another unit, or saturated.
    """
    shapes = {name: np.shape(array) for name, (array, _) in signals.items()}
    length, *others = shapes.values()
    if len(length) != 1 or length[0] < least or any(shape != length for shape in others):
        got = ", ".join(f"{name} {shape}" for name, shape in shapes.items())
        raise CalibrationError(f"{where}: got {got}: expected arrays of one length, at least {least} samples")
    for name, (array, unit) in signals.items():
        size = np.abs(np.asarray(array, float))
        if not np.isfinite(largest := size.max()):
            raise CalibrationError(f"{where}: {name}: a sample is not a number; leave out the reads that failed")
        if (typical := np.quantile(size, 0.75)) > _LARGEST[unit]:
            raise CalibrationError(f"{where}: {name} of {typical:.3g} {unit}: give {unit}, not another unit or counts")
        if unit != "rad" and np.mean(size >= top * largest) > saturated:
            raise CalibrationError(
                f"{where}: {name} stays at its maximum of {largest:.3g} {unit}: saturated; command or press less"
            )


def find_swings(force: np.ndarray, trim: float = 0.1) -> tuple[np.ndarray, np.ndarray]:
    """Direction and press of each sample of a force [T], in the order of time.

    Returns:
      Direction [T]: 1 while the force rises, -1 while it falls, 0 just after a turn: in the first `trim` of each swing
      the gear's friction is on its way from one side to the other. Number [T] of the press, up and down again.
    """
    smooth = median_filter(np.asarray(force, float), 9 if len(force) >= 90 else 3, mode="nearest")
    noise = 1.4826 * np.median(np.abs(np.diff(force) - np.median(np.diff(force)))) / np.sqrt(2)
    step = max(0.05 * np.ptp(smooth), 4.0 * noise)
    inner = [find_peaks(way * smooth, prominence=step)[0] for way in (1, -1)]
    turns = np.concatenate([[0], np.sort(np.concatenate(inner)), [len(smooth) - 1]])
    direction, press = np.zeros((2, len(smooth)), int)
    for first, last in zip(turns[:-1], turns[1:], strict=True):
        swing, reach = smooth[first:last] - smooth[first], smooth[last] - smooth[first]
        direction[first:last] = np.where(np.abs(swing) >= trim * np.abs(reach), np.sign(reach), 0)
        press[first:] += first > 0 and reach > 0
    return direction, press
