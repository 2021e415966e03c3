"""Reads recorded presses, and fits a calibration: forces and lever arms of the taxels, a line per joint and direction.

The torque that the simulation would report is computed from the same recording: the force of the taxels times its
lever arm at the measured joint angles (J^T f, with the kinematics of the simulation). The exact place of the contact on
the fingertip does not matter.

Because of friction a joint has two lines of current against torque. The motion of the joint decides which one applies:
while a finger presses harder, one of its joints may move back. Samples of resting joints are excluded, since their
friction can have any size.

Intervals count whole presses, and contain what no press shows: the error of the force's scale, of the lever arm, and of
the motors' temperature.
"""

import dataclasses
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy import ndimage

from dexsim.calibration.fit import MIN_SAMPLES, JointPress, calibrate, fit_line
from dexsim.calibration.maps import Calibration
from dexsim.calibration.press import MIN_LEVER, contact_jacobian
from dexsim.errors import CalibrationError
from dexsim.hand.description import Hand
from dexsim_real.calibrate.bench import Source, read_logs
from dexsim_real.calibrate.procedure import LOADING, RELEASED, REST, TOUCHED, UNLOADING
from dexsim_real.core.log import Kind, Record
from dexsim_real.sensors.hand import HandSensing, around, taxel_names

Scale = tuple[float, float, float]
"""Of a press's taxel counts: N per count, N without counts, and the share (95 %) by which the first may be wrong."""

_BLOCK = 0.25  # s averaged into one block, since counts are coarse
_LEVER = 0.002  # m, 95 %, between the contact and the centre of the taxels' forces
_HEAT = 0.02  # share, 95 %: magnets lose 0.1 % per K, and the windings' temperature is not known
_STILL = 0.25  # share of the usual speed below which a joint is at rest
_NOISE = 4.0  # standard deviations of the speed noise below which a joint is at rest
_TOP, _TOP_BLOCKS = 0.97, 4  # a current in this share of its maximum for this many blocks is at the motor's limit
_SHEAR = 0.1  # share of the force above which shear is noted
_TRUST = 0.3  # share of the torque above which shear, which the fit ignores, makes a press useless for a joint

_ACTIVE = 2.0  # counts above which a taxel takes part
_READINGS = 8  # gauge readings that a fingertip needs
# Shares of the scale, 95 %, that no reading shows:
_GAUGE = 0.03  # of the gauge itself, and of how straight it stands under a fingertip that turns by up to 0.25 rad
_PLACE = 0.08  # between places on a fingertip, whose taxels differ
_NOMINAL = 0.25  # of the taxels without a gauge
_OTHERS = 0.35  # of a fingertip without a gauge from those with one


@dataclasses.dataclass
class Recording:
    """One press; T samples in the order of time."""

    name: str
    finger: int
    joints: tuple[int, ...]  # joints that pressed
    rate: float  # samples per second
    gauge: dict[str, float]  # N by phase
    phase: np.ndarray  # [T] str
    time: np.ndarray  # [T] s
    counts: np.ndarray  # [T, N] tared, negative ones included
    shear: np.ndarray  # [T, 2] counts, sums of x and y beyond the rest's
    current: np.ndarray  # [T, J] A, with the sign of the hand
    position: np.ndarray  # [T, J] rad

    def at(self, *phases: str) -> np.ndarray:
        """Mask [T] of the samples of these phases."""
        return np.isin(self.phase, phases)

    @property
    def finished(self) -> bool:
        """Whether the fingertip was freed at the end; otherwise the press was interrupted."""
        return RELEASED in self.phase


def read_presses(paths: Iterable[Path], hand: Hand) -> tuple[Source, dict[str, Recording]]:
    """The presses in logs of `dexsim_real.calibrate`. A press in several logs is taken from the last that finished it.

    Raises LogError: not a log of presses, or recorded with other settings than the logs before.
    """
    source, logs = read_logs(paths, "calibrate")
    recordings: dict[str, Recording] = {}
    for records in logs:
        own = _presses(source, records, hand)
        recordings |= {press.name: press for press in own if press.finished or press.name not in recordings}
    return source, recordings


