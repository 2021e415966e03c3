"""Recomputes every observation of a logged run from the raw frames.

Joint angles, torques and taxel forces are recomputed from the frame that each tick used, and the observation from the
readings, by the code that ran on the hand. The report counts the ticks that agree to the last bit, and those whose
frame is missing: they are not recomputed.
"""

import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from dexsim import load_hand
from dexsim.calibration.maps import calibrated_hand, load_calibration
from dexsim.core.config import from_dict
from dexsim.hand.source import recorded_hand
from dexsim.observation import Readings, layout
from dexsim.task_spec import TaskSpec
from dexsim_real.control.controller import make_observe
from dexsim_real.core.log import Kind, LogError, LogReader, Record, reading
from dexsim_real.sensors.hand import HandMeasurement, HandSensing, HardwareConfig
from dexsim_real.wire import frames

_KEPT = 50  # newest frames, of which a tick used one
_OTHERS = {"calibrate": "--from-log", "identify": "--identify --from-log"}
"""Logs of `python -m dexsim_real.calibrate`, by their task, and its options that read them."""


class Replay:
    """A log that is recomputed record by record; `meta` is the configuration of the run."""

    def __init__(self, path: Path, meta: dict[str, Any], hand: str):
        if options := _OTHERS.get(str(meta.get("task"))):
            raise LogError(f"{path}: not a log of a run; `python -m dexsim_real.calibrate {options} {path}` reads it")
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
        self.report: dict[str, Any] = {"log": str(path)} | {name: meta[name] for name in ("task", "policy")}
        self.report |= dict.fromkeys(("frames", "readings_same", "observations_same", "without_frame"), 0)
        self.report |= {"first_difference": None, "ended": "truncated", "recorded_on": meta["environment"]}
        self.ticks, self.measured = list[dict[str, Any]](), list[HandMeasurement]()  # as logged; recomputed
        self._times, self._observations = list[float](), list[np.ndarray]()
        self._states: dict[int, bytes] = {}
        self._tares = [(0, np.array(meta["tare"], np.float32))]  # and the number of the exchange from which on it holds

    @property
    def time(self) -> np.ndarray:
        """[T] s since the first tick."""
        return np.array(self._times) - (self._times[0] if self._times else 0.0)

    @property
    def observation(self) -> np.ndarray:
        """[T, n] recomputed."""
        return np.array(self._observations)

    def add(self, record: Record) -> None:
        """Take in the next record."""
        content, report = record.content, self.report
        if record.kind == Kind.META:
            self._tares.append((content["from"], content["tare"]))
        elif record.kind == Kind.RECEIVED:
            number, frame = content
            report["frames"] += 1
            if frame[4:5] == bytes([frames.Command.EXCHANGE]):
                self._states[number] = frame
                self._states.pop(number - _KEPT, None)
        elif record.kind == Kind.TICK:
            frame = self._states.get(content["sequence"])
            report["without_frame"] += frame is None
            if frame is not None:
                self._compare(record.time, content, frame)
        elif record.kind == Kind.END:
            report["ended"] = content["end"]

    def _compare(self, time: float, tick: dict[str, Any], frame: bytes) -> None:
        # The exchange thread may have changed the tare before the tick's record was written.
        self._sensing.tare = next(tare for begin, tare in reversed(self._tares) if begin <= tick["sequence"])
        measured = self._sensing.measure(self._sensing.decode(frame[frames.HEADER.size : -2]))
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


def replay(path: Path, hand: str = "") -> Replay:
    """Recompute a log; `hand` is the TOML of the hand, where it is not in the place that the log names.

    Raises:
      ConfigError: the log is of another hand.
      LogError: not a log, or one of another command, or the log ends before the hand was ready.
    """
    reader, run, notes = LogReader(path), None, list[str]()
    with reading(path):
        for record in reader:
            if record.kind == Kind.META and "from" not in record.content:
                run = Replay(path, record.content, hand)
            elif record.kind == Kind.NOTE:
                notes.append(f"{record.time:.3f} {record.content}")
            elif run is not None:
                run.add(record)
    if run is None:
        raise LogError(f"{path}: the log ends before the hand was ready; its notes: {'; '.join(notes) or 'none'}")
    time = run.time
    run.report |= {"ticks": len(time), "seconds": float(time[-1]) if len(time) else 0.0}
    run.report |= {"damaged_bytes": reader.damaged, "notes": notes}
    return run


def _same(a: np.ndarray, b: np.ndarray) -> bool:
    """Whether two arrays agree to the last bit."""
    return a.dtype == b.dtype and a.shape == b.shape and a.tobytes() == b.tobytes()
