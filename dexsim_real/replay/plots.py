"""What is made of a replayed log: a figure, the rerun viewer, a dataset."""

from pathlib import Path

import numpy as np

from dexsim.datasets.rerun import show_rerun
from dexsim.datasets.trajectory import Trajectory, from_readings
from dexsim.hand.kinematics import Hand
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


def write_rerun(run: Replay, path: Path) -> None:
    """Write a recording for the rerun viewer: the signals, the observation by fields, and taxels as pictures.

    Raises:
      DexsimError: rerun is not installed.
      OSError: the file cannot be written.
    """
    hand = run.hand
    names = {"angle": hand.joint_names, "target": hand.joint_names, "force": hand.finger_names}
    series = {name: (names.get(name, (name,)), values) for name, values in signals(run).items()}
    edges = np.cumsum([field.size for field in run.fields])[:-1]
    for field, values in zip(run.fields, np.split(run.observation, edges, 1), strict=True):
        series[f"observation/{field.name}"] = tuple(f"{field.name} {i}" for i in range(field.size)), values
    show_rerun(hand, run.time, series, np.stack([now.taxel_force for now in run.measured]), path)


def trajectory(run: Replay) -> Trajectory:
    """A replay as data; the object as the bridge estimated it."""
    return from_readings(
        run.time, [tick["readings"] for tick in run.ticks], np.array([tick["target"] for tick in run.ticks])
    )
