"""Fits a calibration to recorded presses: forces and lever arms of the taxels, one robust line per joint and direction.

The torque that the simulation would report is computed from the same recording: the force of every taxel times its
lever arm at the measured joint angles (J^T f, with the kinematics of the simulation). The exact place of the contact on
the fingertip does not matter.

Because of friction a joint has two lines of current against torque. The motion of the joint decides which one applies:
while a finger presses harder, one of its joints may move back. Samples of resting joints are excluded, since their
friction can have any size.

Intervals count whole presses, and contain what no press shows: the error of the force's scale (`force_scale`), of the
lever arm, and of the motors' temperature.
"""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
from scipy.ndimage import binary_dilation

from dexsim.calibration.fit import calibrate
from dexsim.calibration.joint import MIN_SAMPLES, JointPress
from dexsim.calibration.maps import Calibration
from dexsim.calibration.press import MIN_LEVER
from dexsim.calibration.sensor import FingerFit
from dexsim.core.errors import CalibrationError
from dexsim.hand.kinematics import Hand, forward_kinematics, taxel_normals, taxel_positions
from dexsim_real.calibrate.force_per_torque import fit_force_per_torque
from dexsim_real.calibrate.force_scale import ACTIVE, force_scale
from dexsim_real.calibrate.press_procedure import LOADING, RELEASED, UNLOADING
from dexsim_real.calibrate.read import PressSession, Recording
from dexsim_real.calibrate.taxel_check import dead_taxels, fill_dead, taxel_names

_BLOCK = 0.25  # s averaged into one block, since counts are coarse
_LEVER = 0.002  # m, 95 %, between the contact and the centre of the taxels' forces
_HEAT = 0.02  # share, 95 %: magnets lose 0.1 % per K, and the windings' temperature is not known
_STILL = 0.25  # share of the usual speed below which a joint is at rest
_NOISE = 4.0  # standard deviations of the speed noise below which a joint is at rest
_TOP, _TOP_BLOCKS = 0.97, 4  # a current in this share of its maximum for this many blocks is at the motor's limit
_SHEAR = 0.1  # share of the force above which shear is noted
_TRUST = 0.3  # share of the torque above which shear, which the fit ignores, makes a press useless for a joint


METHOD = (
    f"the intervals contain the method's own error: {1e3 * _LEVER:g} mm of lever arm and {100 * _HEAT:g} % for warm "
    "motors; on emulated hands of known truth the torque constants came out about 2 % low, since presses warm "
    "the motors and the taxels put the contact too near the joint (thumb_bend 6 %)"
)
"""Note of every calibration."""


@dataclasses.dataclass(frozen=True)
class Blocks:
    """A press averaged over B blocks of a quarter of a second."""

    counts: np.ndarray  # [B, N] of the taxels that take part, 0 of the others
    current: np.ndarray  # [B, J] A
    position: np.ndarray  # [B, J] rad
    speed: np.ndarray  # [B, J] rad/s
    shear: np.ndarray  # [B, 2] counts, along the taxels' x and y
    run: np.ndarray  # [B] number of the loading or unloading phase
    press: np.ndarray  # [B] number of the press, up and down


@dataclasses.dataclass(frozen=True)
class Fit:
    """A calibration, the data that it was fitted to, and the comparison of the taxels with the gauge."""

    calibration: Calibration
    real: dict[str, JointPress]
    sim: dict[str, JointPress]
    source: dict[str, str]  # press that each joint was fitted to
    sensors: dict[str, FingerFit]  # by finger: counts as in a run against newtons