def _presses(source: Source, records: list[Record], hand: Hand) -> list[Recording]:
    """The presses of one log; those that were skipped or missed have no samples and are none."""
    sensing, slant = HandSensing(hand, source.hardware), list[np.ndarray]()
    presses = dict[str, tuple[dict[str, Any], dict[str, float], list[tuple[Any, ...]]]]()
    for record in records:
        content = record.content
        if "tare" in content:
            sensing.tare = np.array(content["tare"], np.float32)
        if "placement" in content:
            presses[content["placement"]["name"]] = content["placement"], {}, []
        if record.kind == Kind.META:
            continue
        placement, gauge, samples = presses.get(content["press"], ({"finger": 0}, {}, []))
        if "gauge" in content:
            gauge[content["phase"]] = float(content["gauge"])
            continue
        state, finger = sensing.decode(content["answer"]), placement["finger"]
        shear = np.stack([state["tip"]["taxel"][axis].sum(-1, dtype=float) for axis in "xy"], -1)  # [F, 2]
        if content["phase"] == REST:
            slant.append(shear)
        counts = sensing.counts(state)[finger].astype(float) - sensing.tare[finger]
        current, position = 1e-3 * state["joint"]["current"], sensing.angles(state["joint"]["position"]).astype(float)
        samples.append((content["phase"], record.time, counts, shear[finger], current, position))
    zero = np.mean(slant, 0) if slant else np.zeros((hand.num_fingers, 2))  # A taxel may read x and y without shear.
    recordings = []
    for name, (placement, gauge, samples) in presses.items():
        if samples:
            columns = map(np.array, zip(*samples, strict=True))
            recording = Recording(name, placement["finger"], tuple(placement["joints"]), source.rate, gauge, *columns)
            recording.shear -= zero[recording.finger]
            recordings.append(recording)
    return recordings


# --- the fit of each press -------------------------------------------------------------------------


class Blocks(NamedTuple):
    """A press averaged over B blocks of a quarter of a second."""

    counts: np.ndarray  # [B, N], as `repaired`
    dead: np.ndarray  # [N] bool, taxels
    shear: np.ndarray  # [B, 2] counts, along the taxels' x and y
    current: np.ndarray  # [B, J] A
    position: np.ndarray  # [B, J] rad
    speed: np.ndarray  # [B, J] rad/s
    run: np.ndarray  # [B] number of the loading or unloading phase
    press: np.ndarray  # [B] number of the press, up and down


class JointFit(NamedTuple):
    """What a press says of a joint."""

    press: str
    lever: float  # m
    real: JointPress
    sim: JointPress


def fit(source: Source, recordings: Mapping[str, Recording], hand: Hand) -> tuple[Calibration, dict[str, JointFit]]:
    """Fit a calibration to all recorded presses; and what each joint was fitted to, the press with its longest lever.

    Raises CalibrationError: recordings are missing or unusable.
    """
    loaded = {name: recording for name, recording in recordings.items() if recording.at(LOADING, UNLOADING).any()}
    blocks, notes = {name: make_blocks(recording, hand) for name, recording in loaded.items()}, list[str]()
    for name in [name for name, part in blocks.items() if not part.counts.any()]:  # Without force no lever arm.
        notes.append(f"{name}: left out: no taxel read 2 counts or more; press on the taxels, or with more current")
        del blocks[name]
    if not blocks:
        raise CalibrationError("; ".join(["no press was recorded; record again", *notes]))
    per_count, scales = force_scale(source, hand, [loaded[name] for name in blocks], notes)
    joints = dict[str, JointFit]()
    for name, part in blocks.items():
        for label, fitted in _press(hand, loaded[name], part, scales[name], notes).items():
            if label not in joints or fitted.lever > joints[label].lever:
                joints[label] = fitted
    real, sim = ({label: getattr(fitted, side) for label, fitted in joints.items()} for side in ("real", "sim"))
    try:
        calibration = calibrate(hand, real, sim, per_count, *source.identity)
    except CalibrationError as error:
        raise CalibrationError("; ".join([str(error), *notes])) from None
    ratio, notes = _force_per_torque(hand, calibration, joints), [*calibration.notes, *notes]
    return dataclasses.replace(calibration, force_per_torque=ratio, notes=tuple(notes)), joints


