"""From recordings of pressed fingertips to a `Calibration`, or to a refusal that says what to record.

Loading and unloading are told apart, because friction in the gear obeys two lines: the motor
holds more than the force asks for on the way up, less on the way down.
"""

import dataclasses
import datetime
from collections.abc import Mapping

import numpy as np

from dexsim.calibration.maps import Calibration, Side, alignment
from dexsim.core.errors import CalibrationError
from dexsim.core.robust_line import Line, fit_line
from dexsim.hand.kinematics import Hand

MIN_SAMPLES = 20
"""Samples that each direction needs."""
MIN_FORCE_RANGE = 0.5
"""N between the 5th and the 95th percentile of the force."""
_LARGEST = {"A": 20.0, "Nm": 50.0, "N": 500.0}  # beyond these the unit must be another


@dataclasses.dataclass(frozen=True)
class JointPress:
    """One joint's recording while its fingertip was pressed, in the order of time."""

    force: np.ndarray  # [T] N
    value: np.ndarray  # [T] A (hand) or Nm (simulation), with its own sign
    direction: np.ndarray | None = None  # [T] 1 loading, -1 unloading, 0 leave out; None: found


@dataclasses.dataclass(frozen=True)
class JointLines:
    """Both lines of one joint on one side."""

    loading: Line | None
    unloading: Line | None
    friction: float  # value, half the gap at the middle of the forces; NaN with one line
    value_max: float
    force_max: float
    notes: tuple[str, ...]


def calibrate(
    hand: Hand,
    real: Mapping[str, JointPress],
    sim: Mapping[str, JointPress],
    *,
    force_per_count: float | np.ndarray = 0.1,
    current_per_count: float = 0.001,
    missing: str = "refuse",
    serial: str = "",
    created: str | None = None,
) -> Calibration:
    """Fit all joints of a hand.

    Args:
      hand: names, torque limits.
      real: by joint name, force against motor current (A).
      sim: by joint name, force against joint torque (Nm), pressed at the same place.
      force_per_count: N, scalar or [F]; kept in the file for the taxels.
      current_per_count: A per reported count; kept in the file.
      missing: what to do with joints that were not recorded (a fingertip's pad does not load
        every joint): "refuse", or "class" to take the mean of joints with the same torque limit.
      serial, created: kept in the file; `created` is today by default.

    Raises:
      CalibrationError: names the joint and what data is needed.
    """
    unknown = sorted({*real, *sim} - set(hand.joint_names))
    if unknown:
        raise CalibrationError(f"no joint {unknown[0]!r} in hand {hand.name}")
    if missing not in ("refuse", "class"):
        raise CalibrationError(f"missing = {missing!r}: choose refuse or class")
    fits: list[tuple[JointLines, JointLines] | None] = []
    for name in hand.joint_names:
        if name in real and name in sim:
            fits.append(
                (
                    fit_joint(real[name], "A", where=f"{name} on the hand"),
                    fit_joint(sim[name], "Nm", where=f"{name} in simulation"),
                )
            )
        elif missing == "refuse":
            side = "hand" if name not in real else "simulation"
            raise CalibrationError(
                f"{name}: no recording on the {side} side: press its fingertip, "
                "or take over its torque class with missing='class'"
            )
        else:
            fits.append(None)
    notes = _GENERAL + tuple(
        f"{name}: {note}"
        for name, fit in zip(hand.joint_names, fits, strict=True)
        if fit
        for lines in fit
        for note in lines.notes
    )
    sides, taken = zip(*(_gather(hand, fits, k) for k in (0, 1)), strict=True)
    notes += tuple(f"{name}: not recorded, mean of the joints of its torque limit" for name in taken[0])
    scale = np.broadcast_to(np.asarray(force_per_count, float), (hand.num_fingers,)).copy()
    calibration = Calibration(
        *sides,
        np.round(np.asarray(hand.torque_limit, float), 6),
        scale,
        hand=hand.name,
        joint_names=hand.joint_names,
        finger_names=hand.finger_names,
        current_per_count=current_per_count,
        serial=serial,
        created=created if created is not None else datetime.date.today().isoformat(),
        notes=notes,
    )
    return dataclasses.replace(calibration, notes=notes + _compare(calibration))