def fit(session: PressSession, hand: Hand, created: str | None = None) -> Fit:
    """Fit a calibration to all recorded presses.

    Args:
      session: the presses.
      hand: model of the hand.
      created: date for the calibration; None is now.

    Raises:
      CalibrationError: recordings are missing or unusable.
    """
    pressed = [r for r in session.recordings.values() if len(r.samples(LOADING, UNLOADING))]
    if not pressed:
        raise CalibrationError("no press was recorded; record again")
    pressed_blocks, faint = _felt(pressed, hand.taxel_grid)
    scale = force_scale(session, hand, [recording for recording, _ in pressed_blocks])
    notes = [*scale.notes, *faint]
    real, sim, source = {}, {}, {}
    reach: dict[str, float] = {}
    for recording, blocks in pressed_blocks:
        dead = dead_taxels(hand, blocks.counts, session.check.neighbours)
        blocks = dataclasses.replace(blocks, counts=fill_dead(hand, blocks.counts, dead))
        gain, offset = scale.newtons[recording.name]
        force = blocks.counts.sum(-1) * gain + offset
        torque = taxel_torque(hand, blocks.position, recording.finger, blocks.counts * gain)
        high = force > 0.5 * force.max()
        lever = torque[high].sum(0) / (force[high] - offset).sum()  # `torque` is still without the offset.
        slip = _shear_share(blocks) * _shear_lever(hand, blocks.position[high].mean(0), recording.finger, blocks.counts)
        # The force that the gauge adds to the taxels' sum acts at the same place.
        torque += offset * lever
        for joint in recording.joints:
            label = hand.joint_names[joint]
            if abs(lever[joint]) < max(MIN_LEVER, reach.get(label, 0.0)):
                continue
            if slip[joint] > _TRUST * abs(lever[joint]):
                notes.append(f"{label}: loaded by shear while the {recording.name} was pressed; press with the side")
                continue
            way = _direction(blocks.speed[:, joint], recording, joint) * int(np.sign(lever[joint]))
            way[_at_limit(blocks.current[:, joint], blocks.run)] = 0
            if max(np.sum(way > 0), np.sum(way < 0)) < MIN_SAMPLES:
                notes.append(
                    f"{label}: hardly moved while the {recording.name} was pressed, held by friction; press "
                    "on something softer, or more often"
                )
                continue
            reach[label], source[label] = abs(lever[joint]), recording.name
            # A force read too large makes the gain of the current too small, and leaves the lever arm.
            arm = float(np.hypot(_LEVER, slip[joint]) / abs(lever[joint]))
            known = float(np.hypot(scale.error[recording.name], _HEAT)), arm
            real[label], sim[label] = (
                JointPress(force, value[:, joint], way, blocks.press, error)
                for value, error in zip((blocks.current, torque), known, strict=True)
            )
        notes += _press_notes(session, hand, recording, blocks, dead)
    try:
        result = calibrate(
            hand,
            real,
            sim,
            force_per_count=scale.per_count,
            current_per_count=1e-3,
            missing="class",
            serial=session.serial,
            handedness=session.handedness,
            created=created,
        )
    except CalibrationError as error:
        why = [note for note in notes if "hardly moved" in note or "by shear" in note]
        raise CalibrationError("; ".join([str(error), *faint, *why])) from None
    notes += _zero_note(session, hand)
    result = dataclasses.replace(result, force_per_torque=fit_force_per_torque(hand, result, real, sim))
    # With a gauge the absolute scale is known.
    others = tuple(note for note in result.notes if not (scale.sensors and note.startswith("only the ratio")))
    return Fit(dataclasses.replace(result, notes=(*others, METHOD, *notes)), real, sim, source, scale.sensors)


def _felt(pressed: list[Recording], grid: tuple[int, int]) -> tuple[list[tuple[Recording, Blocks]], list[str]]:
    """The presses that the taxels felt, with their blocks, and a note on each other one: without force no lever arm."""
    pressed_blocks, notes = [], []
    for recording in pressed:
        blocks = make_blocks(recording, grid)
        if blocks.counts.sum() > 0:
            pressed_blocks.append((recording, blocks))
        else:
            notes.append(
                f"{recording.name}: left out: no taxel read {ACTIVE:g} counts or more; press on the taxels, or with "
                "more current (--press.current)"
            )
    return pressed_blocks, notes


def make_blocks(recording: Recording, grid: tuple[int, int]) -> Blocks:
    """Average a recording over blocks of time. An incomplete block at the end of a phase is dropped.

    Args:
      recording: of a press.
      grid: columns and rows of the taxels.

    Raises:
      CalibrationError: no phase is long enough.
    """
    size = max(round(_BLOCK * recording.rate), 1)
    phase = np.array(recording.phase)
    selected = [
        (phase[first], np.array([np.arange(size) + at for at in range(first, last - size + 1, size)]))
        for first, last in _runs(phase)
        if phase[first] in (LOADING, UNLOADING)
    ]
    selected = [(name, run) for name, run in selected if len(run) > 1]  # A single block has no speed.
    runs = [run for _, run in selected]
    if not runs:
        raise CalibrationError(
            f"{recording.name}: no press lasted {2 * _BLOCK:g} s; press more slowly (--press.seconds)"
        )
    time, angle = np.array(recording.time), np.array(recording.position)
    # Not across a reversal, where friction changes its sign.
    speed = np.concatenate([np.gradient(angle[run].mean(1), time[run].mean(1), axis=0) for run in runs])
    rows = np.concatenate(runs)
    position = angle[rows].mean(1)
    counts = np.array(recording.counts)[rows].mean(1)
    active = (counts.max(0) >= ACTIVE).reshape(grid)
    counts = counts * binary_dilation(active, np.ones((3, 3))).ravel()
    names = [UNLOADING] + [name for name, _ in selected]
    begins = [before == UNLOADING and name == LOADING for before, name in zip(names, names[1:], strict=False)]
    return Blocks(
        counts,
        np.array(recording.current)[rows].mean(1),
        position,
        speed,
        np.array(recording.shear)[rows].mean(1),
        np.repeat(np.arange(len(runs)), [len(run) for run in runs]),
        np.repeat(np.cumsum(begins), [len(run) for run in runs]),
    )


