"""Recomputes every observation of a logged run from the raw frames.

Joint angles, torques and taxel forces are recomputed from the frame that each tick used, and the observation from the
readings, by the code that ran on the hand. The report counts the ticks that agree to the last bit, and those whose
frame is missing: they are not recomputed.
"""

import dataclasses
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from dexsim import load_hand
from dexsim.calibration.maps import calibrated_hand, load_calibration
from dexsim.core.config import from_dict
from dexsim.hand.kinematics import Hand
from dexsim.hand.source import recorded_hand
from dexsim.observation import LayoutEntry, Readings, layout
from dexsim.task_spec import TaskSpec
from dexsim_real.control.controller import make_observe
from dexsim_real.core.log import Kind, LogError, LogReader, Record, reading
from dexsim_real.sensors.hand import HandMeasurement, HandSensing, HardwareConfig
from dexsim_real.wire import frames

MEASURED = ("joint_position", "joint_torque", "taxel_force")
_OTHERS = {"calibrate": "--from-log", "identify": "--identify --from-log"}
"""Logs of `python -m dexsim_real.calibrate`, by their task, and its options that read them."""


@dataclasses.dataclass
class Replay:
    """A recomputed log."""

    report: dict[str, Any]
    time: np.ndarray  # [T] s since the first tick
    measured: list[HandMeasurement]  # one per tick, recomputed
    ticks: list[dict[str, Any]]  # one per tick, as logged
    observation: np.ndarray  # [T, n] recomputed
    fields: tuple[LayoutEntry, ...]  # of the observation
    hand: Hand


def replay(path: Path, hand: str = "") -> Replay:
    """Recompute a log.

    Args:
      path: of the log.
      hand: TOML of the hand, where it is not in the place that the log names.

    Raises:
      ConfigError: the log is of another hand.
      LogError: not a log, or one of another command, or the log ends before the hand was ready.
    """
    with reading(path):
        return _replay(path, hand)


def _replay(path: Path, hand: str) -> Replay:
    reader, run = LogReader(path), None
    notes, end = list[str](), "truncated"
    for record in reader:
        if record.kind == Kind.META and "from" not in record.content:
            run = _Run(path, record.content, hand)
        elif record.kind == Kind.NOTE:
            notes.append(f"{record.time:.3f} {record.content}")
        elif record.kind == Kind.END:
            end = record.content["end"]
        elif run is not None:
            run.add(record)
    if run is None:
        raise LogError(f"{path}: the log ends before the hand was ready; its notes: {'; '.join(notes) or 'none'}")
    report = {
        "log": str(path),
        "task": run.meta["task"],
        "policy": run.meta["policy"],
        "ticks": len(run.ticks),
        **run.counts,
        "seconds": run.times[-1] - run.times[0] if run.times else 0.0,
        "first_difference": run.first or None,
        "damaged_bytes": reader.damaged,
        "ended": end,
        "notes": notes,
        "recorded_on": run.meta["environment"],
    }
    since = np.array(run.times) - (run.times[0] if run.times else 0.0)
    return Replay(report, since, run.measured, run.ticks, np.array(run.observations), run.fields, run.sensing.hand)


class _Run:
    """Recomputes the ticks of a run from its records.

    Args:
      path: of the log.
      meta: configuration of the run.
      hand: see `replay`.
    """

    def __init__(self, path: Path, meta: dict[str, Any], hand: str):
        if options := _OTHERS.get(str(meta.get("task"))):
            raise LogError(f"{path}: not a log of a run; `python -m dexsim_real.calibrate {options} {path}` reads it")
        self.meta = meta
        self.sensing, self._observe, self.fields = _rebuild(meta, hand)
        self.counts = dict.fromkeys(("frames", "readings_same", "observations_same", "without_frame"), 0)
        self.first = ""  # difference
        self.times, self.ticks = list[float](), list[dict[str, Any]]()
        self.measured, self.observations = list[HandMeasurement](), list[np.ndarray]()
        self._states: dict[int, bytes] = {}
        self._tares = [(0, self.sensing.tare)]  # with the number of the exchange from which on one holds

    def add(self, record: Record) -> None:
        """Take in a record that is no note."""
        content = record.content
        if record.kind == Kind.META:
            self._tares.append((content["from"], content["tare"]))
        elif record.kind == Kind.RECEIVED:
            number, frame = content
            self.counts["frames"] += 1
            if frame[4:5] == bytes([frames.Command.EXCHANGE]):
                self._states[number] = frame
                self._states.pop(number - 50, None)
        elif record.kind == Kind.TICK:
            frame = self._states.get(content["sequence"])
            if frame is None:
                self.counts["without_frame"] += 1
            else:
                self._compare(record.time, content, frame)

    def _compare(self, time: float, tick: dict[str, Any], frame: bytes) -> None:
        # The exchange thread may have changed the tare before the tick's record was written.
        self.sensing.tare = next(tare for begin, tare in reversed(self._tares) if begin <= tick["sequence"])
        measured = self.sensing.measure(frames.decode_state(frame[frames.HEADER.size : -2]))
        same = all(_same(getattr(measured, name), tick["readings"][name]) for name in MEASURED)
        # The hand's measurements are recomputed; camera, goal and command are taken from the log.
        again = {**tick["readings"], **{name: getattr(measured, name) for name in MEASURED}}
        observation = np.asarray(self._observe(Readings(**again)))
        identical = _same(observation, tick["observation"])
        self.counts["readings_same"] += same
        self.counts["observations_same"] += identical
        if not (same and identical or self.first):
            self.first = f"tick {len(self.ticks)} at {time:.3f} s"
        self.times.append(time)
        self.measured.append(measured)
        self.ticks.append(tick)
        self.observations.append(observation)


def _rebuild(meta: dict[str, Any], given: str) -> tuple[HandSensing, Any, tuple[LayoutEntry, ...]]:
    """Sensing, observation function and observation fields of a logged run."""
    hand, calibration = recorded_hand(meta.get("hand"), given, "the log") or load_hand(), None
    if meta["calibration"]:
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "calibration.toml"
            path.write_text(meta["calibration"])
            calibration = load_calibration(path, hand)
    sensing = HandSensing(hand, from_dict(HardwareConfig, meta["hardware"]), calibration)
    sensing.tare = np.array(meta["tare"], np.float32)
    spec = from_dict(TaskSpec, meta["spec"])
    names, config = spec.fields, spec.observation
    return sensing, make_observe(calibrated_hand(hand, calibration), names, config), layout(hand, names, config)


def _same(a: np.ndarray, b: np.ndarray) -> bool:
    """Whether two arrays agree to the last bit."""
    return a.dtype == b.dtype and a.shape == b.shape and a.tobytes() == b.tobytes()
