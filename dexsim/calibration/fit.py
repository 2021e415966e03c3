"""From recordings of pressed fingertips to a `Calibration`, or to a refusal that says what to record."""

import dataclasses
import datetime
from collections.abc import Mapping

import numpy as np
from scipy.special import stdtrit

from dexsim.calibration.joint import JointLines, JointPress, fit_joint
from dexsim.calibration.maps import Calibration, Side, alignment, check_plausible
from dexsim.core.errors import CalibrationError
from dexsim.hand.description import Hand

_LOSSES = 0.3  # share by which a gear's losses may part the gains of the two directions

_GENERAL = (
    "only the ratio of the two gains is used: an error of the force sensor, if it is the same in "
    "every press, scales all torques and cannot be seen in these data",
    "torque constant, lever arm and gear efficiency enter as one product; the ratio of the gains "
    "unloading / loading is the product of the two directions' efficiencies, not either alone",
    "one posture: a weight on the joint and a zero error of the current are both in the offset",
)


def calibrate(
    hand: Hand,
    real: Mapping[str, JointPress],
    sim: Mapping[str, JointPress],
    *,
    force_per_count: float | np.ndarray = 0.1,
    serial: str = "",
    handedness: str = "",
    created: str | None = None,
) -> Calibration:
    """Fit all joints of a hand, from recordings by joint name: on the hand force against motor current (A), in
    simulation against joint torque (Nm), pressed at the same place.

    Joints that were not recorded on both sides (a fingertip's pad does not load every joint) get the mean of those with
    the same torque limit, with intervals that allow for it, and a note. The rest is kept in the file: `force_per_count`
    N, scalar or [F], and `created`, by default today.

    Raises:
      CalibrationError: names the joint and what data is needed, or a number that no hand gives.
    """
    if unknown := sorted({*real, *sim} - set(hand.joint_names)):
        raise CalibrationError(f"no joint {unknown[0]!r} in hand {hand.name}")
    fits: dict[int, tuple[JointLines, JointLines]] = {}
    notes = list(_GENERAL)
    for joint, name in enumerate(hand.joint_names):
        if name in real and name in sim:
            on_hand = fit_joint(real[name], "A", where=f"{name} on the hand")
            in_sim = fit_joint(sim[name], "Nm", where=f"{name} in simulation")
            fits[joint] = on_hand, in_sim
            notes += [f"{name}: {note}" for note in on_hand.notes + in_sim.notes]
        else:
            notes.append(f"{name}: not recorded, mean of the joints of its torque limit")
    real_side = _side(hand, {joint: on_hand for joint, (on_hand, _) in fits.items()}, "on the hand")
    sim_side = _side(hand, {joint: in_sim for joint, (_, in_sim) in fits.items()}, "in simulation")
    calibration = Calibration(
        _allow_for_scatter(hand, real_side, sim_side),
        sim_side,
        np.round(np.asarray(hand.torque_limit, float), 6),
        np.broadcast_to(np.asarray(force_per_count, float), (hand.num_fingers,)).copy(),
        hand=hand.name,
        joint_names=hand.joint_names,
        finger_names=hand.finger_names,
        serial=serial,
        handedness=handedness,
        created=created if created is not None else datetime.date.today().isoformat(),
    )
    check_plausible("calibration", calibration, hand)  # What is written must be readable.
    notes += [
        f"{name}: aligning by the maxima alone would be off by {100 * abs(ratio - 1):.0f} %: the two sessions ended "
        "at different places on their lines"
        for name, ratio in zip(hand.joint_names, alignment(calibration), strict=True)
        if not 0.9 < ratio < 1.1
    ]
    return dataclasses.replace(calibration, notes=tuple(notes))


def _side(hand: Hand, lines: Mapping[int, JointLines], where: str) -> Side:
    """The arrays of one side; a joint without lines has the mean of those with its torque limit."""
    measured = {joint: _row(both) for joint, both in lines.items()}
    rows, names = [], hand.joint_names
    for joint, limit in enumerate(hand.torque_limit):
        mates = [joint] if joint in measured else [other for other in measured if hand.torque_limit[other] == limit]
        if not mates:
            raise CalibrationError(f"{names[joint]}: no press of a joint of {limit:g} Nm; record one")
        odd = [other for other in mates if measured[other]["gain"][0] * measured[mates[0]]["gain"][0] < 0]
        if odd:  # Their mean may be next to nothing.
            raise CalibrationError(
                f"gain signs differ {where} between {names[odd[0]]} and {names[mates[0]]}: their mean cannot stand in "
                f"for {names[joint]}; check the wiring, or record {names[joint]}"
            )
        rows.append({key: np.mean([measured[other][key] for other in mates], 0) for key in measured[mates[0]]})
        if joint not in measured:
            rows[-1]["samples"] = np.zeros(2)
    return Side(**{key: np.stack([row[key] for row in rows], -1) for key in rows[0]})


def _row(lines: JointLines) -> dict[str, np.ndarray]:
    """The fields of `Side` for one joint; a missing line is the other one with 0 samples, off by the gear's losses."""
    only = lines.loading or lines.unloading
    assert only is not None, "`fit_joint` refuses a recording without a line"
    stand_in = dataclasses.replace(only.widened(_LOSSES), samples=0)
    both = [lines.loading or stand_in, lines.unloading or stand_in]
    names = ("gain", "offset", "noise", "r_squared", "samples")
    row = {name: np.array([getattr(line, name) for line in both], float) for name in names}
    for name in ("gain", "offset"):
        interval = np.array([getattr(line, f"{name}_interval") for line in both])
        row[f"{name}_low"], row[f"{name}_high"] = interval.T
    return row | {name: np.array(getattr(lines, name)) for name in ("friction", "value_max", "force_max")}


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
            # A prediction interval: Student's t for the scatter, and for the mean of `count` joints itself.
            scatter = stdtrit(count - 1, 0.975) * np.std(mates, 1, ddof=1) * np.sqrt(1 + 1 / count)
            share = np.minimum(scatter / np.abs(np.mean(mates, 1)), 1.0)
        half[:, joint] = np.hypot(half[:, joint], share * np.abs(real.gain[:, joint]))
    return dataclasses.replace(real, gain_low=real.gain - half, gain_high=real.gain + half)