_GENERAL = (
    "only the ratio of the two gains is used: an error of the force sensor, if it is the same in "
    "every press, scales all torques and cannot be seen in these data",
    "torque constant, lever arm and gear efficiency enter as one product; the ratio of the gains "
    "unloading / loading is the product of the two directions' efficiencies, not either alone",
    "one posture: a weight on the joint and a zero error of the current are both in the offset",
)


def fit_joint(press: JointPress, unit: str, where: str = "recording") -> JointLines:
    """Fit loading and unloading of one joint.

    Args:
      press: the recording.
      unit: "A" or "Nm", of `press.value`.
      where: named in errors.

    Raises:
      CalibrationError: too few samples, not a number, no excitation, saturated, mixed units, or
        the value does not follow the force.
    """
    force, value = _checked(press, unit, where)
    direction = find_direction(force) if press.direction is None else np.sign(np.asarray(press.direction)).astype(int)
    free, clipped = _not_saturated(force, value, where)
    notes = [f"{clipped} saturated samples left out ({unit})"] if clipped else []
    lines = []
    for sign, name in ((1, "loading"), (-1, "unloading")):
        keep = free & (direction == sign)
        lines.append(
            _fit_direction(force[keep], value[keep], f"{where}, {name}") if np.sum(keep) >= MIN_SAMPLES else None
        )
    if lines == [None, None]:
        counts = [int(np.sum(free & (direction == sign))) for sign in (1, -1)]
        raise CalibrationError(
            f"{where}: {counts[0]} samples loading and {counts[1]} unloading: "
            f"at least {MIN_SAMPLES} in a direction are needed"
        )
    if lines[0] is not None and lines[1] is not None and lines[0].gain * lines[1].gain < 0:
        raise CalibrationError(
            f"{where}: rises with force while loading and falls while unloading: are two joints or fingers mixed up?"
        )
    notes += _line_notes(lines, unit)
    sound = free & np.any([np.abs(value - line(force)) <= 4.685 * line.noise for line in lines if line is not None], 0)
    return JointLines(
        *lines,
        _friction(lines, force[sound]),
        float(np.max(np.abs(value[sound]))),
        float(np.max(force[sound])),
        tuple(notes),
    )


def find_direction(force: np.ndarray, trim: float = 0.1) -> np.ndarray:
    """1 while the force [T] rises, -1 while it falls, 0 just after a turn; in the order of time.

    Turns are the extremes that stand out of the noise. The first `trim` of each swing is marked 0:
    there the gear's friction is on its way from one side to the other.
    """
    from scipy.ndimage import median_filter

    smooth = median_filter(np.asarray(force, float), 9 if len(force) >= 90 else 3, mode="nearest")
    noise = 1.4826 * np.median(np.abs(np.diff(force) - np.median(np.diff(force)))) / np.sqrt(2)
    step = max(0.05 * np.ptp(smooth), 4.0 * noise)
    turns, sign = _turns(smooth, step)
    direction = np.zeros(len(smooth), int)
    for first, last in zip(turns[:-1], turns[1:], strict=True):
        swing = np.abs(smooth[first:last] - smooth[first])
        reach = np.abs(smooth[last] - smooth[first])
        direction[first:last] = np.where(swing >= trim * reach, sign, 0)
        sign = -sign
    return direction


def _turns(smooth: np.ndarray, step: float) -> tuple[list[int], int]:
    """Indices of the extremes that are at least `step` apart, ends included, and the first way."""
    turns, best, way, first_way = [0], 0, 0, 0
    for index, value in enumerate(smooth):
        if way == 0:
            if abs(value - smooth[0]) >= step:
                way = first_way = 1 if value > smooth[0] else -1
                best = index
        elif way * (value - smooth[best]) > 0:
            best = index
        elif way * (smooth[best] - value) >= step:
            turns.append(best)
            way, best = -way, index
    return [*turns, len(smooth) - 1], first_way


