"""From motor current to the joint torque of the simulation, without torque sensors.

Each fingertip is pressed with a varying force, on the hand and in simulation. Both relations are
lines, current = g_real F + o_real and torque = g_sim F + o_sim, so the force drops out:

    torque = g_sim (current - o_real) / g_real + o_sim

(paper, section Current-torque Calibration). The paper aligns the two by their maxima; that is the
same line when both sessions end at the same force and have no offset.
`dexsim.calibration.fit` makes a `Calibration` from recordings; this module keeps and applies it.

Shapes: J joints, F fingers, N taxels a finger; a leading 2 is (loading, unloading).
"""

import dataclasses
import json
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from dexsim.core.files import read_toml, write_atomic
from dexsim.core.pytree import Array, align, pytree_dataclass, static
from dexsim.errors import CalibrationError
from dexsim.hand.description import Hand

FORMAT = "dexsim calibration"
VERSION = 4


@pytree_dataclass
class Side:
    """Lines value = gain force + offset of all joints: of the hand (value A) or of the simulation (value Nm). An error
    is half of a 95 % interval."""

    gain: Array  # [2, J] value/N
    offset: Array  # [2, J] value
    gain_error: Array  # [2, J] value/N
    offset_error: Array  # [2, J] value
    r_squared: Array  # [2, J]
    friction: Array  # [J] value, half the gap between the two lines; NaN with one
    value_max: Array  # [J] largest |value| recorded
    force_max: Array  # [J] N, largest force recorded


@pytree_dataclass
class Calibration:
    """One hand's current-to-torque and count-to-newton maps. A pytree of NumPy arrays."""

    real: Side  # A against N
    sim: Side  # Nm against N
    torque_scale: Array  # [J] Nm that read as 1: the hand's torque limits, as in `Env`
    force_per_count: Array  # [F] N
    force_per_torque: Array  # [3, F] N/Nm at the root joint: value, 95 % low, high; 0: not pressed
    hand: str = static()
    joint_names: tuple[str, ...] = static()
    finger_names: tuple[str, ...] = static()
    serial: str = static(default="")  # of the hand, as it told it; empty if it did not
    handedness: str = static(default="")  # likewise
    created: str = static(default="")
    notes: tuple[str, ...] = static(default=())


def blank_calibration(hand: Hand) -> Calibration:
    """A template of a hand's calibration: every measured number is NaN, which `load_calibration` refuses."""
    lines, joint = np.full((2, hand.num_joints), np.nan), np.full(hand.num_joints, np.nan)
    side = Side(lines, lines, lines, lines, lines, joint, joint, joint)
    return Calibration(
        side,
        side,
        np.round(np.asarray(hand.torque_limit, float), 6),
        np.full(hand.num_fingers, np.nan),
        np.zeros((3, hand.num_fingers)),
        hand=hand.name,
        joint_names=hand.joint_names,
        finger_names=hand.finger_names,
        notes=("a template: fill it with dexsim calibrate",),
    )


# --- run time -------------------------------------------------------------------------------


def joint_torque(calibration: Calibration, current: Array) -> jax.Array:
    """Joint torques [..., J] Nm, in the simulation's sense, from motor currents [..., J] A with the hand's own sign.

    By the lines half way between loading and unloading: a run does not know which way friction acts. They are wrong by
    at most the friction band, `calibration.real.friction`.
    """
    gain, offset, sim_gain, sim_offset = (
        align(jnp.mean(line, 0), current)
        for side in (calibration.real, calibration.sim)
        for line in (side.gain, side.offset)
    )
    force = (current - offset) / gain
    return sim_gain * force + sim_offset


def normalised_torque(calibration: Calibration, current: jax.Array) -> jax.Array:
    """`joint_torque` over the joints' torque limits: `Readings.joint_torque`. Not clipped."""
    torque = joint_torque(calibration, current)
    return torque / align(jnp.asarray(calibration.torque_scale), torque)


