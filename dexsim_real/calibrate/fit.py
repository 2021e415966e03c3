"""From recorded presses to a calibration: forces and lever arms by taxel, robust lines by joint.

The torque that the simulation would show is computed from the same recording: every taxel's force times its lever
arm at the measured angles, J^T f with the kinematics that both worlds share. So it does not matter where exactly on
the fingertip was pressed.

Friction makes two lines of a joint's current, and which of them holds is for the joint's own motion to say: while a
finger presses harder, one of its joints may well give way. Samples of joints at rest, where friction could have any
size, are left out.
"""

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy.ndimage import binary_dilation

from dexsim.calibration import sensor
from dexsim.calibration.fit import calibrate
from dexsim.calibration.joint import MIN_SAMPLES, JointPress
from dexsim.calibration.maps import Calibration
from dexsim.calibration.press import MIN_LEVER
from dexsim.calibration.sensor import FingerFit, fit_finger
from dexsim.core.errors import CalibrationError, DexsimError
from dexsim.hand.kinematics import Hand, forward_kinematics, taxel_normals, taxel_positions
from dexsim_real.calibrate.check import dead_taxels, fill_dead, taxel_names
from dexsim_real.calibrate.press import LOADING, RELEASED, UNLOADING
from dexsim_real.calibrate.read import Recording, Session

_BLOCK = 0.25  # s that make one sample: counts are coarse, and a mean of many is not
_ACTIVE = 2.0  # counts from which on a taxel takes part
_STILL = 0.25  # of the usual speed, below which a joint is at rest
_NOISE = 4.0  # standard deviations of a block's angle, the same
_TOP, _TOP_BLOCKS = 0.97, 4  # share of the largest current, and for how long, that make it the motor's limit
_READINGS = 8  # of the gauge that a fingertip needs
_SHEAR = 0.1  # of the force, from which on a note is due


@dataclasses.dataclass(frozen=True)
class Blocks:
    """A press in means over a quarter of a second, B of them."""

    counts: np.ndarray  # [B, N] of the taxels that take part, others 0
    current: np.ndarray  # [B, J] A
    position: np.ndarray  # [B, J] rad
    speed: np.ndarray  # [B, J] rad/s
    shear: np.ndarray  # [B, 2] counts, by the taxels' own axes
    run: np.ndarray  # [B] number of the way up or down that it belongs to


@dataclasses.dataclass(frozen=True)
class Fit:
    """A calibration, what it was fitted to, and how the taxels compare with the gauge."""

    calibration: Calibration
    real: dict[str, JointPress]
    sim: dict[str, JointPress]
    source: dict[str, str]  # joint to press
    sensors: dict[str, FingerFit]  # by finger: counts as a run sees them against newtons


def fit(session: Session, hand: Hand, created: str | None = None) -> Fit:
    """Fit everything that was recorded.

    Raises:
      CalibrationError: what is missing, or cannot be a press.
    """
    pressed = [r for r in session.recordings.values() if len(r.samples(LOADING, UNLOADING))]
    if not pressed:
        raise CalibrationError("no press was recorded: begin again")
    per_count, newtons, sensors, notes = _gauges(session, hand, pressed)
    real, sim, source, reach = {}, {}, {}, {}
    for recording in pressed:
        blocks = make_blocks(recording, hand.taxel_grid)
        dead = dead_taxels(hand, blocks.counts, session.check.neighbours)
        blocks = dataclasses.replace(blocks, counts=fill_dead(hand, blocks.counts, dead))
        gain, offset = newtons[recording.name]
        force = blocks.counts.sum(-1) * gain + offset
        torque = taxel_torque(hand, blocks.position, recording.finger, blocks.counts * gain)
        high = force > 0.5 * force.max()
        lever = torque[high].sum(0) / force[high].sum()
        # What the gauge adds to the taxels' sum lies where they do.
        torque += offset * lever
        for joint in recording.joints:
            label = hand.joint_names[joint]
            if abs(lever[joint]) < max(MIN_LEVER, reach.get(label, 0.0)):
                continue
            way = _direction(blocks.speed[:, joint], recording, joint) * int(np.sign(lever[joint]))
            way[_at_limit(blocks.current[:, joint], blocks.run)] = 0
            if max(np.sum(way > 0), np.sum(way < 0)) < MIN_SAMPLES:
                notes.append(
                    f"{label}: hardly moved while the {recording.name} was pressed, friction held it: press "
                    "on something softer, or more often"
                )
                continue
            reach[label], source[label] = abs(lever[joint]), recording.name
            real[label] = JointPress(force, blocks.current[:, joint], way)
            sim[label] = JointPress(force, torque[:, joint], way)
        notes += _press_notes(session, hand, recording, blocks, dead)
    try:
        result = calibrate(
            hand,
            real,
            sim,
            force_per_count=per_count,
            current_per_count=1e-3,
            missing="class",
            serial=session.serial,
            created=created,
        )
    except CalibrationError as error:
        raise CalibrationError("; ".join([str(error), *(note for note in notes if "hardly moved" in note)])) from None
    notes += _zero_note(session, hand)
    # What a gauge has measured is no longer unknown.
    kept = tuple(note for note in result.notes if not (sensors and note.startswith("only the ratio")))
    return Fit(dataclasses.replace(result, notes=(*kept, *notes)), real, sim, source, sensors)


