"""Reads a run's log, recomputes every observation from the raw frames, and shows it.

    python -m dexsim_real.replay runs/real/20260101-120000.log --plot run.png

Joint angles, torques and taxel forces are computed again from the frame that each tick saw, and the
observation from the readings, by the code that ran on the hand: bit for bit the same, or it says so.
"""

import dataclasses
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro

from dexsim import load_hand
from dexsim.calibration import load_calibration
from dexsim.config import from_dict
from dexsim.observation import Readings
from dexsim_ppo import cli
from dexsim_real import frames
from dexsim_real.control import load_task, make_observe, prepare_jax
from dexsim_real.log import Kind, LogError, LogReader
from dexsim_real.sensing import HandSensing, HardwareConfig, Measured

MEASURED = ("joint_position", "joint_torque", "taxel_force")


@dataclasses.dataclass(frozen=True, kw_only=True)
class ReplayArguments:
    """Options of `python -m dexsim_real.replay`."""

    log: Annotated[Path, tyro.conf.Positional]
    """A log of `dexsim_real.run`."""
    plot: Path | None = None
    """File for a figure of angles, forces and timing (matplotlib)."""
    rerun: bool = False
    """Show it in the rerun viewer (extra: pip install rerun-sdk)."""
    output: Path | None = None
    """File for the report as JSON."""


@dataclasses.dataclass
class Replay:
    """A log, recomputed."""

    report: dict[str, Any]
    time: np.ndarray  # [T] s since the first tick
    measured: list[Measured]  # by tick
    ticks: list[dict[str, Any]]  # as logged


def replay(path: Path) -> Replay:
    """Recompute a log.

    Raises:
      LogError: not a log, or one that ends before its configuration.
    """
    reader = LogReader(path)
    states: dict[int, bytes] = {}
    times, measured, ticks, notes = [], [], [], []
    counts = dict.fromkeys(("frames", "readings_same", "observations_same", "without_frame"), 0)
    first, meta, end = "", None, None
    for record in reader:
        if record.kind == Kind.META:
            meta = record.content
            sensing, observe = _rebuild(meta)
        elif record.kind == Kind.RECEIVED:
            number, frame = record.content
            counts["frames"] += 1
            if frame[4] == frames.Command.EXCHANGE:
                states = {**{n: f for n, f in states.items() if n > number - 50}, number: frame}
        elif record.kind == Kind.TICK and meta is not None:
            tick = record.content
            frame = states.get(tick["sequence"])
            if frame is None:
                counts["without_frame"] += 1
                continue
            now = sensing.measure(frames.decode_state(frame[frames.HEADER.size:-2]))
            same = all(_same(getattr(now, name), tick["readings"][name]) for name in MEASURED)
            # What the hand measures is taken as recomputed; camera, goal and command as logged.
            again = {**tick["readings"], **{name: getattr(now, name) for name in MEASURED}}
            observation = np.asarray(observe(Readings(**again)))
            identical = _same(observation, tick["observation"])
            counts["readings_same"] += same
            counts["observations_same"] += identical
            if not (same and identical) and not first:
                first = f"tick {len(ticks)} at {record.time:.3f} s"
            times.append(record.time)
            measured.append(now)
            ticks.append(tick)
        elif record.kind == Kind.NOTE:
            notes.append(f"{record.time:.3f} {record.content}")
        elif record.kind == Kind.END:
            end = record.content
    if meta is None:
        raise LogError(f"{path}: ends before the hand was ready; its notes: {'; '.join(notes) or 'none'}")
    report = {"log": str(path), "task": meta["task"], "policy": meta["policy"], "ticks": len(ticks), **counts,
              "seconds": times[-1] - times[0] if times else 0.0, "first_difference": first or None,
              "damaged_bytes": reader.damaged, "ended": end["end"] if end else "cut off", "notes": notes,
              "recorded_on": meta["environment"]}
    return Replay(report, np.array(times) - (times[0] if times else 0.0), measured, ticks)


def _rebuild(meta: dict[str, Any]) -> tuple[HandSensing, Any]:
    """The sensing and the observation of a logged run."""
    hand, calibration = load_hand(), None
    if meta["calibration"]:
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "calibration.toml"
            path.write_text(meta["calibration"])
            calibration = load_calibration(path, hand)
    sensing = HandSensing(hand, from_dict(HardwareConfig, meta["hardware"]), calibration)
    sensing.tare = np.array(meta["tare"], np.float32)
    task = load_task(meta["task"], meta["env_config"], hand)
    return sensing, make_observe(hand, task.fields["actor"], task.config.observation)


