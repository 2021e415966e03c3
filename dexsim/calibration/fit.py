"""From recordings of pressed fingertips to a `Calibration`, or to a refusal that says what to record."""

import dataclasses
import datetime
from collections.abc import Mapping
from typing import Any

import numpy as np
from scipy.special import stdtrit

from dexsim.calibration.joint import JointLines, JointPress, fit_joint
from dexsim.calibration.maps import Calibration, Side, alignment, check_numbers
from dexsim.core.errors import CalibrationError
from dexsim.hand.kinematics import Hand


def calibrate(
    hand: Hand,
    real: Mapping[str, JointPress],
    sim: Mapping[str, JointPress],
    *,
    force_per_count: float | np.ndarray = 0.1,
    current_per_count: float = 0.001,
    missing: str = "refuse",
    serial: str = "",
    handedness: str = "",
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
      serial, handedness, created: kept in the file; `created` is today by default.

    Raises:
      CalibrationError: names the joint and what data is needed, or a number that no hand gives.
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
    (real_side, taken), (sim_side, _) = (_gather(hand, fits, k) for k in (0, 1))
    real_side = _allow_for_scatter(hand, real_side, sim_side)
    notes += tuple(f"{name}: not recorded, mean of the joints of its torque limit" for name in taken)
    scale = np.broadcast_to(np.asarray(force_per_count, float), (hand.num_fingers,)).copy()
    calibration = Calibration(
        real_side,
        sim_side,
        np.round(np.asarray(hand.torque_limit, float), 6),
        scale,
        hand=hand.name,
        joint_names=hand.joint_names,
        finger_names=hand.finger_names,
        current_per_count=current_per_count,
        serial=serial,
        handedness=handedness,
        created=created if created is not None else datetime.date.today().isoformat(),
        notes=notes,
    )
    check_numbers("calibration", calibration, hand)  # What is written must be readable.
    return dataclasses.replace(calibration, notes=notes + _compare(calibration))


_GENERAL = (
    "only the ratio of the two gains is used: an error of the force sensor, if it is the same in "
    "every press, scales all torques and cannot be seen in these data",
    "torque constant, lever arm and gear efficiency enter as one product; the ratio of the gains "
    "unloading / loading is the product of the two directions' efficiencies, not either alone",
    "one posture: a weight on the joint and a zero error of the current are both in the offset",
)


_LOSSES = 0.3  # share by which a gear's losses may part the gains of the two directions


def _gather(hand: Hand, fits: list, side: int) -> tuple[Side, list[str]]:
    """Arrays of one side, and the joints that got the mean of their class."""
    measured = {joint: _row(fit[side]) for joint, fit in enumerate(fits) if fit}
    rows, taken = [], []
    for joint in range(len(fits)):
        if joint in measured:
            rows.append(measured[joint])
            continue
        mates = [other for other in measured if hand.torque_limit[other] == hand.torque_limit[joint]]
        same = [measured[other] for other in mates]
        if not same:
            raise CalibrationError(
                f"{hand.joint_names[joint]}: no recording of any joint with "
                f"{hand.torque_limit[joint]:g} Nm to take over"
            )
        names = hand.joint_names
        odd = [other for other in mates if np.sign(measured[other]["gain"][0]) != np.sign(same[0]["gain"][0])]
        if odd:  # Their mean may be next to nothing.
            raise CalibrationError(
                f"{names[odd[0]]}: its gain {('on the hand', 'in simulation')[side]} has not the sign of that of "
                f"{names[mates[0]]}: no mean of both can stand for {names[joint]}; check the wiring, or record "
                f"{names[joint]}"
            )
        taken.append(hand.joint_names[joint])
        mean = {key: np.mean([row[key] for row in same], 0) for key in same[0]}
        rows.append(mean | {"samples": np.zeros(2), "outliers": np.zeros(2)})
    fields: dict[str, Any] = {key: np.stack([row[key] for row in rows], -1) for key in rows[0]}
    return Side(**fields), taken


def _allow_for_scatter(hand: Hand, real: Side, sim: Side) -> Side:
    """Widen the gains of joints that took the mean of their class: one more joint scatters as those measured do.

    With a single measured joint nothing is known of the scatter: the interval is the gain itself to either side.
    """
    half = (np.asarray(real.gain_high) - np.asarray(real.gain_low)) / 2
    measured, limit = np.any(np.asarray(real.samples) > 0, 0), np.asarray(hand.torque_limit)
    ratio = np.asarray(sim.gain) / np.asarray(real.gain)
    for joint in np.flatnonzero(~measured):
        mates = ratio[:, measured & (limit == limit[joint])]
        count, share = mates.shape[1], np.ones(2)
        if count > 1:
            scatter = stdtrit(count - 1, 0.975) * np.std(mates, 1, ddof=1) * np.sqrt(1 + 1 / count)
            share = np.minimum(scatter / np.abs(np.mean(mates, 1)), 1.0)
        half[:, joint] = np.hypot(half[:, joint], share * np.abs(real.gain[:, joint]))
    return dataclasses.replace(real, gain_low=real.gain - half, gain_high=real.gain + half)


def _row(lines: JointLines) -> dict[str, np.ndarray]:
    """The fields of `Side` for one joint; a missing line is the other one with 0 samples, off by the gear's losses."""
    only = lines.loading or lines.unloading
    assert only is not None, "`fit_joint` refuses a recording without a line"
    stand_in = only.widened(_LOSSES)
    both = [lines.loading or stand_in, lines.unloading or stand_in]
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
