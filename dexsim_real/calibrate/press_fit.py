"""Fits a calibration to recorded presses: forces and lever arms of the taxels, one robust line per joint and direction.

The torque that the simulation would report is computed from the same recording: the force of every taxel times its
lever arm at the measured joint angles (J^T f, with the kinematics of the simulation). The exact place of the contact on
the fingertip does not matter.

Because of friction a joint has two lines of current against torque. The motion of the joint decides which one applies:
while a finger presses harder, one of its joints may move back. Samples of resting joints are excluded, since their
friction can have any size.

Intervals count whole presses, and contain what no press shows: the error of the force's scale, of the lever arm, and of
the motors' temperature.
"""

import dataclasses
import functools
from collections.abc import Mapping
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.ndimage import binary_dilation

from dexsim.calibration.fit import calibrate
from dexsim.calibration.joint import MIN_SAMPLES, JointPress
from dexsim.calibration.line import fit_line
from dexsim.calibration.maps import Calibration, Side
from dexsim.calibration.press import MIN_LEVER
from dexsim.core.errors import CalibrationError
from dexsim.hand.description import Hand
from dexsim.hand.kinematics import forward_kinematics, taxel_normals, taxel_positions
from dexsim_real.calibrate.procedure import LOADING, RELEASED, TOUCHED, UNLOADING
from dexsim_real.calibrate.read import Recording, Source
from dexsim_real.sensors.taxels import around, taxel_names

_BLOCK = 0.25  # s averaged into one block, since counts are coarse
_LEVER = 0.002  # m, 95 %, between the contact and the centre of the taxels' forces
_HEAT = 0.02  # share, 95 %: magnets lose 0.1 % per K, and the windings' temperature is not known
_STILL = 0.25  # share of the usual speed below which a joint is at rest
_NOISE = 4.0  # standard deviations of the speed noise below which a joint is at rest
_TOP, _TOP_BLOCKS = 0.97, 4  # a current in this share of its maximum for this many blocks is at the motor's limit
_SHEAR = 0.1  # share of the force above which shear is noted
_TRUST = 0.3  # share of the torque above which shear, which the fit ignores, makes a press useless for a joint

_ACTIVE = 2.0  # counts above which a taxel takes part
_NEIGHBOURS = 3.0  # counts, mean of a taxel's neighbours above which it must read something
_READINGS = 8  # gauge readings that a fingertip needs
# Shares of the scale, 95 %, that no reading shows:
_GAUGE = 0.03  # of the gauge itself, and of how straight it stands under a fingertip that turns by up to 0.25 rad
_PLACE = 0.08  # between places on a fingertip, whose taxels differ
_NOMINAL = 0.25  # of the taxels without a gauge
_OTHERS = 0.35  # of a fingertip without a gauge from those with one

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


class JointFit(NamedTuple):
    """What a press says of a joint."""

    press: str
    lever: float  # m
    real: JointPress
    sim: JointPress


@dataclasses.dataclass(frozen=True)
class ForceScale:
    """Newtons of taxel counts."""

    per_count: np.ndarray  # [F] N, for a run
    newtons: dict[str, tuple[float, float]]  # by press: gain and offset, newtons = gain * counts + offset
    error: dict[str, float]  # by press: share of the gain, 95 %
    gauged: bool  # whether a finger had gauge readings
    notes: tuple[str, ...]


@dataclasses.dataclass(frozen=True)
class Fit:
    """A calibration, and the data that it was fitted to."""

    calibration: Calibration
    real: dict[str, JointPress]
    sim: dict[str, JointPress]
    source: dict[str, str]  # press that each joint was fitted to


def fit(source: Source, recordings: Mapping[str, Recording], hand: Hand, created: str | None = None) -> Fit:
    """Fit a calibration to all recorded presses; `created` is its date, by default now.

    Raises:
      CalibrationError: recordings are missing or unusable.
    """
    blocks, notes = {}, list[str]()
    for name, recording in recordings.items():
        if not len(recording.samples(LOADING, UNLOADING)):
            continue
        part = make_blocks(recording, hand.taxel_grid)
        if part.counts.sum() > 0:
            blocks[name] = part
        else:  # Without force no lever arm.
            notes.append(f"{name}: left out: no taxel read 2 counts or more; press on the taxels, or with more current")
    if not blocks:
        raise CalibrationError("; ".join(["no press was recorded; record again", *notes]))
    scale = force_scale(source, hand, [recordings[name] for name in blocks])
    best = dict[str, JointFit]()  # by joint: of the press with the longest lever arm
    for name, part in blocks.items():
        for label, joint_fit in _press(hand, recordings[name], part, scale, notes).items():
            if label not in best or joint_fit.lever > best[label].lever:
                best[label] = joint_fit
    real, sim = {j: f.real for j, f in best.items()}, {j: f.sim for j, f in best.items()}
    identity = source.identity
    try:
        calibration = calibrate(
            hand,
            real,
            sim,
            force_per_count=scale.per_count,
            serial=identity.serial_number,
            handedness=identity.handedness,
            created=created,
        )
    except CalibrationError as error:
        raise CalibrationError("; ".join([str(error), *notes])) from None
    # With a gauge the absolute scale is known.
    own = [note for note in calibration.notes if not (scale.gauged and note.startswith("only the ratio"))]
    calibration = dataclasses.replace(
        calibration,
        force_per_torque=_force_per_torque(hand, calibration, real),
        notes=(*own, METHOD, *scale.notes, *notes),
    )
    return Fit(calibration, real, sim, {label: joint_fit.press for label, joint_fit in best.items()})


