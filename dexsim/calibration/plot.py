"""The paper's calibration figure: current against force, torque against force, and both on [0, 1]."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from dexsim.calibration.joint import JointPress, find_direction
from dexsim.calibration.maps import Calibration, Side, normalise
from dexsim.core.errors import CalibrationError

_WAYS = (("loading", 1, "tab:blue"), ("unloading", -1, "tab:orange"))


def plot_calibration(
    path: str | Path,
    calibration: Calibration,
    real: Mapping[str, JointPress],
    sim: Mapping[str, JointPress],
    joints: tuple[str, ...] | None = None,
) -> None:
    """Write a figure (.png, .pdf or .svg) with one row a joint: the hand, the simulation, both normalised. By default
    of all joints that were recorded on both sides.

    Raises:
      CalibrationError: none of the joints was recorded on both sides.
    """
    from matplotlib.figure import Figure

    names = [n for n in joints or calibration.joint_names if n in real and n in sim]
    if not names:
        raise CalibrationError("nothing to draw: no joint was recorded on both sides")
    figure = Figure(figsize=(11, 2.6 * len(names) + 0.4), layout="constrained")
    axes = figure.subplots(len(names), 3, squeeze=False)
    for (left, middle, right), name in zip(axes, names, strict=True):
        joint = calibration.joint_names.index(name)
        left.set(title=f"{name}, hand", xlabel="force, N", ylabel="current, A")
        middle.set(title=f"{name}, simulation", xlabel="force, N", ylabel="torque, Nm")
        right.set(title="both, normalised", xlabel="force / its maximum", xlim=(-0.05, 1.05), ylim=(-0.15, 1.15))
        _draw_lines(left, calibration.real, joint, real[name])
        _draw_lines(middle, calibration.sim, joint, sim[name])
        _draw_normalised(right, calibration.real, joint, real[name], "tab:green", "current (hand)")
        _draw_normalised(right, calibration.sim, joint, sim[name], "tab:red", "torque (simulation)")
        for axis in (left, middle, right):
            axis.legend(fontsize=6)
    figure.savefig(path, dpi=110)


def _draw_lines(axis, side: Side, joint: int, press: JointPress) -> None:
    direction = find_direction(press.force) if press.direction is None else np.asarray(press.direction)
    ends = np.array([0.0, side.force_max[joint]])
    for row, (name, sign, colour) in enumerate(_WAYS):
        here = np.sign(direction) == sign
        axis.plot(np.asarray(press.force)[here], np.asarray(press.value)[here], ".", ms=2, alpha=0.35, color=colour)
        gain, offset = side.gain[row, joint], side.offset[row, joint]
        text = f"{name}: {gain:.3g} F {offset:+.2g}, R² {side.r_squared[row, joint]:.3f}"
        axis.plot(ends, gain * ends + offset, color=colour, lw=1.4, label=text)


def _draw_normalised(axis, side: Side, joint: int, press: JointPress, colour: str, label: str) -> None:
    axis.plot(*normalise(side, joint, press.force, press.value), ".", ms=2, alpha=0.3, color=colour)
    ends = np.array([0.0, side.force_max[joint]])
    line = np.mean(side.gain[:, joint]) * ends + np.mean(side.offset[:, joint])
    axis.plot(*normalise(side, joint, ends, line), color=colour, lw=1.4, label=label)