def _press(hand: Hand, recording: Recording, part: Blocks, scale: Scale, notes: list[str]) -> dict[str, JointFit]:
    """What one press says of each of its joints; of what it does not, it adds notes."""
    name, finger, counts, (per_count, offset, error) = recording.name, recording.finger, part.counts, scale
    sums = counts.sum(-1)
    force = sums * per_count + offset
    # All forces of a fingertip act along their mean normal: the skin is flat where it is pressed, and the force of a
    # fingertip is the sum over its taxels, as in simulation.
    shares = counts / np.maximum(sums, 1e-9)[:, None]
    contacts = [contact_jacobian(hand, at, finger, share) for at, share in zip(part.position, shares, strict=True)]
    arms = np.array([normal @ jacobian for normal, jacobian in contacts])  # [B, J] m
    firm = sums > 0.5 * sums.max()
    lever = np.average(arms[firm], 0, weights=sums[firm])
    # Shear over normal force by the taxels, and the longest lever arms of a force along the skin.
    shear = float(np.median(np.linalg.norm(part.shear[firm], axis=-1) / sums[firm]))
    normal, jacobian = contact_jacobian(hand, part.position[firm].mean(0), finger, counts.sum(0) / counts.sum())
    slip = shear * np.linalg.norm(jacobian - np.outer(normal, normal @ jacobian), axis=0)
    fits = {}
    for joint in recording.joints:
        label, arm = hand.joint_names[joint], float(abs(lever[joint]))
        if arm < MIN_LEVER:
            continue
        if slip[joint] > _TRUST * arm:
            notes.append(f"{label}: loaded by shear while the {name} was pressed; press with the side")
            continue
        way = _direction(part.speed[:, joint], recording, joint) * int(np.sign(lever[joint]))
        # A current that stays at the maximum of the press is the motor's limit.
        current, run = np.abs(part.current[:, joint]), part.run
        top = current > _TOP * ndimage.maximum(current, run, run)
        way[top & (ndimage.sum_labels(top, run, run) >= _TOP_BLOCKS)] = 0
        if max(np.sum(way > 0), np.sum(way < 0)) < MIN_SAMPLES:
            notes.append(f"{label}: hardly moved while the {name} was pressed; press on something softer, more often")
            continue
        # A force read too large makes the gain of the current too small, and leaves the lever arm.
        gain_error, placed = float(np.hypot(error, _HEAT)), float(np.hypot(_LEVER, slip[joint]) / arm)
        real = JointPress(force, part.current[:, joint], way, part.press, gain_error)
        fits[label] = JointFit(name, arm, real, JointPress(force, force * arms[:, joint], way, part.press, placed))
    if part.dead.any():
        which = f"{hand.finger_names[finger]}: dead: {taxel_names(hand, part.dead)}"
        notes.append(f"{which} read nothing while their neighbours were pressed; the fit uses the neighbours' mean")
    if shear > _SHEAR:
        notes.append(f"{name}: shear of {100 * shear:.0f} % of the force, ignored by the fit; press on what rolls")
    if not recording.finished:
        notes.append(f"{name}: was interrupted; the fit has what was pressed until then, press it again")
    elif (left := np.median(recording.counts[recording.at(RELEASED)].sum(-1))) > TOUCHED:
        notes.append(f"{name}: {left:.0f} counts remain after the press: the zero drifts")
    return fits