def _press(hand: Hand, recording: Recording, part: Blocks, scale: ForceScale, notes: list[str]) -> dict[str, JointFit]:
    """What one press says of each of its joints; of what it does not, it adds notes."""
    name, (gain, offset) = recording.name, scale.newtons[recording.name]
    dead = dead_taxels(hand, part.counts)
    counts = fill_dead(hand, part.counts, dead)
    force = counts.sum(-1) * gain + offset
    torque = taxel_torque(hand, part.position, recording.finger, counts * gain)
    high = force > 0.5 * force.max()
    lever = torque[high].sum(0) / (force[high] - offset).sum()  # `torque` is still without the offset.
    # Shear over normal force by the taxels, and the torque by it over the force.
    sums = counts.sum(-1)
    firm = sums > 0.5 * sums.max()
    shear = float(np.median(np.linalg.norm(part.shear[firm], axis=-1) / sums[firm]))
    posture, weight = (v.astype(np.float32) for v in (part.position[high].mean(0), counts.sum(0) / counts.sum()))
    slip = shear * np.asarray(_along_skin(hand, np.int32(recording.finger), posture, weight))
    # The force that the gauge adds to the taxels' sum acts at the same place.
    torque += offset * lever
    fits = {}
    for joint in recording.joints:
        label, arm = hand.joint_names[joint], float(abs(lever[joint]))
        if arm < MIN_LEVER:
            continue
        if slip[joint] > _TRUST * arm:
            notes.append(f"{label}: loaded by shear while the {name} was pressed; press with the side")
            continue
        way = _direction(part.speed[:, joint], recording, joint) * int(np.sign(lever[joint]))
        way[_at_limit(part.current[:, joint], part.run)] = 0
        if max(np.sum(way > 0), np.sum(way < 0)) < MIN_SAMPLES:
            notes.append(
                f"{label}: hardly moved while the {name} was pressed, held by friction; press on something softer, "
                "or more often"
            )
            continue
        # A force read too large makes the gain of the current too small, and leaves the lever arm.
        known, placed = float(np.hypot(scale.error[name], _HEAT)), float(np.hypot(_LEVER, slip[joint]) / arm)
        real = JointPress(force, part.current[:, joint], way, part.press, known)
        fits[label] = JointFit(name, arm, real, JointPress(force, torque[:, joint], way, part.press, placed))
    notes += _press_notes(hand, recording, dead, shear)
    return fits


def make_blocks(recording: Recording, grid: tuple[int, int]) -> Blocks:
    """Average a recording over blocks of time, but for an incomplete block at the end of a phase.

    Raises:
      CalibrationError: no phase is long enough.
    """
    size, phase = max(round(_BLOCK * recording.rate), 1), np.array(recording.phase)
    cuts = [0, *np.flatnonzero(phase[1:] != phase[:-1]) + 1, len(phase)]
    names, runs = [], []
    for first, last in zip(cuts[:-1], cuts[1:], strict=True):
        starts = range(first, last - size + 1, size)
        if phase[first] in (LOADING, UNLOADING) and len(starts) > 1:  # A single block has no speed.
            names.append(phase[first])
            runs.append(np.array([np.arange(size) + at for at in starts]))
    if not runs:
        raise CalibrationError(f"{recording.name}: no press lasted {2 * _BLOCK:g} s; raise --press.seconds")
    time, angle = np.array(recording.time), np.array(recording.position)
    # Not across a reversal, where friction changes its sign.
    speed = np.concatenate([np.gradient(angle[run].mean(1), time[run].mean(1), axis=0) for run in runs])
    begins = [before == UNLOADING and name == LOADING for before, name in zip([UNLOADING, *names], names, strict=False)]
    rows, lengths = np.concatenate(runs), [len(run) for run in runs]
    counts = np.array(recording.counts)[rows].mean(1)
    return Blocks(
        counts * active_taxels(counts, grid),
        np.array(recording.current)[rows].mean(1),
        angle[rows].mean(1),
        speed,
        np.array(recording.shear)[rows].mean(1),
        np.repeat(np.arange(len(runs)), lengths),
        np.repeat(np.cumsum(begins), lengths),
    )


