"""What the terminal shows of a calibration; the file has everything."""

import numpy as np
from rich.table import Table

from dexsim.calibration.maps import Calibration
from dexsim_real.calibrate.press_fit import Fit


def torque_constants(calibration: Calibration) -> np.ndarray:
    """Torque constants [2, J] Nm/A at the joint, loading and unloading: the ratio of the gains."""
    return np.asarray(calibration.sim.gain) / np.asarray(calibration.real.gain)


def torque_constant_intervals(calibration: Calibration) -> np.ndarray:
    """95 % intervals [2, J, 2] Nm/A of `torque_constants`; the widths of both sides are added in quadrature."""
    sides, value = (calibration.real, calibration.sim), torque_constants(calibration)
    share = np.hypot(*(np.asarray(side.gain_high - side.gain_low) / 2 / np.abs(side.gain) for side in sides))
    return value[..., None] + (np.abs(value) * share)[..., None] * np.array([-1.0, 1.0])


def table(fit: Fit) -> Table:
    """A table with one row per joint. A cell has loading / unloading, or the worse of the two."""
    calibration, real = fit.calibration, fit.calibration.real
    constants, intervals = torque_constants(calibration), torque_constant_intervals(calibration)
    width = np.max(np.ptp(intervals, axis=-1) / 2 / np.abs(constants), 0)
    heads = ("joint", "pressed with", "Nm / A", "95 %", "R2", "cond.", "friction", "max force")
    rows = Table(*heads, box=None, padding=(0, 1, 0, 0), title="current to torque, loading / unloading")
    for joint, name in enumerate(calibration.joint_names):
        rows.add_row(
            name,
            fit.source.get(name, "(others)"),
            " / ".join(f"{value:+.3f}" for value in constants[:, joint]),
            f"{100 * width[joint]:.1f} %",
            f"{np.min(real.r_squared[:, joint]):.3f}",
            f"{np.max(real.condition[:, joint]):.1f}",
            f"{1e3 * real.friction[joint]:.0f} mA",
            f"{real.force_max[joint]:.1f} N",
        )
    return rows


def force_table(calibration: Calibration) -> Table:
    """A table of the forces per root-joint torque; a finger that was not pressed has those of the hand's TOML."""
    title = "fingertip force over root-joint torque"
    rows = Table("finger", "N / Nm", "95 %", box=None, padding=(0, 1, 0, 0), title=title)
    assert calibration.force_per_torque is not None, "`press_fit.fit` gives it"
    for name, (value, low, high) in zip(calibration.finger_names, calibration.force_per_torque.T, strict=True):
        rows.add_row(name, *((f"{value:.2f}", f"{low:.2f} to {high:.2f}") if value else ("(hand's TOML)", "")))
    return rows


def grouped(notes: tuple[str, ...]) -> list[str]:
    """Notes, with equal notes on several joints joined."""
    joined: dict[str, list[str]] = {}
    for note in notes:
        name, colon, text = note.partition(": ")
        joined.setdefault(text if colon else note, []).append(name if colon else "")
    return [f"{', '.join(names)}: {text}" if names[0] else text for text, names in joined.items()]