def _checked(press: JointPress, unit: str, where: str) -> tuple[np.ndarray, np.ndarray]:
    force, value = np.asarray(press.force, float), np.asarray(press.value, float)
    if (
        force.ndim != 1
        or force.shape != value.shape
        or (press.direction is not None and np.shape(press.direction) != force.shape)
    ):
        raise CalibrationError(f"{where}: force {force.shape}, value {value.shape}: give arrays of one length")
    if len(force) < MIN_SAMPLES:
        raise CalibrationError(f"{where}: {len(force)} samples: at least {MIN_SAMPLES} in a direction are needed")
    bad = np.flatnonzero(~(np.isfinite(force) & np.isfinite(value)))
    if len(bad):
        raise CalibrationError(
            f"{where}: sample {bad[0]} is not a number ({len(bad)} of {len(force)}): leave out the reads that failed"
        )
    for name, array, limit in (("force", force, "N"), ("value", value, unit)):
        typical = float(np.quantile(np.abs(array), 0.75))
        if typical > _LARGEST[limit]:
            raise CalibrationError(
                f"{where}: {name} of {typical:g} {limit}: give it in {limit}, not in counts or thousandths"
            )
    _refuse_mixed_units(force, value, where)
    low, high = np.quantile(force, [0.05, 0.95])
    if high - low < MIN_FORCE_RANGE:
        raise CalibrationError(
            f"{where}: force stays between {low:.3g} and {high:.3g} N: press "
            f"from contact up over at least {MIN_FORCE_RANGE} N"
        )
    if low < -MIN_FORCE_RANGE:
        raise CalibrationError(f"{where}: force of {low:.3g} N: forces are magnitudes, tare the taxels first")
    return force, value


def _refuse_mixed_units(force: np.ndarray, value: np.ndarray, where: str) -> None:
    """Two crowds of value / force, well over a decade apart, are two units and not outliers."""
    use = (force > 0) & (value != 0)
    ratio = np.sort(np.log10(np.abs(value[use]) / force[use]))
    margin = len(ratio) // 10
    if margin < 2:
        return
    inner = np.diff(ratio)[margin:-margin]
    if np.max(inner, initial=0.0) > 1.5:
        raise CalibrationError(
            f"{where}: two groups of samples {10 ** np.max(inner):.0f} times "
            "apart: units are mixed, give all in A, Nm and N"
        )


def _not_saturated(force: np.ndarray, value: np.ndarray, where: str) -> tuple[np.ndarray, int]:
    """Which samples are off both ends of their ranges, and how many are not."""
    free = np.ones(len(force), bool)
    for name, array in (("force", force), ("value", np.abs(value))):
        top = array >= np.max(array) * (1 - 1e-9)
        # A count or two at the maximum is its resolution; a crowd there is a stop.
        crowd = np.sum(top) > max(0.02 * len(array), 3)
        neighbours = np.sum(array >= np.max(array) - 0.02 * np.ptp(array)) - np.sum(top)
        if crowd and np.sum(top) > 3 * neighbours:
            free &= ~top
            if np.sum(top) > 0.5 * len(array):
                raise CalibrationError(
                    f"{where}: {name} sits at its maximum {np.max(array):.3g} in "
                    f"{np.sum(top)} of {len(array)} samples: saturated, press "
                    "more gently or raise the limit"
                )
    return free, int(np.sum(~free))


def _fit_direction(force: np.ndarray, value: np.ndarray, where: str) -> Line:
    low, high = np.quantile(force, [0.05, 0.95])
    if high - low < MIN_FORCE_RANGE:
        raise CalibrationError(
            f"{where}: force only between {low:.3g} and {high:.3g} N: press over at least {MIN_FORCE_RANGE} N"
        )
    line = fit_line(force, value)
    if line.gain_interval[0] <= 0.0 <= line.gain_interval[1]:
        raise CalibrationError(
            f"{where}: does not follow the force (gain {line.gain:.3g}, 95 % "
            f"{line.gain_interval[0]:.3g} to {line.gain_interval[1]:.3g}): "
            "check joint and finger, press harder or longer"
        )
    return line


