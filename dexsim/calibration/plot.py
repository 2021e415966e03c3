"""The paper's calibration figure: current against force, torque against force, and both on [0, 1]."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from dexsim.calibration.joint import JointPress, find_direction
from dexsim.calibration.maps import Calibration, Side, normalise
from dexsim.core.errors import CalibrationError

_COLOURS = ("tab:blue", "tab:orange")
_WAYS = ("loading", "unloading")


def plot_calibration(
    path: str | Path,
    calibration: Calibration,
    real: Mapping[str, JointPress],
    sim: Mapping[str, JointPress],
    joints: tuple[str, ...] | None = None,
) -> None:
    """Write a figure with one row a joint: the hand, the simulation, both normalised.

    Args:
      path: .png, .pdf or .svg.
      calibration: fitted from these recordings.
      real, sim: the recordings, by joint name.
      joints: which; by default all that were recorded on both sides.

    Raises:
      CalibrationError: none of the joints was recorded on both sides.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    names = [n for n in joints or calibration.joint_names if n in real and n in sim]
    if not names:
        raise CalibrationError("nothing to draw: no joint was recorded on both sides")
    figure = Figure(figsize=(11, 2.6 * len(names) + 0.4), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(len(names), 3, squeeze=False)
    for row, name in enumerate(names):
        joint = calibration.joint_names.index(name)
        _draw_side(axes[row, 0], calibration.real, joint, real[name], "current, A")
        _draw_side(axes[row, 1], calibration.sim, joint, sim[name], "torque, Nm")
        _draw_normalised(axes[row, 2], calibration, joint, real[name], sim[name])
        axes[row, 0].set_title(f"{name}, hand", fontsize=9)
        axes[row, 1].set_title(f"{name}, simulation", fontsize=9)
        axes[row, 2].set_title("both, normalised", fontsize=9)
    figure.savefig(path, dpi=110)


def _draw_side(axes, side: Side, joint: int, press: JointPress, label: str) -> None:
    force, value = np.asarray(press.force, float), np.asarray(press.value, float)
    direction = find_direction(force) if press.direction is None else np.asarray(press.direction)
    ends = np.array([0.0, float(side.force_max[joint])])
    for way, (colour, sign) in enumerate(zip(_COLOURS, (1, -1), strict=True)):
        here = np.sign(direction) == sign
        axes.plot(force[here], value[here], ".", ms=2, alpha=0.35, color=colour)
        gain, offset = float(side.gain[way, joint]), float(side.offset[way, joint])
        text = f"{_WAYS[way]}: {gain:.3g} F {offset:+.2g}, R² {float(side.r_squared[way, joint]):.3f}"
        axes.plot(ends, gain * ends + offset, color=colour, lw=1.4, label=text)
    axes.set_xlabel("force, N", fontsize=8)
    axes.set_ylabel(label, fontsize=8)
    axes.tick_params(labelsize=7)
    axes.legend(fontsize=6)


def _draw_normalised(axes, calibration: Calibration, joint: int, real: JointPress, sim: JointPress) -> None:
    for side, press, colour, label in (
        (calibration.real, real, "tab:green", "current (hand)"),
        (calibration.sim, sim, "tab:red", "torque (simulation)"),
    ):
        force, value = normalise(side, joint, press.force, press.value)
        axes.plot(force, value, ".", ms=2, alpha=0.3, color=colour)
        sign = np.sign(float(side.gain[0, joint]))
        slope = abs(float(np.mean(side.gain[:, joint]))) * float(side.force_max[joint])
        rest = sign * float(np.mean(side.offset[:, joint]))
        scale = float(side.value_max[joint])
        axes.plot([0, 1], [rest / scale, (rest + slope) / scale], color=colour, lw=1.4, label=label)
    axes.set_xlim(-0.05, 1.05)
    axes.set_ylim(-0.15, 1.15)
    axes.set_xlabel("force / its maximum", fontsize=8)
    axes.tick_params(labelsize=7)
    axes.legend(fontsize=6)
