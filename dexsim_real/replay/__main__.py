"""Recomputes the log of a run, checks every observation against the recorded frames, and writes what is asked for.

python -m dexsim_real.replay runs/real/....log --plot run.png
"""

import dataclasses
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro

from dexsim.core import cli
from dexsim.datasets.lerobot import check_lerobot, write_lerobot
from dexsim.datasets.rerun import show_rerun
from dexsim.datasets.trajectory import from_readings
from dexsim_real.control.alarms import finger_joints
from dexsim_real.control.controller import prepare_jax
from dexsim_real.core.errors import HandError
from dexsim_real.replay.replay import Replay, replay


@dataclasses.dataclass(frozen=True, kw_only=True)
class ReplayArguments:
    """Options of `python -m dexsim_real.replay`."""

    log: Annotated[Path, tyro.conf.Positional]
    """Log file of `python -m dexsim_real.run`."""
    plot: Path | None = None
    """Image file for a figure of angles, forces and timing (.png, .pdf or .svg); None draws no figure."""
    rrd: Path | None = None
    """Recording for the rerun viewer (extra `rerun`); None writes no file."""
    lerobot: Path | None = None
    """Folder for a dataset of one episode in the LeRobot format (extra `lerobot`), which must not exist yet; None
    writes none."""
    hand: str = ""
    """The TOML of a hand of your own, where it is not in the place that the log names."""
    output: Path | None = None
    """JSON file for the report; None writes no file."""

    def __post_init__(self):
        if self.plot and self.plot.suffix.lower() not in (".png", ".pdf", ".svg"):
            raise HandError(f"--plot {self.plot}: give a file that ends in .png, .pdf or .svg")


def main(argv: Sequence[str] | None = None) -> int:
    """The command. Returns its exit code: 0, or 1 when a recomputed observation differs or none could be recomputed."""
    arguments = cli.parse(
        ReplayArguments,
        sys.argv[1:] if argv is None else argv,
        prog="python -m dexsim_real.replay",
        description="Recompute and plot the log of a run on the hand.",
    )
    outputs = {"--plot": arguments.plot, "--rrd": arguments.rrd, "--output": arguments.output}
    cli.check_no_overwrite(outputs, {"log": arguments.log, "TOML of the hand": arguments.hand})
    for path in filter(None, outputs.values()):
        cli.check_writable(path)
    if arguments.lerobot:
        check_lerobot(arguments.lerobot)
    prepare_jax()
    cli.enable_caches()
    run = replay(arguments.log, arguments.hand)
    report, ticks = run.report, len(run.ticks)
    print(*report["notes"], sep="\n")
    print(
        f"{ticks} ticks in {report['seconds']:.2f} s, {report['frames']} frames, {report['damaged_bytes']} damaged "
        f"bytes, end: {report['ended']}"
    )
    verdict = "all observations agree to the last bit" if ticks else "nothing could be compared"
    if first := report["first_difference"]:
        verdict = f"{report['observations_same']} of {ticks} observations agree; first difference: {first}"
    if missing := report["without_frame"]:
        verdict += f"; {missing} ticks lack their frame"
    print(verdict)
    if arguments.output:
        cli.write_json(arguments.output, report)
    if ticks and arguments.plot:
        plot(run, arguments.plot)
    if ticks and arguments.rrd:
        write_rerun(run, arguments.rrd)
    if ticks and arguments.lerobot:
        targets = np.array([tick["target"] for tick in run.ticks])
        episode = from_readings(run.time, [tick["readings"] for tick in run.ticks], targets)
        write_lerobot(arguments.lerobot, run.hand, report["task"], [episode])
    return 0 if report["readings_same"] == report["observations_same"] == ticks > 0 else 1


def signals(run: Replay) -> dict[str, np.ndarray]:
    """Plotted signals, [T, n] each: joint angles and targets (rad), forces (N), command (1), measurement ages (s)."""
    return {
        "angle": np.array([now.joint_position for now in run.measured]),
        "target": np.array([tick["target"] for tick in run.ticks]),
        "force": np.array([now.finger_force for now in run.measured]),
        "command": np.array([[float(tick["readings"]["command"])] for tick in run.ticks]),
        "age": np.array([[tick["age"]] for tick in run.ticks]),
    }


def plot(run: Replay, path: Path) -> None:
    """Write a figure: an axis for each finger with its joint angles and targets, then forces, command and age."""
    import matplotlib.pyplot as plt

    hand, values = run.hand, signals(run)
    figure, axes = plt.subplots(hand.num_fingers + 3, 1, figsize=(10, 16), sharex=True, constrained_layout=True)
    for finger, (axis, name) in enumerate(zip(axes, hand.finger_names, strict=False)):
        for joint in finger_joints(hand, finger):
            (line,) = axis.plot(run.time, values["angle"][:, joint], lw=1, label=hand.joint_names[joint])
            axis.plot(run.time, values["target"][:, joint], lw=0.8, ls=":", color=line.get_color())
        axis.set_ylabel(f"{name} [rad]")
    axes[0].set_title("joint angles; targets dotted", loc="left")
    others = {"force": hand.finger_names, "command": ["command"], "age": ["measurement"]}
    for axis, (signal, names), unit in zip(axes[hand.num_fingers :], others.items(), ("N", "0 to 1", "s"), strict=True):
        axis.plot(run.time, values[signal], lw=0.8, label=names)
        axis.set_ylabel(f"{signal} [{unit}]")
    for axis in axes:
        axis.legend(fontsize=7, ncols=5, loc="upper right", frameon=False)
    axes[-1].set_xlabel("time [s]")
    figure.savefig(path, dpi=120)
    plt.close(figure)


def write_rerun(run: Replay, path: Path) -> None:
    """Write a recording for the rerun viewer: the signals, the observation by fields, and taxels as pictures."""
    hand = run.hand
    names = {"angle": hand.joint_names, "target": hand.joint_names, "force": hand.finger_names}
    series = {name: (names.get(name, (name,)), values) for name, values in signals(run).items()}
    edges = np.cumsum([field.size for field in run.fields])[:-1]
    for field, values in zip(run.fields, np.split(run.observation, edges, 1), strict=True):
        series[f"observation/{field.name}"] = tuple(f"{field.name} {i}" for i in range(field.size)), values
    show_rerun(hand, run.time, series, np.stack([now.taxel_force for now in run.measured]), path)


if __name__ == "__main__":
    cli.run(main)
