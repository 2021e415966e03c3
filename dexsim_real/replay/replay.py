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
from dexsim_real.core.log import Kind, LogError, LogReader, reading
from dexsim_real.sensors.hand import HandMeasurement, HandSensing, HardwareConfig
from dexsim_real.wire import frames

MEASURED = ("joint_position", "joint_torque", "taxel_force")
_OTHERS = {
    "calibrate": ("a calibration", "--from-log"),
    "identify": ("an identification", "--identify --from-log"),
}
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
    reader = LogReader(path)
    states: dict[int, bytes] = {}
    times, measured, observations, notes = [], [], [], []
    ticks: list[Any] = []
    fields: tuple[LayoutEntry, ...] = ()
    tares: list[tuple[int, np.ndarray]] = []  # number of the exchange from which on one holds
    counts = dict.fromkeys(("frames", "readings_same", "observations_same", "without_frame"), 0)
    first, meta, end = "", None, None
    for record in reader:
        if record.kind == Kind.META and "from" in record.content:
            tares.append((record.content["from"], record.content["tare"]))
        elif record.kind == Kind.META:
            meta = record.content
            _check_run(path, meta)
            sensing, observe, fields = _rebuild(meta, hand)
            tares = [(0, sensing.tare)]
        elif record.kind == Kind.RECEIVED:
            number, frame = record.content
            counts["frames"] += 1
            if frame[4:5] == bytes([frames.Command.EXCHANGE]):
                states = {**{n: f for n, f in states.items() if n > number - 50}, number: frame}
        elif record.kind == Kind.TICK and meta is not None:
            tick = record.content
            frame = states.get(tick["sequence"])
            if frame is None:
                counts["without_frame"] += 1
                continue
            # The exchange thread may have changed the tare before the tick's record was written.
            sensing.tare = next(tare for begin, tare in reversed(tares) if begin <= tick["sequence"])
            now = sensing.measure(frames.decode_state(frame[frames.HEADER.size : -2]))
            same = all(_same(getattr(now, name), tick["readings"][name]) for name in MEASURED)
            # The hand's measurements are recomputed; camera, goal and command are taken from the log.
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
            observations.append(observation)
        elif record.kind == Kind.NOTE:
            notes.append(f"{record.time:.3f} {record.content}")
        elif record.kind == Kind.END:
            end = record.content
    if meta is None:
        raise LogError(f"{path}: the log ends before the hand was ready; its notes: {'; '.join(notes) or 'none'}")
    report = {
        "log": str(path),
        "task": meta["task"],
        "policy": meta["policy"],
        "ticks": len(ticks),
        **counts,
        "seconds": times[-1] - times[0] if times else 0.0,
        "first_difference": first or None,
        "damaged_bytes": reader.damaged,
        "ended": end["end"] if end else "truncated",
        "notes": notes,
        "recorded_on": meta["environment"],
    }
    since = np.array(times) - (times[0] if times else 0.0)
    return Replay(report, since, measured, ticks, np.array(observations), fields, sensing.hand)


def _check_run(path: Path, meta: dict[str, Any]) -> None:
    """Refuse a configuration that is not of a run."""
    if other := _OTHERS.get(str(meta.get("task"))):
        what, options = other
        raise LogError(f"{path}: this is a log of {what}; `python -m dexsim_real.calibrate {options} {path}` reads it")
    needed = ("task", "policy", "calibration", "tare", "hardware", "environment")
    lacking = [name for name in needed if name not in meta]
    if lacking:
        raise LogError(f"{path}: this is not a log of a run: its configuration lacks {lacking[0]!r}")


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