def make_blocks(recording: Recording, hand: Hand) -> Blocks:
    """Average a recording over blocks of time, but for an incomplete block at the end of a phase.

    Raises CalibrationError: no phase is long enough.
    """
    size, phase = max(round(_BLOCK * recording.rate), 1), recording.phase
    runs = [
        rows[: len(rows) // size * size].reshape(-1, size)
        for rows in np.split(np.arange(len(phase)), np.flatnonzero(phase[1:] != phase[:-1]) + 1)
        if phase[rows[0]] in (LOADING, UNLOADING) and len(rows) >= 2 * size  # A single block has no speed.
    ]
    if not runs:
        raise CalibrationError(f"{recording.name}: no press lasted {2 * _BLOCK:g} s; raise --press.seconds")
    time, angle = recording.time, recording.position
    # Not across a reversal, where friction changes its sign.
    speed = np.concatenate([np.gradient(angle[run].mean(1), time[run].mean(1), axis=0) for run in runs])
    rows, loading = np.concatenate(runs), phase == LOADING
    parts = (recording.counts, recording.shear, recording.current, angle)
    counts, shear, current, position = (part[rows].mean(1) for part in parts)
    run = np.repeat(range(len(runs)), [len(run) for run in runs])
    press = np.cumsum(np.diff(loading, prepend=False) & loading)[rows[:, 0]]
    return Blocks(*repaired(hand, counts), shear, current, position, speed, run, press)


def _direction(speed: np.ndarray, recording: Recording, joint: int) -> np.ndarray:
    """Direction [B] of motion of a joint: 1, -1, or 0 at rest."""
    jitter = np.median(np.abs(np.diff(recording.position[:, joint]))) / 0.6745 / np.sqrt(2)
    noise = jitter / np.sqrt(max(_BLOCK * recording.rate, 1)) / (np.sqrt(2) * _BLOCK)
    usual = np.quantile(np.abs(speed), 0.75)
    return np.where(np.abs(speed) > max(_STILL * usual, _NOISE * noise), np.sign(speed), 0).astype(int)


def _force_per_torque(hand: Hand, calibration: Calibration, joints: Mapping[str, JointFit]) -> np.ndarray:
    """Force of a fingertip over the torque of its finger's root joint, as a run reads that torque.

    A run does not know whether a finger closes or opens: the value is half way between the lines of both directions,
    and the interval reaches to them, and by what the presses and the lever arm leave open beyond. The scale of the
    force cancels out. What weight and friction add to the torque is in the lines' offsets.

    Returns:
      [3, F] N/Nm: value, low, high of the 95 % interval; 0 where nothing pressed.
    """
    ratio, real, sim = np.zeros((3, hand.num_fingers)), calibration.real, calibration.sim
    gains = np.abs(real.gain * np.mean(sim.gain, 0) / np.mean(real.gain, 0))  # [2, J] Nm/N
    by_press, by_lever = (np.max(side.gain_error / np.abs(side.gain), 0) for side in (real, sim))
    for finger, joint in enumerate(hand.root_joint):
        name, gain = hand.joint_names[joint], gains[:, joint]
        if name not in joints:
            continue
        presses = max(by_press[joint] ** 2 - joints[name].real.gain_error ** 2, 0.0)
        middle, share = gain.mean(), np.hypot(np.sqrt(presses), by_lever[joint])
        half = float(np.hypot(share * middle, np.ptp(gain) / 2))
        if half < middle:
            ratio[:, finger] = 1.0 / np.array([middle, middle + half, middle - half])
    return ratio


# --- scale of the force --------------------------------------------------------------------------


def force_scale(
    source: Source, hand: Hand, pressed: Iterable[Recording], notes: list[str]
) -> tuple[np.ndarray, dict[str, Scale]]:
    """Newtons of a count [F] for a run, and the scale of each press, by the gauge; adds notes.

    A press without readings uses those of the finger's other press. Raises CalibrationError: the readings do not rise
    with the force.
    """
    own, scales = dict[int, float](), dict[str, Scale]()  # `own` by finger: N per count
    pressed = sorted(pressed, key=lambda press: not press.name.endswith("pad"))
    for press in pressed:
        levels = {level: press.at(level) for level in press.gauge if press.at(level).any()}
        if len(levels) < _READINGS:
            if levels:
                notes.append(f"{press.name}: {len(levels)} gauge readings are ignored, {_READINGS} are needed")
            continue
        counts, _ = repaired(hand, np.array([press.counts[rows].mean(0) for rows in levels.values()]))
        gauge = np.array([press.gauge[level] for level in levels])
        if np.ptp(gauge) <= 0:
            raise CalibrationError(f"{press.name}, gauge: all readings are {gauge[0]:g} N")
        line = fit_line(gauge, np.maximum(counts.sum(-1), 0.0), np.arange(len(gauge)))
        if line.gain <= line.gain_error:
            raise CalibrationError(f"{press.name}, gauge: counts do not follow its readings ({line.gain:.3g} per N)")
        error = float(np.hypot(line.gain_error / line.gain, _GAUGE))
        scales[press.name] = 1.0 / line.gain, -line.offset / line.gain, error
        scale = f"{line.gain:.3g} +- {line.gain * np.hypot(error, _PLACE):.2g} counts per newton by the gauge"
        notes.append(f"{press.name}: {scale} ({len(gauge)} readings), {line.offset:.1f} counts at zero force")
        own.setdefault(press.finger, 1.0 / line.gain)
    others = float(np.mean(list(own.values()))) if own else source.hardware.force_per_count
    per_count = np.array([own.get(finger, others) for finger in range(hand.num_fingers)])
    if not own:
        notes.append(f"no gauge: the taxels' scale is the nominal one, which may be {100 * _NOMINAL:.0f} % off")
    for finger, name in enumerate(hand.finger_names):
        if own and finger not in own:
            notes.append(f"{name}: not compared with the gauge; has the others' mean (up to {100 * _OTHERS:.0f} % off)")
    for press in pressed:
        error = _PLACE if press.finger in own else _OTHERS if own else _NOMINAL
        scales.setdefault(press.name, (float(per_count[press.finger]), 0.0, error))
    return per_count, scales


def repaired(hand: Hand, counts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Counts [T, N] of a press, and the mask [N] of dead taxels, which read nothing although half of their neighbours
    did: they get the mean of their working neighbours. What reads next to nothing far from the press becomes 0."""
    largest = counts.max(0, keepdims=True)
    pressed, beside = largest >= _ACTIVE, around(hand, largest >= _ACTIVE)
    dead = (largest <= 0) & (beside >= around(hand, np.ones(largest.shape)) / 2)
    working = np.where(dead, 0.0, 1.0)
    filled = np.where(dead, around(hand, counts * working) / np.maximum(around(hand, working), 1), counts)
    return np.where(pressed | (beside > 0), filled, 0.0), dead[0]
