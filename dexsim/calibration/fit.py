"""From recordings of pressed fingertips to a `Calibration`, or to a refusal that says what to record.

Loading and unloading are fitted apart, because friction in the gear makes two lines: the motor holds more than the
force asks for on the way up, less on the way down. Samples of one press share its place, its ripple and its friction,
so intervals count whole presses, not samples.
"""

import dataclasses
import datetime
from collections.abc import Mapping

import jax
import numpy as np

from dexsim.calibration.line import LEAST_PRESSES, Line, fit_line
from dexsim.calibration.maps import Calibration, Side, blank_calibration, check_plausible
from dexsim.calibration.signals import check_signals, find_swings
from dexsim.core.errors import CalibrationError
from dexsim.hand.description import Hand

MIN_SAMPLES = 20
"""Samples that each direction needs."""
MIN_FORCE_RANGE = 0.5
"""N between the 5th and the 95th percentile of the force."""
_LOSSES = 0.3  # share by which a gear's losses may part the gains of the two directions
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
      where: named in errors.

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
    found = [line for line in lines if line is not None]
    if not found:
        raise CalibrationError(f"{where}: at least {MIN_SAMPLES} samples of rising or of falling force are needed")
    if found[0].gain * found[-1].gain < 0:
        raise CalibrationError(
            f"{where}: rises with force while loading, falls while unloading; check joint and finger names"
        )
    stand_in = found[0]._replace(gain_error=np.hypot(found[0].gain_error, _LOSSES * abs(found[0].gain)))
    both = {name: np.array([getattr(line or stand_in, name) for line in lines]) for name in Line._fields[:-1]}
    both["gain_error"] = np.hypot(both["gain_error"], press.gain_error * np.abs(both["gain"]))
    force, value = force[sound], np.abs(value[sound])
    middle = (np.min(force) + np.max(force)) / 2
    friction = np.ptp(both["gain"] * middle + both["offset"]) / 2 if len(found) == 2 else np.array(np.nan)
    if len(found) == 1:
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