def make_blocks(recording: Recording, grid: tuple[int, int]) -> Blocks:
    """Means over blocks of time within a phase; what is left over at a phase's end is not used."""
    size = max(round(_BLOCK * recording.rate), 1)
    phase = np.array(recording.phase)
    runs = [
        [np.arange(size) + at for at in range(first, last - size + 1, size)]
        for first, last in _runs(phase)
        if phase[first] in (LOADING, UNLOADING)
    ]
    runs = [np.array(run) for run in runs if len(run) > 1]  # One block has no speed.
    if not runs:
        raise CalibrationError(f"{recording.name}: no press lasted for {2 * _BLOCK:g} s: press more slowly")
    time, angle = np.array(recording.time), np.array(recording.position)
    # Not across a turn: there friction is on its way from one side to the other.
    speed = np.concatenate([np.gradient(angle[run].mean(1), time[run].mean(1), axis=0) for run in runs])
    rows = np.concatenate(runs)
    position = angle[rows].mean(1)
    counts = np.array(recording.counts)[rows].mean(1)
    active = (counts.max(0) >= _ACTIVE).reshape(grid)
    counts = counts * binary_dilation(active, np.ones((3, 3))).ravel()
    return Blocks(
        counts,
        np.array(recording.current)[rows].mean(1),
        position,
        speed,
        np.array(recording.shear)[rows].mean(1),
        np.repeat(np.arange(len(runs)), [len(run) for run in runs]),
    )


def taxel_torque(hand: Hand, position: np.ndarray, finger: int, force: np.ndarray) -> np.ndarray:
    """Joint torques [T, J] Nm that hold taxel forces [T, N] N at angles [T, J] rad: J^T f.

    All forces of a fingertip point the same way, along their mean normal: the skin lies flat on what it is pressed
    against, and a fingertip's force is the sum over its taxels, as in simulation.
    """
    rows = [
        _torque(hand, np.int32(finger), np.float32(at), np.float32(push))
        for at, push in zip(position, force, strict=True)
    ]
    return np.array(rows, float)


@functools.partial(jax.jit, static_argnames="hand")
def _torque(hand: Hand, finger: jax.Array, at: jax.Array, force: jax.Array) -> jax.Array:
    mean = force @ taxel_normals(hand, forward_kinematics(hand, at))[finger]
    normal = mean / jnp.maximum(jnp.linalg.norm(mean), 1e-6)
    return jax.grad(lambda q: force @ taxel_positions(hand, forward_kinematics(hand, q))[finger] @ normal)(at)


def _direction(speed: np.ndarray, recording: Recording, joint: int) -> np.ndarray:
    """Way [B] in which a joint moves: 1, -1, or 0 where it rests."""
    position = np.array(recording.position)[:, joint]
    jitter = np.median(np.abs(np.diff(position))) / 0.6745 / np.sqrt(2)
    noise = jitter / np.sqrt(max(_BLOCK * recording.rate, 1)) / (np.sqrt(2) * _BLOCK)
    usual = np.quantile(np.abs(speed), 0.75)
    return np.where(np.abs(speed) > max(_STILL * usual, _NOISE * noise), np.sign(speed), 0).astype(int)


def _at_limit(current: np.ndarray, run: np.ndarray) -> np.ndarray:
    """Whether [B] the motor gives all that it may: its current stays at the top of a press."""
    found = np.zeros(len(current), bool)
    for number in np.unique(run):
        here = np.flatnonzero(run == number)
        size = np.abs(current[here])
        top = size > _TOP * size.max()
        found[here] = top & (top.sum() >= _TOP_BLOCKS)
    return found


