"""Lines of one joint from the recording of its pressed fingertip.

Loading and unloading are fitted apart, because friction in the gear makes two lines: the motor holds more than the
force asks for on the way up, less on the way down. Samples of one press share its place, its ripple and its friction,
so intervals count whole presses, not samples.
"""

import dataclasses

import numpy as np
from scipy.ndimage import median_filter
from scipy.signal import find_peaks

from dexsim.calibration.line import LEAST_PRESSES, Line, fit_line
from dexsim.core.errors import CalibrationError

MIN_SAMPLES = 20
"""Samples that each direction needs."""
MIN_FORCE_RANGE = 0.5
"""N between the 5th and the 95th percentile of the force."""
_LARGEST = {"A": 20.0, "Nm": 50.0, "N": 500.0}  # beyond these the unit must be another
_SATURATED = 0.2  # share of the samples that may be at the maximum


@dataclasses.dataclass(frozen=True)
class JointPress:
    """One joint's recording while its fingertip was pressed, in the order of time."""

    force: np.ndarray  # [T] N
    value: np.ndarray  # [T] A (hand) or Nm (simulation), with its own sign
    direction: np.ndarray | None = None  # [T] 1 loading, -1 unloading, 0 leave out; None: found
    press: np.ndarray | None = None  # [T] int, number of the press, up and down; None: found
    gain_error: float = 0.0
    """Share of the gain, 95 %, that no sample can show: of the force's scale, or of the lever arm."""


@dataclasses.dataclass(frozen=True)
class JointLines:
    """Both lines of one joint on one side."""

    loading: Line | None
    unloading: Line | None
    friction: float  # value, half the gap at the middle of the forces; NaN with one line
    value_max: float
    force_max: float
    notes: tuple[str, ...]


def fit_joint(press: JointPress, unit: str, where: str = "recording") -> JointLines:
    """Fit loading and unloading of one joint; `unit` is "A" or "Nm", of `press.value`, `where` is named in errors.

    Raises:
      CalibrationError: too few samples, not a number, no excitation, saturated, another unit, or the value does not
        follow the force.
    """
    force, value = _checked(press, unit, where)
    direction = find_direction(force) if press.direction is None else np.sign(np.asarray(press.direction)).astype(int)
    number = find_presses(force) if press.press is None else np.asarray(press.press)
    lines: list[Line | None] = []
    for sign, name in ((1, "loading"), (-1, "unloading")):
        keep = direction == sign
        enough = np.sum(keep) >= MIN_SAMPLES
        lines.append(_fit_direction(force[keep], value[keep], number[keep], f"{where}, {name}") if enough else None)
    fits = [line for line in lines if line is not None]
    if not fits:
        raise CalibrationError(f"{where}: at least {MIN_SAMPLES} samples of rising or of falling force are needed")
    if len(fits) == 2 and fits[0].gain * fits[1].gain < 0:
        raise CalibrationError(
            f"{where}: rises with force while loading, falls while unloading; check joint and finger names"
        )
    notes = _line_notes(lines, unit)
    if len(np.unique(number[direction != 0])) < LEAST_PRESSES:
        notes.append(f"fewer than {LEAST_PRESSES} presses: the intervals leave out how presses differ ({unit})")
    sound = np.any([np.abs(value - line(force)) <= 5 * line.noise for line in fits], 0)
    friction = float("nan")
    if len(fits) == 2:
        middle = (np.min(force[sound]) + np.max(force[sound])) / 2
        friction = float(abs(fits[0](middle) - fits[1](middle)) / 2)
    loading, unloading = (line and line.widened(press.gain_error) for line in lines)
    value_max, force_max = float(np.max(np.abs(value[sound]))), float(np.max(force[sound]))
    return JointLines(loading, unloading, friction, value_max, force_max, tuple(notes))


def find_direction(force: np.ndarray, trim: float = 0.1) -> np.ndarray:
    """1 while the force [T] rises, -1 while it falls, 0 just after a turn; in the order of time.

    In the first `trim` of each swing the gear's friction is on its way from one side to the other.
    """
    smooth, turns = _turns(force)
    direction = np.zeros(len(smooth), int)
    for first, last in zip(turns[:-1], turns[1:], strict=True):
        swing, reach = smooth[first:last] - smooth[first], smooth[last] - smooth[first]
        direction[first:last] = np.where(np.abs(swing) >= trim * np.abs(reach), np.sign(reach), 0)
    return direction


