"""From recordings of pressed fingertips to a `Calibration`, or to a refusal that says what to record.

Loading and unloading are fitted apart, because friction in the gear makes two lines: the motor holds more than the
force asks for on the way up, less on the way down. Samples of one press share its place, its ripple and its friction,
so intervals count whole presses, not samples.
"""

import dataclasses
import datetime
from collections.abc import Mapping
from typing import NamedTuple

import jax
import numpy as np
from scipy.ndimage import median_filter
from scipy.optimize import least_squares
from scipy.signal import find_peaks
from scipy.special import stdtrit
from scipy.stats import theilslopes

from dexsim.calibration.maps import Calibration, Side, blank_calibration, check_plausible
from dexsim.errors import CalibrationError
from dexsim.hand.description import Hand

MIN_SAMPLES = 20
"""Samples that each direction needs."""
MIN_FORCE_RANGE = 0.5
"""N between the 5th and the 95th percentile of the force."""
_LOSSES = 0.3  # share by which a gear's losses may part the gains of the two directions
_SATURATED = 0.2  # share of the samples that may be at the maximum
_LARGEST = {"A": 20.0, "Nm": 50.0, "N": 500.0, "rad": 2 * np.pi}  # beyond these the unit must be another
LEAST_PRESSES = 3
"""Presses below which their differences are not part of an interval."""
_CAUCHY = 2.385  # standard deviations, for 95 % efficiency under normal errors
_OUTLIER = 5.0  # standard deviations
_MAD = 1.4826  # median absolute deviation to standard deviation, normal errors
_START = 300  # samples that the Theil-Sen line is drawn through, for all pairs of many take long
_BLOCKS = (5, 20)  # parts of the samples by x, fewest and most


@dataclasses.dataclass(frozen=True)
class JointPress:
    """One joint's recording while its fingertip was pressed, in the order of time."""

    force: np.ndarray  # [T] N
    value: np.ndarray  # [T] A (hand) or Nm (simulation), with its own sign
    direction: np.ndarray | None = None  # [T] 1 loading, -1 unloading, 0 leave out; None: found
    press: np.ndarray | None = None  # [T] int, number of the press, up and down; None: found
    gain_error: float = 0.0
    """Share of the gain, 95 %, that no sample can show: of the force's scale, or of the lever arm."""


class Line(NamedTuple):
    """The line y = gain x + offset; an error is half of a 95 % interval."""

    gain: float
    offset: float
    gain_error: float
    offset_error: float
    r_squared: float  # share of the variance that the line explains, without outliers
    inside: np.ndarray  # [T] bool, the samples that are no outliers


def calibrate(
    hand: Hand,
    real: Mapping[str, JointPress],
    sim: Mapping[str, JointPress],
    force_per_count: float | np.ndarray = 0.1,
    serial: str = "",
    handedness: str = "",
) -> Calibration:
    """Fit all joints of a hand, from recordings by joint name: on the hand force against motor current (A), in
    simulation against joint torque (Nm), pressed at the same place.

    Joints that were not recorded on both sides (a fingertip's pad does not load every joint) get the mean of those with
    the same torque limit, with intervals that allow for it, and a note. The rest is kept in the file: `force_per_count`
    N, scalar or [F].

    Raises:
      CalibrationError: names the joint and what data is needed, or a number that no hand gives.
    """
    if unknown := sorted({*real, *sim} - set(hand.joint_names)):
        raise CalibrationError(f"no joint {unknown[0]!r} in hand {hand.name}")
    notes, sides = list[str](), dict[str, Side]()
    pressed = [joint for joint, name in enumerate(hand.joint_names) if name in real and name in sim]
    for presses, unit, where in ((real, "A", "on the hand"), (sim, "Nm", "in simulation")):
        fits: dict[int, Side] = {}
        for joint in pressed:
            name = hand.joint_names[joint]
            fits[joint], doubts = fit_joint(presses[name], unit, f"{name} {where}")
            notes += [f"{name}: {doubt}" for doubt in doubts]
        sides[unit] = _complete(hand, fits, where)
    if absent := [name for joint, name in enumerate(hand.joint_names) if joint not in pressed]:
        notes.append(f"{', '.join(absent)}: not pressed, mean of the joints of its torque limit, not to be trusted")
    calibration = dataclasses.replace(
        blank_calibration(hand),
        real=sides["A"],
        sim=sides["Nm"],
        force_per_count=np.broadcast_to(np.asarray(force_per_count, float), (hand.num_fingers,)).copy(),
        serial=serial,
        handedness=handedness,
        created=datetime.date.today().isoformat(),
        notes=tuple(dict.fromkeys(notes)),
    )
    check_plausible("calibration", calibration, hand)  # What is written must be readable.
    return calibration