def _runs(phase: np.ndarray) -> list[tuple[int, int]]:
    """First and last + 1 of each stretch of one phase."""
    cuts = np.flatnonzero(phase[1:] != phase[:-1]) + 1
    return list(zip([0, *cuts], [*cuts, len(phase)], strict=True))


# --- the gauge, the notes ------------------------------------------------------------------------------


def _gauges(
    session: Session, hand: Hand, pressed: list[Recording]
) -> tuple[np.ndarray, dict[str, Any], dict, list[str]]:
    """Newtons per count [F] for a run; newtons = gain counts + offset by press, for the joints; fits; notes.

    For the joints a press goes by its own comparison, or by that of the finger's other press.
    """
    per_count = np.full(hand.num_fingers, session.hardware.force_per_count)
    newtons, fits, notes = {}, {}, []
    for recording in sorted(pressed, key=lambda r: not r.name.endswith("pad")):
        levels = [level for level in recording.gauge if len(recording.samples(level))]
        if len(levels) < _READINGS:
            if levels:
                notes.append(
                    f"{recording.name}: {len(levels)} readings of the gauge do not count, {_READINGS} are needed"
                )
            continue
        name, gauge = hand.finger_names[recording.finger], np.array([recording.gauge[k] for k in levels])
        every = np.array(recording.counts)
        counts = np.array([every[recording.samples(k)].mean(0) for k in levels])
        active = binary_dilation((counts.max(0) >= _ACTIVE).reshape(hand.taxel_grid), np.ones((3, 3))).ravel()
        shown = np.array([np.mean(np.array(recording.shown)[recording.samples(k)]) for k in levels])
        whole, found = (_against(gauge, part, recording.name) for part in ((counts * active).sum(-1), shown))
        newtons[recording.name] = 1.0 / whole.gain.value, -whole.offset.value / whole.gain.value
        notes.append(
            f"{recording.name}: {found.gain} counts per newton by the gauge ({found.samples} readings), "
            f"{found.offset} counts at none"
        )
        if name not in fits:
            fits[name], per_count[recording.finger] = found, 1.0 / found.gain.value
    if fits:
        per_count = np.where(
            np.isin(hand.finger_names, list(fits)),
            per_count,
            np.mean([1.0 / found.gain.value for found in fits.values()]),
        )
        notes += [
            f"{name}: not compared with the gauge, mean of the other fingers"
            for name in hand.finger_names
            if name not in fits
        ]
    rest = {r.name: (float(per_count[r.finger]), 0.0) for r in pressed}
    return per_count, rest | newtons, fits, notes


def _against(gauge: np.ndarray, counts: np.ndarray, name: str) -> FingerFit:
    try:
        return fit_finger(sensor.TaxelPress(gauge, np.maximum(counts, 0.0)[:, None]))
    except DexsimError as error:
        raise CalibrationError(f"{name}, gauge: {error}") from None


def _press_notes(session: Session, hand: Hand, recording: Recording, blocks: Blocks, dead: np.ndarray) -> list[str]:
    """Dead taxels, shear and drift of one press."""
    notes, finger = [], hand.finger_names[recording.finger]
    if dead.any():
        notes.append(
            f"{finger}: dead: {taxel_names(hand, dead)}: nothing where those around were pressed; here "
            "their mean stands in for it, a run does without"
        )
    sums = blocks.counts.sum(-1)
    high = sums > 0.5 * sums.max()
    share = float(np.median(np.linalg.norm(blocks.shear[high], axis=-1) / sums[high]))
    if share > _SHEAR:
        notes.append(
            f"{recording.name}: shear of {100 * share:.0f} % of the force by the taxels' x and y: it loads "
            "the joints and is not in their lines; press on something that slides, rolls or is soft"
        )
    left = np.array(recording.counts)[recording.samples(RELEASED)].sum(-1)
    if len(left) and np.median(left) > session.check.release:
        notes.append(f"{recording.name}: {np.median(left):.0f} counts are left after the press: the zero drifts")
    return notes


def _zero_note(session: Session, hand: Hand) -> list[str]:
    if not len(session.rest_current):
        return []
    zero = session.rest_current.mean(0)
    worst = int(np.abs(zero).argmax())
    return [
        f"motors off, the currents read up to {1e3 * abs(zero[worst]):.0f} mA ({hand.joint_names[worst]}): that "
        "much of the offsets is the reading's zero error"
    ]