def _same(a: np.ndarray, b: np.ndarray) -> bool:
    """Equal bit for bit."""
    return a.dtype == b.dtype and a.shape == b.shape and a.tobytes() == b.tobytes()


def plot(run: Replay, path: Path) -> None:
    """A figure: joint angles against targets, finger forces and command, ages."""
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(3, 1, figsize=(10, 9), sharex=True, constrained_layout=True)
    hand = load_hand()
    angle = np.array([m.joint_position for m in run.measured])
    target = np.array([tick["target"] for tick in run.ticks])
    for joint, name in enumerate(hand.joint_names):
        (line,) = axes[0].plot(run.time, angle[:, joint], lw=1, label=name.removeprefix("right_hand_"))
        axes[0].plot(run.time, target[:, joint], lw=0.6, ls=":", color=line.get_color())
    axes[0].set_ylabel("joint angle, target (dotted) / rad")
    axes[0].legend(fontsize=6, ncols=4)
    force = np.array([m.finger_force for m in run.measured])
    for finger, name in enumerate(hand.finger_names):
        axes[1].plot(run.time, force[:, finger], lw=1, label=name)
    axes[1].set_ylabel("fingertip force / N")
    axes[1].legend(fontsize=7, ncols=5)
    command = axes[1].twinx()
    command.plot(run.time, [float(tick["readings"]["command"]) for tick in run.ticks], "k--", lw=0.8)
    command.set_ylabel("command / 1")
    axes[2].plot(run.time, [1e3 * tick["age"] for tick in run.ticks], lw=0.8)
    axes[2].set_ylabel("age of the measurement / ms")
    axes[2].set_xlabel("time / s")
    figure.savefig(path, dpi=120)
    plt.close(figure)


def show_rerun(run: Replay) -> None:
    """The same in the rerun viewer, with taxels as images.

    Raises:
      LogError: rerun is not installed.
    """
    try:
        import rerun
    except ImportError:
        raise LogError("the rerun viewer is missing: pip install rerun-sdk (or use --plot)") from None
    hand = load_hand()
    columns, rows = hand.taxel_grid
    rerun.init("dexsim", spawn=True)
    for at, now, tick in zip(run.time, run.measured, run.ticks, strict=True):
        rerun.set_time("run", duration=float(at))
        for joint, name in enumerate(hand.joint_names):
            rerun.log(f"angle/{name}", rerun.Scalars(float(now.joint_position[joint])))
            rerun.log(f"target/{name}", rerun.Scalars(float(tick["target"][joint])))
        for finger, name in enumerate(hand.finger_names):
            rerun.log(f"force/{name}", rerun.Scalars(float(now.finger_force[finger])))
            rerun.log(f"taxels/{name}", rerun.Tensor(now.taxel_force[finger].reshape(columns, rows)))
        rerun.log("command", rerun.Scalars(float(tick["readings"]["command"])))


def main(argv: Sequence[str] | None = None) -> int:
    """The command. Returns its exit code: 0, or 1 when something was not the same."""
    arguments = cli.parse(ReplayArguments, sys.argv[1:] if argv is None else argv,
                          prog="python -m dexsim_real.replay",
                          description="Recompute and show the log of a run on the hand.")
    prepare_jax()
    cli.enable_caches()
    run = replay(arguments.log)
    report = run.report
    for note in report["notes"]:
        print(note)
    same = report["readings_same"] == report["observations_same"] == report["ticks"]
    print(f"{report['ticks']} ticks in {report['seconds']:.2f} s, {report['frames']} frames, "
          f"{report['damaged_bytes']} bytes damaged, ended: {report['ended']}")
    print("every observation is the same, bit for bit" if same else
          f"{report['observations_same']} observations of {report['ticks']} are the same; the first that is not: "
          f"{report['first_difference']}")
    if arguments.output:
        cli.write_json(arguments.output, report)
    if arguments.plot and run.ticks:
        plot(run, arguments.plot)
        print(f"figure: {arguments.plot}")
    if arguments.rerun:
        show_rerun(run)
    return 0 if same else 1


if __name__ == "__main__":
    cli.run(main)
