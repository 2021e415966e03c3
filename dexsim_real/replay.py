"""Recomputes the log of a run, checks every observation, and writes what is asked for.

    python -m dexsim_real.replay runs/real/....log --plot run.png

Joint angles, torques and taxel forces are recomputed from the hand's answer that each tick used, and the observation
from the readings, by the code that ran on the hand. The report counts the ticks that agree to the last bit.
"""

import dataclasses
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro

from dexsim import load_hand
from dexsim.calibration.maps import calibrated_hand, load_calibration
from dexsim.core import cli
from dexsim.core.config import from_dict
from dexsim.datasets.lerobot import check_lerobot, from_readings, write_lerobot
from dexsim.datasets.rerun import show_rerun
from dexsim.hand.source import recorded_hand
from dexsim.observation import Readings, layout
from dexsim.task_spec import TaskSpec
from dexsim_real.control.alarms import finger_joints
from dexsim_real.control.controller import make_observe, prepare_jax
from dexsim_real.core.log import Kind, LogError, LogReader, reading
from dexsim_real.sensors.hand import HandMeasurement, HandSensing, HardwareConfig


class Replay:
    """A log of T ticks that is recomputed; `hand` is a TOML for where the hand is not in the place that the log names.

    Raises:
      ConfigError: the log is of another hand.
      LogError: not a log, or one of another command, or the log ends before the hand was ready.
    """

    def __init__(self, path: Path, hand: str = ""):
        self.report: dict[str, Any] = {}
        self.ticks, self.measured = list[dict[str, Any]](), list[HandMeasurement]()  # as logged; recomputed
        self._times, self._observations = list[float](), list[np.ndarray]()
        reader, notes = LogReader(path), list[str]()
        with reading(path):
            for record in reader:
                content = record.content
                if record.kind == Kind.NOTE:
                    notes.append(f"{record.time:.3f} {content}")
                elif record.kind == Kind.META and "from" not in content:
                    self._begin(path, content, hand)
                elif not self.report:
                    continue  # It is of the connection, or of the tare.
                elif record.kind == Kind.META:
                    self._tares.append((content["from"], content["tare"]))
                elif record.kind == Kind.RECEIVED:
                    self.report["frames"] += 1
                elif record.kind == Kind.TICK:
                    self._compare(record.time, content)
                elif record.kind == Kind.END:
                    self.report["ended"] = content["end"]
        if not self.report:
            raise LogError(f"{path}: the log ends before the hand was ready; its notes: {'; '.join(notes) or 'none'}")
        self.time = np.array(self._times) - (self._times[0] if self._times else 0.0)  # [T] s since the first tick
        self.observation = np.array(self._observations)  # [T, n] recomputed
        self.report |= {"ticks": len(self.ticks), "seconds": float(self.time[-1]) if self.ticks else 0.0}
        self.report |= {"damaged_bytes": reader.damaged, "notes": notes}

    def _begin(self, path: Path, meta: dict[str, Any], hand: str) -> None:
        """Take in the configuration of the run."""
        if "spec" not in meta:
            raise LogError(f"{path}: not a log of a run; `python -m dexsim_real.calibrate --from-log` reads it")
        self.hand = recorded_hand(meta.get("hand"), hand, "the log") or load_hand()
        calibration = None
        if meta["calibration"]:
            with tempfile.TemporaryDirectory() as folder:
                file = Path(folder) / "calibration.toml"
                file.write_text(meta["calibration"])
                calibration = load_calibration(file, self.hand)
        self._sensing = HandSensing(self.hand, from_dict(HardwareConfig, meta["hardware"]), calibration)
        spec = from_dict(TaskSpec, meta["spec"])
        self.fields = layout(self.hand, spec.fields, spec.observation)
        self._observe = make_observe(calibrated_hand(self.hand, calibration), spec.fields, spec.observation)
        self.report = {"log": str(path)} | {name: meta[name] for name in ("task", "policy")}
        self.report |= dict.fromkeys(("frames", "readings_same", "observations_same"), 0)
        self.report |= {"first_difference": None, "ended": "truncated", "recorded_on": meta["environment"]}
        self._tares = [(0, np.array(meta["tare"], np.float32))]  # and the number of the exchange from which on it holds

    def _compare(self, time: float, tick: dict[str, Any]) -> None:
        # The exchange thread may have changed the tare before the tick's record was written.
        self._sensing.tare = next(tare for begin, tare in reversed(self._tares) if begin <= tick["sequence"])
        measured = self._sensing.measure(self._sensing.decode(tick["answer"]))
        # The hand's measurements are recomputed; camera, goal and command are taken from the log.
        again = {name: getattr(measured, name) for name in ("joint_position", "joint_torque", "taxel_force")}
        same = all(_same(value, tick["readings"][name]) for name, value in again.items())
        observation = np.asarray(self._observe(Readings(**{**tick["readings"], **again})))
        identical = _same(observation, tick["observation"])
        self.report["readings_same"] += same
        self.report["observations_same"] += identical
        if not (same and identical) and self.report["first_difference"] is None:
            self.report["first_difference"] = f"tick {len(self.ticks)} at {time:.3f} s"
        self._times.append(time)
        self.measured.append(measured)
        self.ticks.append(tick)
        self._observations.append(observation)


def _same(a: np.ndarray, b: np.ndarray) -> bool:
    """Whether two arrays agree to the last bit."""
    return a.dtype == b.dtype and a.shape == b.shape and a.tobytes() == b.tobytes()


# --- the command ------------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True, kw_only=True)
class ReplayArguments:
    """Recompute and plot the log of a run on the hand."""

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


def main(argv: Sequence[str] | None = None) -> int:
    """The command. Returns its exit code: 0, or 1 when a recomputed observation differs or none could be recomputed."""
    arguments = cli.parse(ReplayArguments, argv)
    outputs = {"--plot": arguments.plot, "--rrd": arguments.rrd, "--output": arguments.output}
    cli.check_no_overwrite(outputs, {"log": arguments.log, "TOML of the hand": arguments.hand})
    for path in filter(None, outputs.values()):
        cli.check_writable(path)
    if arguments.lerobot:
        check_lerobot(arguments.lerobot)
    prepare_jax()
    cli.enable_caches()
    run = Replay(arguments.log, arguments.hand)
    report, ticks = run.report, len(run.ticks)
    read = f"{report['frames']} frames, {report['damaged_bytes']} damaged bytes"
    verdict = "all observations agree to the last bit" if ticks else "nothing could be compared"
    if first := report["first_difference"]:
        verdict = f"{report['observations_same']} of {ticks} observations agree; first difference: {first}"
    print(*report["notes"], f"{ticks} ticks in {report['seconds']:.2f} s, {read}, end: {report['ended']}", sep="\n")
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
    series, edges = signals(run), np.cumsum([field.size for field in run.fields])[:-1]
    for field, values in zip(run.fields, np.split(run.observation, edges, 1), strict=True):
        series[f"observation/{field.name}"] = values
    show_rerun(run.hand, run.time, series, np.stack([now.taxel_force for now in run.measured]), path)


if __name__ == "__main__":
    cli.run(main)