def taxel_force(calibration: Calibration, counts: jax.Array) -> jax.Array:
    """Taxel forces [..., F, N] N from counts [..., F, N] after taring; negative ones read 0."""
    scale = jnp.asarray(calibration.force_per_count)[..., None]
    counts = jnp.asarray(counts, scale.dtype)
    return jnp.maximum(counts * align(scale, counts), 0.0)


def torque_constants(calibration: Calibration) -> tuple[np.ndarray, np.ndarray]:
    """Torque constants [2, J] Nm/A at the joint, loading and unloading, and half of their 95 % intervals [2, J]."""
    real, sim = calibration.real, calibration.sim
    constants = np.asarray(sim.gain) / np.asarray(real.gain)
    share = np.hypot(*(np.asarray(side.gain_error) / np.abs(side.gain) for side in (real, sim)))
    return constants, np.abs(constants) * share


def calibrated_hand(hand: Hand, calibration: Calibration | None) -> Hand:
    """The hand with the `force_per_torque` of its calibration, where fingertips were pressed.

    The first finger, the thumb, keeps its own: in a grasp its root joint also bears what lies on its links, which a
    press does not show.
    """
    if calibration is None or not np.any(calibration.force_per_torque):
        return hand
    calibrated = np.array(calibration.force_per_torque, np.float32)[0]
    calibrated[0] = 0.0
    return dataclasses.replace(hand, force_per_torque=np.where(calibrated > 0, calibrated, hand.force_per_torque))


# --- file -----------------------------------------------------------------------------------

_WORDS = ("hand", "serial", "handedness", "created", "joint_names", "finger_names", "notes")
_UNITS = {
    "torque_scale": "Nm, of each joint",
    "force_per_count": "N, of each finger",
    "force_per_torque": "N/Nm, of each finger: value, 95 % low and high; 0: not pressed",
}
_SIDES = """
# Lines value = gain * force + offset of all joints, loading and then unloading: value in A on the hand (real), in Nm in
# simulation (sim), force in N. Errors are half of the 95 % intervals."""


def save_calibration(path: str | Path, calibration: Calibration) -> None:
    """Write a calibration as TOML; a crash leaves the old file or the new one, never half of it. Raises OSError: it
    cannot be written."""
    lines = [f'format = "{FORMAT}"', f"version = {VERSION}"]
    lines += [f"{name} = {json.dumps(getattr(calibration, name), ensure_ascii=False)}" for name in _WORDS]
    lines += [f"{name} = {_text(getattr(calibration, name))}  # {unit}" for name, unit in _UNITS.items()]
    lines.append(_SIDES)
    for name, side in (("real", calibration.real), ("sim", calibration.sim)):
        lines += [f"[{name}]", *(f"{field} = {_text(values)}" for field, values in vars(side).items())]
    write_atomic(Path(path), ["\n".join([*lines, ""]).encode()])


def _text(values: Any) -> str:
    return str(np.asarray(values, float).tolist())  # Unlike JSON's, Python's nan and inf are TOML's.


def load_calibration(path: str | Path, hand: Hand) -> Calibration:
    """Read the calibration of this hand, written by `save_calibration`.

    Raises:
      CalibrationError: missing, cut, not a calibration, of another version or hand, or with a number that no hand
        gives.
    """
    try:
        calibration = _calibration(read_toml(Path(path)), hand)
    except OSError as error:
        raise CalibrationError(f"{path}: cannot be read ({error.strerror})") from None
    except (ValueError, KeyError, TypeError, OverflowError) as error:
        what = " ".join(f"{type(error).__name__}: {error}".split())
        raise CalibrationError(f"{path}: damaged, cut off, or not a calibration of this hand ({what:.130})") from None
    check_plausible(path, calibration, hand)
    return calibration


