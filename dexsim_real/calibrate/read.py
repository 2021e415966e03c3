"""Reads the logs of this command: marked exchanges, and from them one `Recording` per press."""

import dataclasses
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from dexsim.core.config import from_dict
from dexsim.hand.kinematics import Hand
from dexsim_real.calibrate.procedure import RELEASED, REST
from dexsim_real.core.log import Kind, LogError, LogReader, reading
from dexsim_real.sensors.hand import HandSensing, HardwareConfig
from dexsim_real.wire import frames
from dexsim_real.wire.identity import Identity


class Source(NamedTuple):
    """How logs were recorded, and on which hand."""

    hardware: HardwareConfig
    rate: float  # Hz
    identity: Identity


class Mark(NamedTuple):
    """An annotated exchange."""

    time: float  # s, of the annotation
    content: dict[str, Any]
    sent: float  # s
    command: bytes  # payload
    answer: np.ndarray | None  # `frames.STATE_BLOCK`


def read_log(path: Path, task: str) -> tuple[Source, list[Mark | dict[str, Any]]]:
    """Source of a log of this task, and in the order of time its exchanges and further settings.

    Raises:
      LogError: it is another log.
    """
    source, entries = None, list[Mark | dict[str, Any]]()
    # The first exchange that is recorded may be unanswered, and a damaged log may lack any record.
    sent, sent_at, received = (-1, b""), 0.0, (-1, b"")
    for record in LogReader(path):
        content = record.content
        if record.kind == Kind.META and "task" in content:
            if content["task"] != task:
                raise LogError(f"{path}: this is a log of {content['task']!r}; give one of {task!r}")
            identity = Identity(content["serial"], content["handedness"])
            source = Source(from_dict(HardwareConfig, content["hardware"]), float(content["rate"]), identity)
        elif record.kind == Kind.META:
            entries.append(content)
        elif record.kind == Kind.SENT:
            sent, sent_at = content, record.time
        elif record.kind == Kind.RECEIVED:
            received = content
        elif record.kind == Kind.TICK and sent[0] == content["sequence"]:
            answer = None
            if received[0] == content["sequence"]:
                answer = frames.decode_state(received[1][frames.HEADER.size : -2])
            entries.append(Mark(record.time, content, sent_at, sent[1][frames.HEADER.size : -2], answer))
    if source is None:
        raise LogError(f"{path}: the log ends before the hand was ready; record again")
    return source, entries


def read_same(paths: Iterable[Path], task: str, use: Callable[[Source, list[Mark | dict[str, Any]]], None]) -> Source:
    """Read logs of one hand with one configuration one after another; the source of them all.

    Raises:
      LogError: a log of another task, hand or configuration than the logs before.
    """
    first: Source | None = None
    for path in paths:
        with reading(path):
            source, entries = read_log(Path(path), task)
            first = first or source
            for what, own, before in zip(("--hardware options", "--rate", "hand"), source, first, strict=True):
                if own != before:
                    raise LogError(f"{path}: has another {what} than the logs before: {own!r:.80}")
            use(source, entries)
    assert first is not None, "no log given"
    return first


@dataclasses.dataclass
class Recording:
    """One press; the lists have T samples in the order of time."""

    name: str
    finger: int
    joints: tuple[int, ...]  # joints that pressed
    rate: float  # samples per second
    phase: list[str] = dataclasses.field(default_factory=list)
    time: list[float] = dataclasses.field(default_factory=list)  # s
    counts: list[np.ndarray] = dataclasses.field(default_factory=list)  # [N] tared, negative ones included
    shown: list[float] = dataclasses.field(default_factory=list)  # counts of the fingertip as in a run
    shear: list[np.ndarray] = dataclasses.field(default_factory=list)  # [2] counts, sums of x and y beyond the rest's
    current: list[np.ndarray] = dataclasses.field(default_factory=list)  # [J] A, with the sign of the hand
    position: list[np.ndarray] = dataclasses.field(default_factory=list)  # [J] rad
    gauge: dict[str, float] = dataclasses.field(default_factory=dict)  # N by phase

    def samples(self, *phases: str) -> np.ndarray:
        """Indices of the samples of these phases."""
        return np.flatnonzero(np.isin(self.phase, phases))

    @property
    def finished(self) -> bool:
        """Whether the fingertip was freed at the end; otherwise the press was interrupted."""
        return RELEASED in self.phase


@dataclasses.dataclass
class PressSession:
    """The content of one or several logs of presses."""

    source: Source
    recordings: dict[str, Recording]


def read_presses(paths: Iterable[Path], hand: Hand) -> PressSession:
    """The presses in logs of `dexsim_real.calibrate`. A press in several logs is taken from the last that finished it.

    Raises:
      LogError: not a log of presses, or recorded with other settings than the logs before.
    """
    recordings: dict[str, Recording] = {}

    def use(source: Source, entries: list[Mark | dict[str, Any]]) -> None:
        for name, press in _presses(source, entries, hand).items():
            before = recordings.get(name)
            # A press that was skipped or missed is in its log without samples.
            if before is None or press.time and (press.finished or not before.time):
                recordings[name] = press

    return PressSession(read_same(paths, "calibrate", use), recordings)


def _presses(source: Source, entries: list[Mark | dict[str, Any]], hand: Hand) -> dict[str, Recording]:
    sensing, recordings, slant = HandSensing(hand, source.hardware), dict[str, Recording](), list[np.ndarray]()
    for entry in entries:
        if isinstance(entry, dict):
            if "tare" in entry:
                sensing.tare = np.array(entry["tare"], np.float32)
            if "placement" in entry:
                name, finger, joints = (entry["placement"][key] for key in ("name", "finger", "joints"))
                recordings[name] = Recording(name, finger, tuple(joints), source.rate)
            continue
        recording, phase = recordings.get(entry.content["press"]), entry.content["phase"]
        if recording is not None and "gauge" in entry.content:
            recording.gauge[phase] = float(entry.content["gauge"])
        elif entry.answer is not None:
            taxel = entry.answer["tip"]["taxel"]
            shear = np.stack([taxel[axis].sum(-1, dtype=float) for axis in "xy"], -1)  # [F, 2]
            if phase == REST:
                slant.append(shear)
            if recording is not None:
                _add_sample(recording, entry.time, phase, entry.answer, sensing, shear)
    if slant:  # A taxel may read some x and y that no shear has caused.
        zero = np.mean(slant, 0)
        for recording in recordings.values():
            recording.shear = [shear - zero[recording.finger] for shear in recording.shear]
    return recordings


def _add_sample(
    press: Recording, time: float, phase: str, state: np.ndarray, sensing: HandSensing, shear: np.ndarray
) -> None:
    measured, finger = sensing.measure(state), press.finger
    press.phase.append(phase)
    press.time.append(time)
    press.counts.append(sensing.counts(state)[finger].astype(float) - sensing.tare[finger].astype(float))
    press.shown.append(float(measured.taxel_force[finger].sum()) / sensing.config.force_per_count)
    press.shear.append(shear[finger])
    press.current.append(state["joint"]["current"].astype(float) * 1e-3)
    press.position.append(measured.joint_position.astype(float))