def taxel_torque(hand: Hand, position: np.ndarray, finger: int, force: np.ndarray) -> np.ndarray:
    """Joint torques [T, J] Nm that balance taxel forces [T, N] N at joint angles [T, J] rad: J^T f.

    All forces of a fingertip act along their mean normal: the skin is flat where it is pressed, and the force of a
    fingertip is the sum over its taxels, as in simulation.
    """
    samples = zip(position.astype(np.float32), force.astype(np.float32), strict=True)
    return np.array([_torque(hand, np.int32(finger), at, push) for at, push in samples], float)


@functools.partial(jax.jit, static_argnames="hand")
def _torque(hand: Hand, finger: jax.Array, at: jax.Array, force: jax.Array) -> jax.Array:
    mean = force @ taxel_normals(hand, forward_kinematics(hand, at))[finger]
    normal = mean / jnp.maximum(jnp.linalg.norm(mean), 1e-6)
    return jax.grad(lambda q: force @ taxel_positions(hand, forward_kinematics(hand, q))[finger] @ normal)(at)


@functools.partial(jax.jit, static_argnames="hand")
def _along_skin(hand: Hand, finger: jax.Array, at: jax.Array, weight: jax.Array) -> jax.Array:
    """Largest lever arms [J] m of a force along the skin at the weighted taxels, at joint angles [J]."""
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
        size = np.abs(current[run == number])
        top = size > _TOP * size.max()
        selected[run == number] = top & (top.sum() >= _TOP_BLOCKS)
    return selected


def _force_per_torque(hand: Hand, calibration: Calibration, real: Mapping[str, JointPress]) -> np.ndarray:
    """Force of a fingertip over the torque of its finger's root joint, as a run reads that torque.

    A run does not know whether a finger closes or opens: the value is half way between the lines of both directions,
    and the interval reaches to them, and by what the presses and the lever arm leave open beyond. The scale of the
    force cancels out. What weight and friction add to the torque is in the lines' offsets.

    Returns:
      [3, F] N/Nm: value, low, high of the 95 % interval; 0 where nothing pressed.
    """
    ratio = np.zeros((3, hand.num_fingers))
    per_ampere = np.mean(calibration.sim.gain, 0) / np.mean(calibration.real.gain, 0)
    gains = np.abs(calibration.real.gain * per_ampere)  # [2, J] Nm/N
    shares = [np.max((side.gain_high - side.gain_low) / 2 / np.abs(side.gain), 0) for side in _sides(calibration)]
    for finger, joint in enumerate(hand.root_joint):
        name, gain = hand.joint_names[joint], gains[:, joint]
        if name not in real:
            continue
        presses = np.sqrt(max(shares[0][joint] ** 2 - real[name].gain_error ** 2, 0.0))
        share = np.hypot(presses, shares[1][joint])
        middle, half = gain.mean(), float(np.hypot(share * gain.mean(), np.ptp(gain) / 2))
        if half < middle:
            ratio[:, finger] = 1.0 / np.array([middle, middle + half, middle - half])
    return ratio


def _sides(calibration: Calibration) -> tuple[Side, Side]:
    return calibration.real, calibration.sim


def _press_notes(hand: Hand, recording: Recording, dead: np.ndarray, shear: float) -> list[str]:
    """Notes on dead taxels, shear, drift and interruption of one press."""
    notes = []
    if dead.any():
        notes.append(
            f"{hand.finger_names[recording.finger]}: dead: {taxel_names(hand, dead)} read nothing while their "
            "neighbours were pressed; the fit uses the mean of the neighbours, a run reads zero"
        )
    if shear > _SHEAR:
        notes.append(
            f"{recording.name}: shear of {100 * shear:.0f} % of the force by the taxels' x and y, which the fit "
            "ignores; press on something that slides, rolls or is soft"
        )
    left = np.array(recording.counts)[recording.samples(RELEASED)].sum(-1)
    if not recording.finished:
        notes.append(f"{recording.name}: was interrupted; the fit has what was pressed until then, press it again")
    elif np.median(left) > TOUCHED:
        notes.append(f"{recording.name}: {np.median(left):.0f} counts remain after the press: the zero drifts")
    return notes


def torque_constants(calibration: Calibration) -> np.ndarray:
    """Torque constants [2, J] Nm/A at the joint, loading and unloading: the ratio of the gains."""
    return np.asarray(calibration.sim.gain) / np.asarray(calibration.real.gain)


