"""What the numbers of a calibration file can be. A number that no hand gives is refused, with its joint and field.

The bounds are far from the values of a good hand, so that a wrong unit or a forged number is found and an unusual hand
is not refused. Numbers that are only reported need not be physical.
"""

from typing import TYPE_CHECKING, Any

import numpy as np

from dexsim.core.errors import CalibrationError
from dexsim.hand.kinematics import Hand

if TYPE_CHECKING:
    from dexsim.calibration.maps import Calibration, Side

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
def check(path: object, calibration: "Calibration", hand: Hand | None = None) -> None:
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


def _check_side(path: object, joints: tuple[str, ...], key: str, side: "Side", most: np.ndarray, unit: str) -> None:
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


def _check_torque(path: object, joints: tuple[str, ...], calibration: "Calibration", scale: np.ndarray) -> None:
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