def _friction(lines: list[Line | None], force: np.ndarray) -> float:
    if lines[0] is None or lines[1] is None:
        return float("nan")
    middle = (np.min(force) + np.max(force)) / 2
    return float(abs(lines[0](middle) - lines[1](middle)) / 2)


def _line_notes(lines: list[Line | None], unit: str) -> list[str]:
    notes = []
    for line, name, other in zip(lines, ("loading", "unloading"), ("unloading", "loading"), strict=True):
        if line is None:
            notes.append(
                f"no {name} recorded ({unit}): friction and offset are not apart, the {other} line stands for both"
            )
            continue
        width = (line.gain_interval[1] - line.gain_interval[0]) / 2
        if width > 0.1 * abs(line.gain):
            notes.append(f"{name} gain known to {100 * width / abs(line.gain):.0f} % only ({unit})")
        if line.condition > 20:
            notes.append(
                f"{name}: forces lie close together (condition {line.condition:.0f}): "
                f"gain and offset trade off ({unit})"
            )
        if line.outliers > 0.1 * line.samples:
            notes.append(f"{name}: {line.outliers} of {line.samples} samples are outliers ({unit})")
        if line.r_squared < 0.9:
            notes.append(f"{name}: R2 {line.r_squared:.2f}: hardly a line ({unit})")
    return notes


def _gather(hand: Hand, fits: list, side: int) -> tuple[Side, list[str]]:
    """Arrays of one side, and the joints that were taken over from their class."""
    rows = [_row(fit[side]) if fit else None for fit in fits]
    taken = []
    for joint, row in enumerate(rows):
        if row is not None:
            continue
        same = [
            r for j, r in enumerate(rows) if fits[j] is not None and hand.torque_limit[j] == hand.torque_limit[joint]
        ]
        if not same:
            raise CalibrationError(
                f"{hand.joint_names[joint]}: no recording of any joint with "
                f"{hand.torque_limit[joint]:g} Nm to take over"
            )
        taken.append(hand.joint_names[joint])
        rows[joint] = {key: np.mean([r[key] for r in same], 0) for key in same[0]}
        rows[joint]["samples"] = rows[joint]["outliers"] = np.zeros(2)
    return Side(**{key: np.stack([row[key] for row in rows], -1) for key in rows[0]}), taken


def _row(lines: JointLines) -> dict[str, np.ndarray]:
    """The fields of `Side` for one joint; a missing line is the other one with 0 samples."""
    both = [lines.loading or lines.unloading, lines.unloading or lines.loading]
    measured = np.array([lines.loading is not None, lines.unloading is not None])
    row = {
        name: np.array([getattr(line, name) for line in both], float)
        for name in ("gain", "offset", "noise", "r_squared", "condition", "samples", "outliers")
    }
    row["samples"], row["outliers"] = row["samples"] * measured, row["outliers"] * measured
    for name in ("gain", "offset"):
        interval = np.array([getattr(line, f"{name}_interval") for line in both])
        row[f"{name}_low"], row[f"{name}_high"] = interval.T
    return row | {
        "friction": np.array(lines.friction),
        "value_max": np.array(lines.value_max),
        "force_max": np.array(lines.force_max),
    }


def _compare(calibration: Calibration) -> tuple[str, ...]:
    notes = []
    for name, ratio in zip(calibration.joint_names, alignment(calibration), strict=True):
        if not 0.9 < ratio < 1.1:
            notes.append(
                f"{name}: aligning by the maxima alone would be off by "
                f"{100 * abs(ratio - 1):.0f} %: the two sessions ended at different "
                "places on their lines"
            )
    return tuple(notes)
