"""From motor current to the joint torque of the simulation, without torque sensors.

Each fingertip is pressed with a varying force, on the hand and in simulation. Both relations are
lines, current = g_real F + o_real and torque = g_sim F + o_sim, so the force drops out:

    torque = g_sim (current - o_real) / g_real + o_sim

(paper, section Current-torque Calibration). The paper aligns the two by their maxima; that is the
same line when both sessions end at the same force, and `alignment` says how far they are apart.
`dexsim.calibration.fit` makes a `Calibration` from recordings; this module keeps and applies it.

Shapes: J joints, F fingers, N taxels a finger; a leading 2 is (loading, unloading).
"""

import dataclasses
import math
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from dexsim.core.errors import CalibrationError
from dexsim.core.files import read_toml, write_whole
from dexsim.core.pytree import Array, align, pytree_dataclass, static
from dexsim.hand.kinematics import Hand

FORMAT = "dexsim calibration"
VERSION = 1


@pytree_dataclass
class Side:
    """Lines value = gain force + offset of all joints: of the hand (value A) or of the
    simulation (value Nm). Intervals are of 95 %."""

    gain: Array  # [2, J] value/N
    gain_low: Array  # [2, J]
    gain_high: Array  # [2, J]
    offset: Array  # [2, J] value
    offset_low: Array  # [2, J]
    offset_high: Array  # [2, J]
    noise: Array  # [2, J] value, robust standard deviation about the line
    r_squared: Array  # [2, J]
    condition: Array  # [2, J]
    samples: Array  # [2, J]; 0 for a line taken from the joint's class
    outliers: Array  # [2, J]
    friction: Array  # [J] value, half the gap between the two lines; NaN where one is missing
    value_max: Array  # [J] largest |value| recorded
    force_max: Array  # [J] N, largest force recorded

    def middle(self) -> tuple[jax.Array, jax.Array]:
        """Gain [J] and offset [J] of the line half way between loading and unloading."""
        return jnp.mean(self.gain, 0), jnp.mean(self.offset, 0)


@pytree_dataclass
class Calibration:
    """One hand's current-to-torque and count-to-newton maps. A pytree of NumPy arrays."""

    real: Side  # A against N
    sim: Side  # Nm against N
    torque_scale: Array  # [J] Nm that read as 1: the hand's torque limits, as in `Env`
    force_per_count: Array  # [F] N
    hand: str = static()
    joint_names: tuple[str, ...] = static()
    finger_names: tuple[str, ...] = static()
    current_per_count: float = static(default=0.001)  # A; the XHand reports mA
    serial: str = static(default="")  # of the hand, as it told it; empty if it did not
    handedness: str = static(default="")  # likewise
    created: str = static(default="")
    notes: tuple[str, ...] = static(default=())
    force_per_torque: Array | None = None  # [3, F] N/Nm at the root joint: value, 95 % low, high; 0: not pressed


# --- run time -------------------------------------------------------------------------------


def current_from_counts(calibration: Calibration, counts: jax.Array) -> jax.Array:
    """Currents [J] A from what the hand reports [J] counts."""
    return jnp.asarray(counts, jnp.float32) * calibration.current_per_count


def joint_torque(calibration: Calibration, current: Array, direction: jax.Array | float = 0.0) -> jax.Array:
    """Joint torques [..., J] Nm, in the simulation's sense, from motor currents [..., J] A.

    Args:
      calibration: closed over or passed through jit.
      current: A, with the hand's own sign.
      direction: [..., J] or scalar: 1 where the joint is known to press on (loading line), -1
        where it yields (unloading line), 0 where unknown: the line half way between, wrong by at
        most the friction band `calibration.real.friction`.
    """
    real = calibration.real
    middle_gain, middle_offset = real.middle()

    def pick(lines: Array, middle: jax.Array) -> jax.Array:
        loading, unloading, between = (align(line, current) for line in (*jnp.asarray(lines), middle))
        return jnp.where(direction > 0, loading, jnp.where(direction < 0, unloading, between))

    force = (current - pick(real.offset, middle_offset)) / pick(real.gain, middle_gain)
    gain, offset = calibration.sim.middle()
    return align(gain, force) * force + align(offset, force)


