"""Plots of a replayed log: a figure, or the rerun viewer."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from dexsim import load_hand
from dexsim.core.install import install_line
from dexsim.render.panel import taxel_image
from dexsim_real.core.log import LogError

if TYPE_CHECKING:
    from dexsim_real.replay.replay import Replay


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
    """Write a figure of joint angles and targets, finger forces and command, measurement ages, and the observation."""
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(4, 1, figsize=(10, 13), sharex=True, constrained_layout=True)
    hand, seen = load_hand(), signals(run)
    for joint, name in enumerate(hand.joint_names):
        (line,) = axes[0].plot(run.time, seen["angle"][:, joint], lw=1, label=name.removeprefix("right_hand_"))
        axes[0].plot(run.time, seen["target"][:, joint], lw=0.6, ls=":", color=line.get_color())
    axes[0].set_ylabel("joint angle, target (dotted) / rad")
    axes[0].legend(fontsize=6, ncols=4)
    for finger, name in enumerate(hand.finger_names):
        axes[1].plot(run.time, seen["force"][:, finger], lw=1, label=name)
    axes[1].set_ylabel("fingertip force / N")
    axes[1].legend(fontsize=7, ncols=5)
    command = axes[1].twinx()
    command.plot(run.time, seen["command"], "k--", lw=0.8)
    command.set_ylabel("command / 1")
    axes[2].plot(run.time, 1e3 * seen["age"], lw=0.8)
    axes[2].set_ylabel("age of the measurement / ms")
    # Entries differ in unit and scale, so each is normalised.
    spread = np.maximum(run.observation.std(0), 1e-6)
    edges = np.cumsum([0] + [field.size for field in run.fields])
    axes[3].pcolormesh(
        run.time,
        np.arange(edges[-1]) + 0.5,
        ((run.observation - run.observation.mean(0)) / spread).T,
        cmap="coolwarm",
        vmin=-3,
        vmax=3,
        shading="nearest",
        rasterized=True,
    )
    axes[3].set_yticks((edges[:-1] + edges[1:]) / 2, [field.name for field in run.fields], fontsize=7)
    axes[3].hlines(edges[1:-1], run.time[0], run.time[-1], color="k", lw=0.5)
    axes[3].invert_yaxis()
    axes[3].set_title("observation, each entry in standard deviations from its mean", fontsize=9)
    axes[3].set_xlabel("time / s")
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=120)
    plt.close(figure)


def show_rerun(run: Replay, path: Path | None = None) -> None:
    """Show a replay in the rerun viewer: the signals, the observation by fields, and taxels as pictures.

    Args:
      run: the replay.
      path: recording to write; None opens the viewer.

    Raises:
      LogError: rerun is not installed.
      OSError: the file cannot be written.
    """
    try:
        import rerun
    except ImportError:
        raise LogError(f"the rerun viewer is not installed: {install_line('rerun')}; or use --plot") from None
    hand = load_hand()
    edges = np.cumsum([field.size for field in run.fields])[:-1]
    names = {"angle": hand.joint_names, "target": hand.joint_names, "force": hand.finger_names}
    series = {
        **{name: (names.get(name, (name,)), values) for name, values in signals(run).items()},
        **{
            f"observation/{field.name}": (tuple(f"{field.name} {i}" for i in range(field.size)), values)
            for field, values in zip(run.fields, np.split(run.observation, edges, 1), strict=True)
        },
    }
    recording = rerun.RecordingStream("dexsim")
    if path is None:
        recording.spawn()
    else:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()  # Its error names the file; rerun's does not.
        recording.save(path)
    for entity, (labels, values) in series.items():
        recording.log(entity, rerun.SeriesLines(names=list(labels)), static=True)
        recording.send_columns(
            entity, [rerun.TimeColumn("run", duration=run.time)], rerun.Scalars.columns(scalars=values)
        )
    top = max(float(np.max([m.taxel_force for m in run.measured])), 1e-3)
    for at, now in zip(run.time, run.measured, strict=True):
        recording.set_time("run", duration=float(at))
        for finger, name in enumerate(hand.finger_names):
            picture = taxel_image(now.taxel_force[finger], hand.taxel_grid)
            recording.log(f"taxels/{name}", rerun.DepthImage(picture, colormap="inferno", depth_range=(0.0, top)))
    recording.disconnect()
