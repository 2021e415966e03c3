"""The paper's calibration figure: current against force, torque against force, and both on [0, 1]."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from dexsim.calibration.fit import JointPress, find_swings
from dexsim.calibration.maps import Calibration


def plot_calibration(
    path: str | Path,
    calibration: Calibration,
    real: Mapping[str, JointPress],
    sim: Mapping[str, JointPress],
    joints: tuple[str, ...] | None = None,
) -> None:
    """Write a figure (.png, .pdf or .svg) with one row a joint: the hand, the simulation, both normalised. By default
    of all joints that were recorded on both sides."""
    from matplotlib.figure import Figure

    names = [n for n in joints or calibration.joint_names if n in real and n in sim]
    figure = Figure(figsize=(11, 2.6 * len(names) + 0.4), layout="constrained")
    for row, name in zip(figure.subplots(len(names), 3, squeeze=False), names, strict=True):
        joint = calibration.joint_names.index(name)
        for axis, side, press, where, label, colour in (
            (row[0], calibration.real, real[name], "hand", "current, A", "tab:green"),
            (row[1], calibration.sim, sim[name], "simulation", "torque, Nm", "tab:red"),
        ):
            axis.set(title=f"{name}, {where}", xlabel="force, N", ylabel=label)
            force, value = np.asarray(press.force), np.asarray(press.value)
            direction = find_swings(force)[0] if press.direction is None else np.sign(press.direction)
            ends, lines = np.array([0.0, side.force_max[joint]]), []
            for way, (motion, sign) in enumerate((("loading", 1), ("unloading", -1))):
                gain, offset = side.gain[way, joint], side.offset[way, joint]
                lines.append(gain * ends + offset)
                text = f"{motion}: {gain:.3g} F {offset:+.2g}, R² {side.r_squared[way, joint]:.3f}"
                axis.plot(force[direction == sign], value[direction == sign], ".", ms=2, alpha=0.35, color=f"C{way}")
                axis.plot(ends, lines[-1], color=f"C{way}", lw=1.4, label=text)
            most = side.force_max[joint], side.value_max[joint] * np.sign(side.gain[0, joint])
            row[2].plot(force / most[0], value / most[1], ".", ms=2, alpha=0.3, color=colour)
            row[2].plot(ends / most[0], np.mean(lines, 0) / most[1], color=colour, lw=1.4, label=label)
        row[2].set(title="both, normalised", xlabel="force / its maximum", xlim=(-0.05, 1.05), ylim=(-0.15, 1.15))
        for axis in row:
            axis.legend(fontsize=6)
    figure.savefig(path, dpi=110)
