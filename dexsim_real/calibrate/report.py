"""Report of a calibration: plain data, and a table for the terminal."""

from typing import Any

import numpy as np
from rich.table import Table

from dexsim.calibration.maps import Calibration, Side
from dexsim.core.config import to_dict
from dexsim_real.calibrate.press_fit import Fit

_WAYS = ("loading", "unloading")


def torque_constants(calibration: Calibration) -> np.ndarray:
    """Torque constants [2, J] Nm/A at the joint, loading and unloading: the ratio of the gains."""
    return np.asarray(calibration.sim.gain) / np.asarray(calibration.real.gain)


def torque_constant_intervals(calibration: Calibration) -> np.ndarray:
    """95 % intervals [2, J, 2] Nm/A of `torque_constants`; the widths of both sides are added in quadrature."""
    real, sim = calibration.real, calibration.sim
    share = np.hypot(_half(real) / np.abs(real.gain), _half(sim) / np.abs(sim.gain))
    value = torque_constants(calibration)[..., None]
    return value + np.abs(value) * share[..., None] * np.array([-1.0, 1.0])


def report(fit: Fit) -> dict[str, Any]:
    """All results as plain data."""
    calibration, real = fit.calibration, fit.calibration.real
    constants, intervals = torque_constants(calibration), torque_constant_intervals(calibration)
    joints = {}
    for joint, name in enumerate(calibration.joint_names):
        lines = {
            way: {
                "nm_per_a": constants[k, joint],
                "nm_per_a_95": intervals[k, joint],
                "a_per_n": real.gain[k, joint],
                "offset_a": real.offset[k, joint],
                "r_squared": real.r_squared[k, joint],
                "condition": real.condition[k, joint],
                "samples": int(real.samples[k, joint]),
                "outliers": int(real.outliers[k, joint]),
            }
            for k, way in enumerate(_WAYS)
        }
        joints[name] = {
            "press": fit.source.get(name),
            "friction_a": real.friction[joint],
            "force_max_n": real.force_max[joint],
            "current_max_a": real.value_max[joint],
            **lines,
        }
    return {
        "hand": calibration.hand,
        "serial": calibration.serial,
        "handedness": calibration.handedness,
        "created": calibration.created,
        "newtons_per_count": dict(zip(calibration.finger_names, calibration.force_per_count, strict=True)),
        "newtons_per_newton_metre": {
            name: dict(zip(("value", "low", "high"), column, strict=True))
            for name, column in zip(calibration.finger_names, _per_torque(calibration).T, strict=True)
        },
        "gauge": {name: to_dict(finger_fit) for name, finger_fit in fit.sensors.items()},
        "joints": joints,
        "notes": list(calibration.notes),
    }


def table(fit: Fit) -> Table:
    """A table with one row per joint. A cell has loading / unloading, or the worse of the two."""
    calibration, real = fit.calibration, fit.calibration.real
    constants, intervals = torque_constants(calibration), torque_constant_intervals(calibration)
    width = np.max(np.ptp(intervals, axis=-1) / 2 / np.abs(constants), 0)
    columns = Table(
        box=None, padding=(0, 1, 0, 0), title="current to torque, loading / unloading", title_justify="left"
    )
    for head in ("joint", "pressed with", "Nm / A", "95 %", "R2", "cond.", "friction", "max force"):
        columns.add_column(head, no_wrap=True)
    for joint, name in enumerate(calibration.joint_names):
        columns.add_row(
            name,
            fit.source.get(name, "(others)"),
            " / ".join(f"{value:+.3f}" for value in constants[:, joint]),
            f"{100 * width[joint]:.1f} %",
            f"{np.min(real.r_squared[:, joint]):.3f}",
            f"{np.max(real.condition[:, joint]):.1f}",
            f"{1e3 * real.friction[joint]:.0f} mA",
            f"{real.force_max[joint]:.1f} N",
        )
    return columns


def force_table(calibration: Calibration) -> Table:
    """A table of the forces per root-joint torque; a finger that was not pressed has those of the hand's TOML."""
    columns = Table(
        box=None, padding=(0, 1, 0, 0), title="fingertip force over root-joint torque", title_justify="left"
    )
    for head in ("finger", "N / Nm", "95 %"):
        columns.add_column(head, no_wrap=True)
    for name, (value, low, high) in zip(calibration.finger_names, _per_torque(calibration).T, strict=True):
        columns.add_row(name, *((f"{value:.2f}", f"{low:.2f} to {high:.2f}") if value else ("(hand's TOML)", "")))
    return columns


def _per_torque(calibration: Calibration) -> np.ndarray:
    zero = np.zeros((3, len(calibration.finger_names)))
    return zero if calibration.force_per_torque is None else np.asarray(calibration.force_per_torque)


def grouped(notes: tuple[str, ...]) -> list[str]:
    """Notes, with equal notes on several joints joined."""
    joined: dict[str, list[str]] = {}
    for note in notes:
        name, colon, text = note.partition(": ")
        joined.setdefault(text if colon else note, []).append(name if colon else "")
    return [f"{', '.join(names)}: {text}" if names[0] else text for text, names in joined.items()]


def _half(side: Side) -> np.ndarray:
    return (np.asarray(side.gain_high) - np.asarray(side.gain_low)) / 2