def _complete(hand: Hand, fits: Mapping[int, Side], where: str) -> Side:
    """The lines of all joints. One that was not pressed has the mean of those with its torque limit; nothing is known
    of how it differs from them: the interval is the gain itself to either side."""
    rows, names = [], hand.joint_names
    for joint, limit in enumerate(hand.torque_limit):
        mates = [joint] if joint in fits else [other for other in fits if hand.torque_limit[other] == limit]
        if not mates:
            raise CalibrationError(f"{names[joint]}: no press of a joint of {limit:g} Nm; record one")
        odd = [other for other in mates if fits[other].gain[0] * fits[mates[0]].gain[0] < 0]
        if odd:  # Their mean may be next to nothing.
            raise CalibrationError(
                f"gain signs differ {where} between {names[odd[0]]} and {names[mates[0]]}: their mean cannot stand in "
                f"for {names[joint]}; check the wiring, or record {names[joint]}"
            )
        row = jax.tree.map(lambda *values: np.mean(values, 0), *(fits[other] for other in mates))
        rows.append(row if joint in fits else dataclasses.replace(row, gain_error=np.abs(row.gain)))
    return jax.tree.map(lambda *values: np.stack(values, -1), *rows)


# --- one joint --------------------------------------------------------------------------------------


def fit_joint(press: JointPress, unit: str, where: str = "recording") -> tuple[Side, list[str]]:
    """Fit loading and unloading of one joint.

    Args:
      unit: "A" or "Nm", of `press.value`.

    Returns:
      The lines ([2], maxima and friction []), and notes on what makes them doubtful. Where the joint moved one way
      only, its line stands for both, off by the gear's losses, and friction is NaN.

    Raises:
      CalibrationError: too few samples, not a number, no excitation, saturated, another unit, or the value does not
        follow the force.
    """
    signals = {"force": (press.force, "N"), "value": (press.value, unit)}
    check_signals(where, MIN_SAMPLES, signals, _SATURATED)
    force, value = np.asarray(press.force, float), np.asarray(press.value, float)
    direction, number = find_swings(force)
    if press.direction is not None:
        direction = np.sign(np.asarray(press.direction))
    if press.press is not None:
        number = np.asarray(press.press)
    lines, notes, sound = list[Line | None](), list[str](), np.zeros(len(force), bool)
    for sign, name in ((1, "loading"), (-1, "unloading")):
        keep = np.flatnonzero(direction == sign)
        if len(keep) < MIN_SAMPLES:
            lines.append(None)
            continue
        low, high = np.quantile(force[keep], [0.05, 0.95])
        if high - low < MIN_FORCE_RANGE:
            stays = f"force stays between {low:.3g} and {high:.3g} N"
            raise CalibrationError(f"{where}, {name}: {stays}: press over at least {MIN_FORCE_RANGE} N")
        line = fit_line(force[keep], value[keep], number[keep])
        if abs(line.gain) <= line.gain_error:
            raise CalibrationError(
                f"{where}, {name}: does not follow the force (gain {line.gain:.3g} +- {line.gain_error:.3g}): check "
                "joint and finger, press harder or longer"
            )
        lines.append(line)
        notes += _doubts(line, f"{name} ({unit})")
        sound[keep] = line.inside
    fitted = [line for line in lines if line is not None]
    if not fitted:
        raise CalibrationError(f"{where}: at least {MIN_SAMPLES} samples of rising or of falling force are needed")
    if fitted[0].gain * fitted[-1].gain < 0:
        raise CalibrationError(
            f"{where}: rises with force while loading, falls while unloading; check joint and finger names"
        )
    stand_in = fitted[0]._replace(gain_error=np.hypot(fitted[0].gain_error, _LOSSES * abs(fitted[0].gain)))
    both = {name: np.array([getattr(line or stand_in, name) for line in lines]) for name in Line._fields[:-1]}
    both["gain_error"] = np.hypot(both["gain_error"], press.gain_error * np.abs(both["gain"]))
    force, value = force[sound], np.abs(value[sound])
    middle = (np.min(force) + np.max(force)) / 2
    friction = np.ptp(both["gain"] * middle + both["offset"]) / 2 if len(fitted) == 2 else np.array(np.nan)
    if len(fitted) == 1:
        notes.append("moved one way only: friction and offset are not apart")
    if len(np.unique(number[direction != 0])) < LEAST_PRESSES:
        notes.append(f"fewer than {LEAST_PRESSES} presses: the intervals leave out how presses differ")
    return Side(**both, friction=friction, value_max=np.max(value), force_max=np.max(force)), notes