def taxel_torque(hand: Hand, position: np.ndarray, finger: int, force: np.ndarray) -> np.ndarray:
    """Joint torques [T, J] Nm that balance taxel forces [T, N] N at joint angles [T, J] rad: J^T f.

    All forces of a fingertip act along their mean normal: the skin is flat where it is pressed, and the force of a
    fingertip is the sum over its taxels, as in simulation.
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


def _shear_share(blocks: Blocks) -> float:
    """Shear over normal force by the taxels, at high force."""
    sums = blocks.counts.sum(-1)
    high = sums > 0.5 * sums.max()
    return float(np.median(np.linalg.norm(blocks.shear[high], axis=-1) / sums[high]))


def _shear_lever(hand: Hand, position: np.ndarray, finger: int, counts: np.ndarray) -> np.ndarray:
    """Largest lever arms [J] m of a force along the skin at the centre of the counts [B, N], at joint angles [J]."""
    at, weight = jnp.asarray(position, jnp.float32), jnp.asarray(counts.sum(0) / counts.sum(), jnp.float32)
    return np.asarray(_along_skin(hand, jnp.int32(finger), at, weight))


@functools.partial(jax.jit, static_argnames="hand")
def _along_skin(hand: Hand, finger: jax.Array, at: jax.Array, weight: jax.Array) -> jax.Array:
    normal = weight @ taxel_normals(hand, forward_kinematics(hand, at))[finger]
    way = jax.jacfwd(lambda q: weight @ taxel_positions(hand, forward_kinematics(hand, q))[finger])(at)
    along = (normal / jnp.linalg.norm(normal)) @ way
    return jnp.sqrt(jnp.maximum(jnp.sum(jnp.square(way), 0) - jnp.square(along), 0.0))


def _direction(speed: np.ndarray, recording: Recording, joint: int) -> np.ndarray:
    """Direction [B] of motion of a joint: 1, -1, or 0 at rest."""
    position = np.array(recording.position)[:, joint]
    jitter = np.median(np.abs(np.diff(position))) / 0.6745 / np.sqrt(2)
    noise = jitter / np.sqrt(max(_BLOCK * recording.rate, 1)) / (np.sqrt(2) * _BLOCK)
    usual = np.quantile(np.abs(speed), 0.75)
    return np.where(np.abs(speed) > max(_STILL * usual, _NOISE * noise), np.sign(speed), 0).astype(int)


def _at_limit(current: np.ndarray, run: np.ndarray) -> np.ndarray:
    """Mask [B] of blocks in which the motor is at its current limit: its current stays at the maximum of the press."""
    selected = np.zeros(len(current), bool)
    for number in np.unique(run):
        here = np.flatnonzero(run == number)
        size = np.abs(current[here])
        top = size > _TOP * size.max()
        selected[here] = top & (top.sum() >= _TOP_BLOCKS)
    return selected


def _runs(phase: np.ndarray) -> list[tuple[int, int]]:
    """First index and last + 1 of each run of equal phases."""
    cuts = np.flatnonzero(phase[1:] != phase[:-1]) + 1
    return list(zip([0, *cuts], [*cuts, len(phase)], strict=True))


# --- notes ------------------------------------------------------------------------------


def _press_notes(
    session: PressSession, hand: Hand, recording: Recording, blocks: Blocks, dead: np.ndarray
) -> list[str]:
    """Notes on dead taxels, shear, drift and interruption of one press."""
    notes, finger = [], hand.finger_names[recording.finger]
    if dead.any():
        notes.append(
            f"{finger}: dead: {taxel_names(hand, dead)} read nothing while their neighbours were pressed; the fit "
            "uses the mean of the neighbours, a run reads zero"
        )
    share = _shear_share(blocks)
    if share > _SHEAR:
        notes.append(
            f"{recording.name}: shear of {100 * share:.0f} % of the force by the taxels' x and y, which the fit "
            "ignores; press on something that slides, rolls or is soft"
        )
    left = np.array(recording.counts)[recording.samples(RELEASED)].sum(-1)
    if not recording.finished:
        notes.append(f"{recording.name}: was interrupted; the fit has what was pressed until then, press it again")
    elif np.median(left) > session.check.release:
        notes.append(f"{recording.name}: {np.median(left):.0f} counts remain after the press: the zero drifts")
    return notes


def _zero_note(session: PressSession, hand: Hand) -> list[str]:
    if not len(session.rest_current):
        return []
    zero = session.rest_current.mean(0)
    worst = int(np.abs(zero).argmax())
    return [
        f"with the motors off the currents read up to {1e3 * abs(zero[worst]):.0f} mA ({hand.joint_names[worst]}): "
        "this zero error of the sensor is part of the offsets"
    ]