def torque_constant_intervals(calibration: Calibration) -> np.ndarray:
    """95 % intervals [2, J, 2] Nm/A of `torque_constants`; the widths of both sides are added in quadrature."""
    value = torque_constants(calibration)
    real, sim = (np.asarray((side.gain_high - side.gain_low) / 2 / np.abs(side.gain)) for side in _sides(calibration))
    share = np.hypot(real, sim)
    return value[..., None] + (np.abs(value) * share)[..., None] * np.array([-1.0, 1.0])


# --- scale of the force --------------------------------------------------------------------------


def force_scale(source: Source, hand: Hand, pressed: list[Recording]) -> ForceScale:
    """Compare the taxels with the gauge. A press without readings uses those of the finger's other press.

    Raises:
      CalibrationError: the readings do not rise with the force.
    """
    own: dict[int, float] = {}  # by finger: N per count
    newtons, error, notes = {}, {}, []
    for press in sorted(pressed, key=lambda r: not r.name.endswith("pad")):
        levels = {level: press.samples(level) for level in press.gauge if len(press.samples(level))}
        if len(levels) < _READINGS:
            if levels:
                notes.append(f"{press.name}: {len(levels)} gauge readings are ignored, {_READINGS} are needed")
            continue
        counts = np.array([np.array(press.counts)[rows].mean(0) for rows in levels.values()])
        counts = counts * active_taxels(counts, hand.taxel_grid)
        # The fit applies this gain to sums with the dead taxels filled in.
        counts = fill_dead(hand, counts, dead_taxels(hand, counts))
        gauge = np.array([press.gauge[level] for level in levels])
        if np.ptp(gauge) <= 0:
            raise CalibrationError(f"{press.name}, gauge: all readings are {gauge[0]:g} N")
        line = fit_line(gauge, np.maximum(counts.sum(-1), 0.0), np.arange(len(gauge)))
        if line.gain_interval[0] <= 0:
            raise CalibrationError(f"{press.name}, gauge: counts do not follow its readings ({line.gain:.3g} per N)")
        newtons[press.name] = 1.0 / line.gain, -line.offset / line.gain
        error[press.name] = float(np.hypot(line.gain_share, _GAUGE))
        low, high = line.widened(float(np.hypot(_GAUGE, _PLACE))).gain_interval
        notes.append(
            f"{press.name}: {line.gain:.3g} [{low:.3g}, {high:.3g}] counts per newton by the gauge "
            f"({line.samples} readings), {line.offset:.1f} counts at zero force"
        )
        own.setdefault(press.finger, 1.0 / line.gain)
    others = float(np.mean(list(own.values()))) if own else source.hardware.force_per_count
    per_count = np.array([own.get(finger, others) for finger in range(hand.num_fingers)])
    if not own:
        notes.append(f"no gauge: the taxels' scale is the nominal one, which may be {100 * _NOMINAL:.0f} % off")
    for finger, name in enumerate(hand.finger_names):
        if own and finger not in own:
            notes.append(
                f"{name}: not compared with the gauge; has the mean of the others (up to {100 * _OTHERS:.0f} % off)"
            )
    for press in pressed:
        newtons.setdefault(press.name, (float(per_count[press.finger]), 0.0))
        error.setdefault(press.name, _PLACE if press.finger in own else _OTHERS if own else _NOMINAL)
    return ForceScale(per_count, newtons, error, bool(own), tuple(notes))


def active_taxels(counts: np.ndarray, grid: tuple[int, int]) -> np.ndarray:
    """Mask [N] of the taxels that take part in counts [T, N] of a press, and of those beside them."""
    active = (counts.max(0) >= _ACTIVE).reshape(grid)
    return binary_dilation(active, np.ones((3, 3))).ravel()


def dead_taxels(hand: Hand, counts: np.ndarray) -> np.ndarray:
    """Mask [N] of taxels that read nothing in counts [T, N] of a press, although their neighbours did."""
    largest = counts.max(0)
    beside = np.where(around(hand, np.ones((1, hand.num_taxels))) > 0, around(hand, largest[None]), np.nan)[:, 0]
    # At least half of the neighbours must read, so that taxels at the edge of a press do not count as dead.
    pressed = (np.nanmean(beside, 0) >= _NEIGHBOURS) & (np.nanmedian(beside, 0) > 0.25 * _NEIGHBOURS)
    return (largest <= 0) & pressed


def fill_dead(hand: Hand, counts: np.ndarray, dead: np.ndarray) -> np.ndarray:
    """Counts [T, N] in which a dead taxel has the mean of its working neighbours."""
    working = (~dead).astype(float)
    near = around(hand, working[None])[:, 0]  # [8, N]
    mean = np.sum(around(hand, counts * working), 0) / np.maximum(near.sum(0), 1)
    return np.where(dead, mean, counts)