def _calibration(table: dict[str, Any], hand: Hand) -> Calibration:
    """The content of a file; whatever is not as `save_calibration` writes it raises."""
    own: dict[str, Any] = {"hand": hand.name, "joint_names": hand.joint_names, "finger_names": hand.finger_names}
    for name, expected in ({"format": FORMAT, "version": VERSION} | own).items():
        value = table.pop(name)
        if (tuple(value) if isinstance(value, list) else value) != expected:
            raise ValueError(f"expected {name} {expected!r:.40}, got {value!r:.40}")
    words: dict[str, Any] = {name: str(table.pop(name)) for name in ("serial", "handedness", "created")}
    notes = tuple(map(str, table.pop("notes")))
    for side in ("real", "sim"):
        table[side] = Side(**{name: np.array(values, float) for name, values in dict(table[side]).items()})
    numbers: dict[str, Any] = {name: np.array(table.pop(name), float) for name in _UNITS}
    calibration = Calibration(**table, **numbers, **own, **words, notes=notes)
    blank = jax.tree.leaves(blank_calibration(hand))
    for (field, values), template in zip(jax.tree_util.tree_leaves_with_path(calibration), blank, strict=True):
        if values.shape != template.shape:
            raise ValueError(f"{jax.tree_util.keystr(field)} must hold {' x '.join(map(str, template.shape))} numbers")
    return calibration


# --- what no hand gives -----------------------------------------------------------------------


@np.errstate(all="ignore")  # What overflows is out of its range.
def check_plausible(where: object, calibration: Calibration, hand: Hand) -> None:
    """Check every number that a run uses: a wrong torque from a file would drive the motors wrongly.

    The ranges are far from the values of a good hand: a wrong unit is found, an unusual hand is no error.

    Raises:
      CalibrationError: names the joint or finger, the quantity, its value and its range.
    """
    joints, fingers = calibration.joint_names, calibration.finger_names
    real, sim, scale = calibration.real, calibration.sim, np.asarray(calibration.torque_scale)
    # `joint_torque` takes the middle of the lines; of the hand's both are checked, so their mean is as good.
    per_ampere = np.mean(sim.gain, 0) / np.asarray(real.gain)  # [2, J] Nm/A
    idle = np.mean(sim.offset, 0) - per_ampere * np.asarray(real.offset)  # [2, J] Nm
    force = np.asarray(calibration.force_per_torque)[0]
    ranges: tuple[tuple[tuple[str, ...], str, Any, float, float, str], ...] = (
        # The maker's is 0.1 N. Below 1 mN all 120 taxels, saturated at 255 counts, read 31 N together: less than the
        # 37 N of 1.1 Nm at a lever of 0.03 m. Above 1 N one saturated taxel reads three times what the hand gives.
        (fingers, "force_per_count", calibration.force_per_count, 1e-3, 1.0, "N"),
        # A fingertip is 0.3 m to 1 mm from its root joint's axis; 0: not pressed.
        (fingers, "force_per_torque", np.where(force == 0, 10.0, force), 1 / 0.3, 1e3, "N/Nm"),
        (joints, "torque_scale", scale, 0.01, 20.0, "Nm"),  # finger motors stall at 0.4 and 1.1 Nm
        (joints, "torque_scale over the hand's limit", scale / hand.torque_limit, 0.99, 1.01, ""),
        (joints, "magnitude of sim.gain", np.abs(sim.gain), 1e-4, 0.3, "Nm/N"),  # a finger is 0.1 m long
        (joints, "sim.gain unloading over loading", sim.gain[1] / sim.gain[0], 1e-4, 1e4, ""),
        (joints, "real.gain unloading over loading", real.gain[1] / real.gain[0], 1e-4, 1e4, ""),
        # A stalled XHand joint draws 1.5 A; 16 bits of mA end at 33 A.
        (joints, "current of the full torque by real.gain", scale / np.abs(per_ampere), 0.03, 33.0, "A"),
        (joints, "share of the full torque without current by real.offset", np.abs(idle) / scale, 0.0, 1.0, ""),
    )
    for names, quantity, values, low, high, unit in ranges:
        values = np.asarray(values)
        bad = np.argwhere(~((values >= low) & (values <= high)))  # also NaN
        if len(bad):
            outlier = f"{names[bad[0][-1]]}: {quantity} = {values[tuple(bad[0])]:.4g}"
            raise CalibrationError(f"{where}: {outlier}: must be between {low:.4g} and {high:.4g} {unit}".rstrip())