def normalised_torque(calibration: Calibration, current: jax.Array, direction: jax.Array | float = 0.0) -> jax.Array:
    """`joint_torque` over the joints' torque limits: `Readings.joint_torque`. Not clipped."""
    torque = joint_torque(calibration, current, direction)
    return torque / align(jnp.asarray(calibration.torque_scale), torque)


def taxel_force(calibration: Calibration, counts: jax.Array) -> jax.Array:
    """Taxel forces [..., F, N] N from counts [..., F, N] after taring; negative ones read 0."""
    scale = jnp.asarray(calibration.force_per_count)[..., None]
    counts = jnp.asarray(counts, scale.dtype)
    return jnp.maximum(counts * align(scale, counts), 0.0)


def normalise(side: Side, joint: int, force: np.ndarray, value: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Force and |value| of one joint's recording over their maxima: the paper's [0, 1] axes."""
    return (
        np.asarray(force) / float(side.force_max[joint]),
        np.asarray(value) * np.sign(float(side.gain[0, joint])) / float(side.value_max[joint]),
    )


def alignment(calibration: Calibration) -> np.ndarray:
    """Slope [J] of the hand's normalised line over that of the simulation's.

    1 where aligning by the maxima, as in the paper, gives the same torque as the lines do.
    """
    slopes = [
        np.abs(np.mean(side.gain, 0)) * side.force_max / side.value_max for side in (calibration.real, calibration.sim)
    ]
    return np.asarray(slopes[0] / slopes[1])


def calibrated_hand(hand: Hand, calibration: Calibration | None) -> Hand:
    """The hand with the `force_per_torque` of its calibration, where fingertips were pressed.

    The first finger, the thumb, keeps its own: in a grasp its root joint also bears what lies on its links, which a
    press does not show.
    """
    if calibration is None or calibration.force_per_torque is None:
        return hand
    calibrated = np.array(calibration.force_per_torque, np.float32)[0]
    calibrated[0] = 0.0
    return dataclasses.replace(hand, force_per_torque=np.where(calibrated > 0, calibrated, hand.force_per_torque))


# --- file -----------------------------------------------------------------------------------

_PAIRS = (
    "gain",
    "gain_low",
    "gain_high",
    "offset",
    "offset_low",
    "offset_high",
    "noise",
    "r_squared",
    "condition",
    "samples",
    "outliers",
)
_SINGLES = ("friction", "value_max", "force_max")
_FORCE_PER_TORQUE = ("force_per_torque", "force_per_torque_low", "force_per_torque_high")


def save_calibration(path: str | Path, calibration: Calibration) -> None:
    """Write a calibration as TOML; a crash leaves the old file or the new one, never half of it."""
    path = Path(path)
    lines = [
        f"format = {_text(FORMAT)}",
        f"version = {VERSION}",
        f"hand = {_text(calibration.hand)}",
        f"serial = {_text(calibration.serial)}",
        f"handedness = {_text(calibration.handedness)}",
        f"created = {_text(calibration.created)}",
        f"current_per_count = {_number(calibration.current_per_count)}  # A",
        f"finger_names = [{', '.join(map(_text, calibration.finger_names))}]",
        f"force_per_count = {_list(calibration.force_per_count)}  # N",
    ]
    if calibration.force_per_torque is not None:
        rows = zip(_FORCE_PER_TORQUE, calibration.force_per_torque, strict=True)
        lines += [f"{name} = {_list(row)}  # N/Nm, 0: not pressed" for name, row in rows]
    lines.append("notes = [")
    lines += [f"  {_text(note)}," for note in calibration.notes] + ["]", ""]
    lines += [
        "# Lines value = gain * force + offset; pairs are [loading, unloading].",
        "# real: value in A. sim: value in Nm. Force in N. Intervals are of 95 %.",
        "",
    ]
    for joint, name in enumerate(calibration.joint_names):
        lines += [
            "[[joint]]",
            f"name = {_text(name)}",
            f"torque_scale = {_number(calibration.torque_scale[joint])}  # Nm",
        ]
        for key in ("real", "sim"):
            side = getattr(calibration, key)
            lines.append(f"[joint.{key}]")
            lines += [f"{field} = {_list(getattr(side, field)[:, joint])}" for field in _PAIRS]
            lines += [f"{field} = {_number(getattr(side, field)[joint])}" for field in _SINGLES]
        lines.append("")
    lines += ["[end]", "complete = true", ""]
    try:
        write_whole(path, ["\n".join(lines).encode()])
    except OSError as error:
        raise CalibrationError(f"{path}: cannot be written ({error.strerror})") from None


def load_calibration(path: str | Path, hand: Hand | None = None) -> Calibration:
    """Read a calibration.

    Args:
      path: written by `save_calibration`.
      hand: if given, the hand that it must belong to.

    Raises:
      CalibrationError: missing, cut, not a calibration, of a newer version, of another hand, or with a number
        that no hand gives.
    """
    path = Path(path)
    table = _read(path)
    entries = _list_of(path, table, "joint", dict)
    names = tuple(_field(path, entry, "name", str) for entry in entries)
    fingers = tuple(_list_of(path, table, "finger_names", str))
    if hand is not None and (table["hand"], names, fingers) != (hand.name, hand.joint_names, hand.finger_names):
        raise CalibrationError(
            f"{path}: is of hand {table['hand']!r:.60} with {len(names)} joints and {len(fingers)} fingers, not of "
            f"{hand.name!r} or its joints or fingers: calibrate this hand"
        )
    calibration = Calibration(
        _side(path, entries, "real"),
        _side(path, entries, "sim"),
        np.array([_numbers(path, entry, "torque_scale")[0] for entry in entries]),
        np.array(_numbers(path, table, "force_per_count", len(fingers))),
        hand=table["hand"],
        joint_names=names,
        finger_names=fingers,
        current_per_count=_numbers(path, table, "current_per_count")[0],
        serial=_field(path, table, "serial", str),
        handedness=_field(path, {"handedness": "", **table}, "handedness", str),
        created=_field(path, table, "created", str),
        notes=tuple(_list_of(path, table, "notes", str)),
        force_per_torque=_force_per_torque(path, table, len(fingers)),
    )
    check_numbers(path, calibration, hand)
    return calibration


def _read(path: Path) -> dict[str, Any]:
    try:
        table = read_toml(path)
    except OSError as error:
        raise CalibrationError(f"{path}: cannot be read ({error.strerror})") from None
    except ValueError as error:
        raise CalibrationError(f"{path}: damaged or cut off ({_line(error)})") from None
    if table.get("format") != FORMAT:
        raise CalibrationError(f"{path}: not a calibration file")
    version = _field(path, table, "version", int)
    if version > VERSION:
        raise CalibrationError(
            f"{path}: is of version {version!s:.20}, this library reads up to {VERSION}: upgrade dexsim"
        )
    if table.get("end") != {"complete": True} or not table.get("joint"):
        raise CalibrationError(f"{path}: cut off: its end is missing")
    _field(path, table, "hand", str)
    return table


def _force_per_torque(path: Path, table: dict[str, Any], fingers: int) -> np.ndarray | None:
    if not any(name in table for name in _FORCE_PER_TORQUE):
        return None  # a file from before
    return np.array([_numbers(path, table, name, fingers) for name in _FORCE_PER_TORQUE])


def _side(path: Path, joints: list[dict], key: str) -> Side:
    columns = []
    for entry in joints:
        lines = _field(path, entry, key, dict)
        columns.append(
            [_numbers(path, lines, name, 2) for name in _PAIRS] + [_numbers(path, lines, name) for name in _SINGLES]
        )
    fields: dict[str, Any] = {name: np.array([column[i] for column in columns]).T for i, name in enumerate(_PAIRS)}
    fields |= {name: np.array([column[len(_PAIRS) + i][0] for column in columns]) for i, name in enumerate(_SINGLES)}
    return Side(**fields)


def _field(path: Path, table: dict, name: str, kind: type) -> Any:
    value = table.get(name)
    if type(value) is not kind:
        raise CalibrationError(f"{path}: field {name!r} is missing or not a {kind.__name__}")
    return value


def _list_of(path: Path, table: dict, name: str, kind: type) -> list[Any]:
    values = _field(path, table, name, list)
    if any(type(value) is not kind for value in values):
        raise CalibrationError(f"{path}: field {name!r} holds what is not a {kind.__name__}")
    return values


def _numbers(path: Path, table: dict, name: str, count: int = 1) -> list[float]:
    value = table.get(name)
    values: list[Any] = value if isinstance(value, list) else [value]
    if len(values) != count or any(type(v) not in (int, float) for v in values):
        raise CalibrationError(f"{path}: field {name!r} must hold {count} number(s)")
    try:
        return [float(v) for v in values]
    except OverflowError:
        raise CalibrationError(f"{path}: field {name!r} holds a number without bounds") from None


def _line(error: object) -> str:
    return " ".join(str(error).split())[:100]


def _text(value: str) -> str:
    escaped = value.replace("\\", "\\\\").replace('"', '\\"').replace("\n", " ")
    return f'"{escaped}"'


def _number(value: float | Array) -> str:
    number = float(value)
    return "nan" if math.isnan(number) else repr(number)


def _list(values: Any) -> str:
    return f"[{', '.join(_number(v) for v in np.asarray(values))}]"


# --- what the numbers of a calibration file can be ------------------------------------------------
#
# The bounds are far from the values of a good hand: a wrong unit is found, an unusual hand is no error. Numbers that
# are only reported need not be physical.

_CURRENT = (0.03, 33.0)  # A, of a joint's full torque: a stalled XHand joint draws 1.5 A; 16 bits of mA end at 33 A
# A a count: the wire counts mA, and runs limit the current by that. With another count, torques would not go with it.
_PER_CURRENT = (0.99e-3, 1.01e-3)
_TORQUE = (0.01, 20.0)  # Nm: finger motors stall at 0.4 and 1.1 Nm
_LEVER = (1e-4, 0.3)  # Nm/N, fingertip about joint: a finger is 0.1 m long
_FORCE = (1e-3, 100.0)  # N: the whole hand is rated for 80 N
# N a count; the maker's is 0.1 N. Below 1 mN all 120 taxels, saturated at 255 counts, read 31 N together: less than the
# 37 N of a motor of 1.1 Nm at a lever of 0.03 m. Above 1 N one saturated taxel reads three times what the hand gives.
_PER_FORCE = (1e-3, 1.0)
_PER_TORQUE = (1.0 / _LEVER[1], 1e3)  # N/Nm: a fingertip 0.3 m to 1 mm from its root joint's axis
_REPORTED = 1e12  # magnitude of numbers that people read

_REPORTS = ("gain_low", "gain_high", "offset_low", "offset_high", "noise", "r_squared", "condition", "friction")


@np.errstate(all="ignore")  # What overflows is out of bounds.
def check_numbers(path: object, calibration: Calibration, hand: Hand | None = None) -> None:
    """Check all numbers of a calibration.

    Args:
      path: named in errors.
      calibration: its arrays have the right shapes.
      hand: the hand that it is of, if known.

    Raises:
      CalibrationError: names the file, the joint or finger, the field, its value and the bound.
    """
    joints, scale = calibration.joint_names, np.asarray(calibration.torque_scale)
    _range(path, (), "current_per_count", [calibration.current_per_count], _PER_CURRENT, "A")
    _range(path, calibration.finger_names, "force_per_count", calibration.force_per_count, _PER_FORCE, "N")
    if calibration.force_per_torque is not None:
        force, (low, high) = np.asarray(calibration.force_per_torque), _PER_TORQUE
        fits = (force == 0) | (force >= low) & (force <= high)
        says = f"must be 0, or between {low:.3g} and {high:g} N/Nm"
        _require(path, calibration.finger_names, "force_per_torque", force[0], fits[0], says)
        _require(path, calibration.finger_names, "its interval", force[1:], np.abs(force[1:]) <= _REPORTED, "too large")
    _range(path, joints, "torque_scale", scale, _TORQUE, "Nm")
    if hand is not None:
        same = np.abs(scale - hand.torque_limit) <= 0.01 * hand.torque_limit
        _require(path, joints, "torque_scale", scale, same, "not the torque limit of the hand's model: calibrate again")
    for key, side, most, unit in (
        ("sim", calibration.sim, 3 * scale, "Nm"),
        ("real", calibration.real, _CURRENT[1], "A"),
    ):
        _check_side(path, joints, key, side, np.broadcast_to(most, scale.shape), unit)
    _range(path, joints, "sim.gain", calibration.sim.gain, _LEVER, "Nm/N", magnitude=True)
    _check_torque(path, joints, calibration, scale)


def _check_side(path: object, joints: tuple[str, ...], key: str, side: Side, most: np.ndarray, unit: str) -> None:
    """Args:
    most: [J], larger than what the joint can give.
    """
    gain = np.asarray(side.gain)
    sound = np.isfinite(gain) & (gain != 0) & (np.sign(gain) == np.sign(gain[:1]))
    _require(path, joints, f"{key}.gain", gain, sound, "must be finite, not 0, and of one sign in both directions")
    _require(path, joints, f"{key}.offset", side.offset, np.isfinite(side.offset), "must be finite")
    largest = np.asarray(side.value_max)
    says = f"must be above 0 and at most {{:.3g}} {unit}"
    _require(path, joints, f"{key}.value_max", largest, (largest > 0) & (largest <= most), says, most)
    _range(path, joints, f"{key}.force_max", side.force_max, _FORCE, "N")
    for name in (*_REPORTS, "samples", "outliers"):
        value = np.asarray(getattr(side, name))
        good = np.isnan(value) | (np.abs(value) <= _REPORTED)  # NaN: a direction was not recorded.
        _require(path, joints, f"{key}.{name}", value, good, f"must be nan, or at most {_REPORTED:g}")


def _check_torque(path: object, joints: tuple[str, ...], calibration: Calibration, scale: np.ndarray) -> None:
    """What `joint_torque` makes of currents: neither the full torque for next to none, nor a torque without any.

    It takes the middle of the simulation's two lines, and the hand's loading line, unloading line or their middle. That
    one needs no check: its gain and offset are means of two of one sign, so its torques lie between theirs.
    """
    real, sim = calibration.real, calibration.sim
    per_ampere = np.mean(sim.gain, 0) / np.asarray(real.gain)
    full, (low, high) = scale / np.abs(per_ampere), _CURRENT
    says = f"the full torque would need {{:.3g}} A, must be {low:g} to {high:g} A"
    _require(path, joints, "real.gain", real.gain, (full >= low) & (full <= high), says, full)
    unloaded = np.abs(np.mean(sim.offset, 0) - per_ampere * np.asarray(real.offset)) / scale
    says = "without current the joint would read {:.3g} of its full torque, must be below 1"
    _require(path, joints, "real.offset", real.offset, unloaded < 1, says, unloaded)


def _range(
    path: object,
    names: tuple[str, ...],
    field: str,
    values: Any,
    bounds: tuple[float, float],
    unit: str,
    magnitude: bool = False,
) -> None:
    low, high = bounds
    size = np.abs(values) if magnitude else np.asarray(values)
    says = f"{'its magnitude ' if magnitude else ''}must be between {low:g} and {high:g} {unit}"
    _require(path, names, field, values, (size >= low) & (size <= high), says)


def _require(
    path: object, names: tuple[str, ...], field: str, values: Any, good: np.ndarray, says: str, told: Any = None
) -> None:
    """Raise the error of the first value [..., K] of K joints or fingers that is not `good`; `says` may show `told`."""
    if np.all(good):
        return
    place = tuple(int(i[0]) for i in np.nonzero(~good))
    whose = f"{names[place[-1]]}: " if names else ""
    number = "" if told is None else np.broadcast_to(told, good.shape)[place]
    raise CalibrationError(f"{path}: {whose}{field} = {np.asarray(values)[place]:.6g}: {says.format(number)}")