def find_presses(force: np.ndarray) -> np.ndarray:
    """Number [T] of the press, up and down again, that each sample of a force [T] belongs to."""
    smooth, turns = _turns(force)
    starts = [turn for turn, after in zip(turns[1:-1], turns[2:], strict=True) if smooth[after] > smooth[turn]]
    return np.searchsorted(starts, np.arange(len(force)), side="right")


def _turns(force: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The force [T] without noise, and the indices of the extremes that stand out of the noise, ends included."""
    smooth = median_filter(np.asarray(force, float), 9 if len(force) >= 90 else 3, mode="nearest")
    noise = 1.4826 * np.median(np.abs(np.diff(force) - np.median(np.diff(force)))) / np.sqrt(2)
    step = max(0.05 * np.ptp(smooth), 4.0 * noise)
    inner = [find_peaks(way * smooth, prominence=step)[0] for way in (1, -1)]
    return smooth, np.concatenate([[0], np.sort(np.concatenate(inner)), [len(smooth) - 1]])


def _checked(press: JointPress, unit: str, where: str) -> tuple[np.ndarray, np.ndarray]:
    force, value = np.asarray(press.force, float), np.asarray(press.value, float)
    marks = [np.asarray(mark) for mark in (press.direction, press.press) if mark is not None]
    if force.ndim != 1 or any(array.shape != force.shape for array in (value, *marks)):
        raise CalibrationError(f"{where}: force {force.shape}, value {value.shape}: expected arrays of one length")
    if len(force) < MIN_SAMPLES:
        raise CalibrationError(f"{where}: {len(force)} samples, expected at least {MIN_SAMPLES} in a direction")
    if not np.all(np.isfinite(force) & np.isfinite(value)):
        raise CalibrationError(f"{where}: a sample is not a number: leave out the reads that failed")
    for name, array, given in (("force", force, "N"), ("value", value, unit)):
        typical = float(np.quantile(np.abs(array), 0.75))
        if typical > _LARGEST[given]:
            raise CalibrationError(f"{where}: {name} of {typical:g} {given}: give {given}, not counts or thousandths")
        if np.mean(np.abs(array) >= np.max(np.abs(array)) * (1 - 1e-9)) > _SATURATED:
            raise CalibrationError(
                f"{where}: {name} stays at its maximum of {np.max(np.abs(array)):.3g} {given}: saturated; press more "
                "gently, or raise the limit"
            )
    _check_range(force, where)
    return force, value


def _check_range(force: np.ndarray, where: str) -> None:
    low, high = np.quantile(force, [0.05, 0.95])
    if high - low < MIN_FORCE_RANGE:
        stays = f"force stays between {low:.3g} and {high:.3g} N"
        raise CalibrationError(f"{where}: {stays}: press over at least {MIN_FORCE_RANGE} N")


def _fit_direction(force: np.ndarray, value: np.ndarray, press: np.ndarray, where: str) -> Line:
    _check_range(force, where)
    line = fit_line(force, value, press)
    low, high = line.gain_interval
    if low <= 0.0 <= high:
        raise CalibrationError(
            f"{where}: does not follow the force (gain {line.gain:.3g}, 95 % {low:.3g} to {high:.3g}): check joint and "
            "finger, press harder or longer"
        )
    return line


def _line_notes(lines: list[Line | None], unit: str) -> list[str]:
    notes, names = [], ("loading", "unloading")
    for line, name, other in zip(lines, names, names[::-1], strict=True):
        if line is None:
            notes.append(f"no {name} recorded ({unit}): friction and offset are not apart, {other} stands for both")
            continue
        if line.gain_share > 0.1:
            notes.append(f"{name} gain known to {100 * line.gain_share:.0f} % only ({unit})")
        if line.outliers > 0.1 * line.samples:
            notes.append(f"{name}: {line.outliers} of {line.samples} samples are outliers ({unit})")
        if line.r_squared < 0.9:
            notes.append(f"{name}: R2 {line.r_squared:.2f}: hardly a line ({unit})")
    return notes
