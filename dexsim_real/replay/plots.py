"""What is made of a replayed log: a figure, the rerun viewer, a dataset."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from dexsim.datasets.rerun import show_rerun
from dexsim.datasets.trajectory import Trajectory, from_readings
from dexsim.hand.kinematics import Hand

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
    """Write a figure: joint angles and targets by finger, finger forces and command, ages, and the observation."""
    import matplotlib.pyplot as plt

    hand, values = run.hand, signals(run)
    fingers = hand.num_fingers
    figure, axes = plt.subplots(
        fingers + 3,
        1,
        figsize=(10, 19),
        sharex=True,
        constrained_layout=True,
        height_ratios=[1.0] * fingers + [1.5, 0.8, 3.0],
    )
    for finger, (axis, name) in enumerate(zip(axes, hand.finger_names, strict=False)):
        for joint in finger_joints(hand, finger):
            label = hand.joint_names[joint].removeprefix("right_hand_").removesuffix("_joint").replace("_", " ")
            (line,) = axis.plot(run.time, values["angle"][:, joint], lw=1, label=label)
            axis.plot(run.time, values["target"][:, joint], lw=0.8, ls=":", color=line.get_color())
        axis.set_ylabel(f"{name} [rad]")
        axis.legend(fontsize=7, ncols=4, loc="upper right", frameon=False)
    axes[0].set_title("joint angles; targets dotted", loc="left", fontsize=9)
    forces, age, observation = axes[fingers:]
    for finger, name in enumerate(hand.finger_names):
        forces.plot(run.time, values["force"][:, finger], lw=1, label=name)
    forces.set(ylabel="force on the taxels [N]", ylim=(0, max(1.05 * float(values["force"].max()), 0.1)))
    forces.legend(fontsize=7, ncols=5, loc="upper right", frameon=False)
    command = forces.twinx()
    command.plot(run.time, values["command"], "k--", lw=0.8)
    command.set(ylabel="command, dashed [0 to 1]", ylim=(-0.02, 1.02))
    age.plot(run.time, 1e3 * values["age"], lw=0.8)
    age.set_ylabel("age of the\nmeasurement [ms]")
    # Entries differ in unit and scale, so each is normalised.
    spread = np.maximum(run.observation.std(0), 1e-6)
    edges = np.cumsum([0] + [field.size for field in run.fields])
    observation.pcolormesh(
        run.time,
        np.arange(edges[-1]) + 0.5,
        ((run.observation - run.observation.mean(0)) / spread).T,
        cmap="coolwarm",
        vmin=-3,
        vmax=3,
        shading="nearest",
        rasterized=True,
    )
    middles = (edges[:-1] + edges[1:]) / 2
    observation.set_yticks(middles, [field.name.replace("_", " ") for field in run.fields], fontsize=7)
    observation.hlines(edges[1:-1], run.time[0], run.time[-1], color="k", lw=0.5)
    observation.invert_yaxis()
    observation.set_title("observation: each entry in standard deviations from its mean", loc="left", fontsize=9)
    observation.set_xlabel("time [s]")
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=120)
    plt.close(figure)


def finger_joints(hand: Hand, finger: int) -> list[int]:
    """Joints from the palm to a fingertip."""
    body, joints = int(hand.tip_body[finger]), list[int]()
    while body >= 0:
        joints += [int(hand.body_joint[body])] if hand.body_joint[body] >= 0 else []
        body = int(hand.body_parent[body])
    return list(dict.fromkeys(joints[::-1]))  # a motor may move two


def open_rerun(run: Replay, path: Path | None = None) -> None:
    """Show a replay in the rerun viewer: the signals, the observation by fields, and taxels as pictures.

    Args:
      run: the replay.
      path: recording to write; None opens the viewer.

    Raises:
      DexsimError: rerun is not installed.
      OSError: the file cannot be written.
    """
    hand = run.hand
    edges = np.cumsum([field.size for field in run.fields])[:-1]
    names = {"angle": hand.joint_names, "target": hand.joint_names, "force": hand.finger_names}
    series = {
        **{name: (names.get(name, (name,)), values) for name, values in signals(run).items()},
        **{
            f"observation/{field.name}": (tuple(f"{field.name} {i}" for i in range(field.size)), values)
            for field, values in zip(run.fields, np.split(run.observation, edges, 1), strict=True)
        },
    }
    show_rerun(hand, run.time, series, np.stack([now.taxel_force for now in run.measured]), path)


def trajectory(run: Replay) -> Trajectory:
    """A replay as data; the object as the bridge estimated it."""
    return from_readings(
        run.time, [tick["readings"] for tick in run.ticks], np.array([tick["target"] for tick in run.ticks])
    )