def _doubts(line: Line, which: str) -> list[str]:
    outliers, samples, share = int(np.sum(~line.inside)), len(line.inside), line.gain_error / abs(line.gain)
    notes = {
        f"{which}: gain known to {100 * share:.0f} % only": share > 0.1,
        f"{which}: {outliers} of {samples} samples are outliers": outliers > 0.1 * samples,
        f"{which}: R2 {line.r_squared:.2f}: hardly a line": line.r_squared < 0.9,
    }
    return [note for note, doubtful in notes.items() if doubtful]


# --- lines and signals ------------------------------------------------------------------------


def fit_line(x: np.ndarray, y: np.ndarray, press: np.ndarray) -> Line:
    """Fit y = gain x + offset to data with outliers.

    A Cauchy M-estimate from the Theil-Sen line: outliers to one side hardly move it. The interval is a jackknife, which
    leaves out a press, or a twentieth of the samples by x, at a time. The first shows what differs between presses, the
    second what recurs in all of them (motor ripple) and noise that is correlated along x; the wider one counts.

    Args:
      x, y: [T], finite; T > 2 and x not constant.
      press: [T] int, number of the press that a sample belongs to. From `LEAST_PRESSES` on, their differences widen the
        intervals.
    """
    x, y = np.asarray(x, float), np.asarray(y, float)
    scale = np.array([1.0, np.max(np.abs(x))])
    design = np.stack([np.ones_like(x), x / scale[1]], -1)
    some = np.random.default_rng(0).permutation(len(x))[:_START]
    gain, offset, *_ = theilslopes(y[some], x[some])
    noise = max(_MAD * float(np.median(np.abs(y - gain * x - offset))), 1e-9 * float(np.max(np.abs(y))), 1e-300)
    fit = least_squares(
        lambda guess: (design @ guess - y) / noise,
        (offset, gain * scale[1]),
        jac=lambda guess: design / noise,
        loss="cauchy",
        f_scale=_CAUCHY,
        xtol=1e-12,
    )
    residual = y - design @ fit.x
    square = (residual / (_CAUCHY * noise)) ** 2
    weight = 1.0 / (1.0 + square)
    slope = np.mean((1.0 - square) * weight**2)  # of the influence: how much a sample moves the line by itself
    order, blocks = np.argsort(x, kind="stable"), int(np.clip(len(x) // 10, *_BLOCKS))
    block = np.empty(len(x), int)
    block[order] = np.arange(len(x)) * blocks // len(x)
    groups = [block] + [press] * (len(np.unique(press)) >= LEAST_PRESSES)
    error = np.max([jackknife(slope * design, design, weight * residual, group) for group in groups], 0)
    (offset, gain), error = fit.x / scale, error / scale
    explained = np.sum(weight * (y - np.average(y, weights=weight)) ** 2)
    r_squared = float(1.0 - np.sum(weight * residual**2) / max(explained, 1e-300))
    inside = np.abs(residual) <= _OUTLIER * noise
    return Line(float(gain), float(offset), float(error[1]), float(error[0]), r_squared, inside)


def jackknife(curvature: np.ndarray, design: np.ndarray, residual: np.ndarray, group: np.ndarray) -> np.ndarray:
    """Half the 95 % interval [P] of a least-squares fit, from what it is without a group at a time: a Newton step each.

    Args:
      curvature: [N, P]; with the design it gives the Hessian, curvature^T design.
      design: [N, P] derivatives of the model.
      residual: [N], weighted.
      group: [N] int, samples that belong together.
    """
    moved, whole = [], curvature.T @ design
    for number in np.unique(group):
        own = group == number
        rest = np.linalg.pinv(whole - curvature[own].T @ design[own], rcond=1e-8, hermitian=True)
        moved.append(rest @ (design[own].T @ residual[own]))
    count = len(moved)
    return stdtrit(count - 1, 0.975) * np.sqrt((count - 1) / count * np.sum(np.square(moved), 0))


def check_signals(
    where: str, least: int, signals: Mapping[str, tuple[np.ndarray, str]], saturated: float, top: float = 1 - 1e-9
) -> None:
    """Check the signals of one recording, of `least` samples at least.

    Args:
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
