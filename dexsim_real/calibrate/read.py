"""Reads the logs of this command: marked exchanges, and from them one `Recording` per press."""

import dataclasses
from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

import numpy as np

from dexsim.core.config import from_dict
from dexsim.hand.description import Hand
from dexsim_real.calibrate.procedure import RELEASED, REST
from dexsim_real.core.log import Kind, LogError, LogReader, Record, reading
from dexsim_real.sensors.hand import HandSensing, HardwareConfig
from dexsim_real.wire.identity import Identity


class Source(NamedTuple):
    """How logs were recorded, and on which hand."""

    hardware: HardwareConfig
    rate: float  # Hz
    identity: Identity


def read_logs(paths: Iterable[Path], task: str) -> tuple[Source, list[list[Record]]]:
    """The source of logs of one hand, task and configuration; of each log the further settings and marked exchanges.

    Raises:
      LogError: a log of another task, hand or configuration than the logs before.
    """
    sources, logs = list[Source](), []
    for path in paths:
        records = []
        with reading(path):
            for record in LogReader(path):
                content = record.content
                if record.kind == Kind.META and "task" in content:
                    if content["task"] != task:
                        raise LogError(f"{path}: this is a log of {content['task']!r}; give one of {task!r}")
                    identity = Identity(content["serial"], content["handedness"])
                    hardware = from_dict(HardwareConfig, content["hardware"])
                    sources.append(Source(hardware, float(content["rate"]), identity))
                elif record.kind in (Kind.META, Kind.TICK):
                    records.append(record)
        logs.append(records)
        if len(sources) < len(logs):
            raise LogError(f"{path}: the log ends before the hand was ready; record again")
        for what, own, first in zip(("--hardware options", "--rate", "hand"), sources[-1], sources[0], strict=True):
            if own != first:
                raise LogError(f"{path}: has another {what} than the logs before: {own!r:.80}")
    return sources[0], logs


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


def read_presses(paths: Iterable[Path], hand: Hand) -> tuple[Source, dict[str, Recording]]:
    """The presses in logs of `dexsim_real.calibrate`. A press in several logs is taken from the last that finished it.

    Raises:
      LogError: not a log of presses, or recorded with other settings than the logs before.
    """
    source, logs = read_logs(paths, "calibrate")
    recordings: dict[str, Recording] = {}
    for records in logs:
        for name, press in _presses(source, records, hand).items():
            before = recordings.get(name)
            # A press that was skipped or missed is in its log without samples.
            if before is None or press.time and (press.finished or not before.time):
                recordings[name] = press
    return source, recordings


def _presses(source: Source, records: list[Record], hand: Hand) -> dict[str, Recording]:
    sensing, recordings, slant = HandSensing(hand, source.hardware), dict[str, Recording](), list[np.ndarray]()
    for record in records:
        content = record.content
        if "tare" in content:
            sensing.tare = np.array(content["tare"], np.float32)
        if "placement" in content:
            name, finger, joints = (content["placement"][key] for key in ("name", "finger", "joints"))
            recordings[name] = Recording(name, finger, tuple(joints), source.rate)
        if record.kind == Kind.META:
            continue
        press = recordings.get(content["press"])
        if press is not None and "gauge" in content:
            press.gauge[content["phase"]] = float(content["gauge"])
            continue
        state = sensing.decode(content["answer"])
        shear = np.stack([state["tip"]["taxel"][axis].sum(-1, dtype=float) for axis in "xy"], -1)  # [F, 2]
        if content["phase"] == REST:
            slant.append(shear)
        if press is not None:
            measured, finger = sensing.measure(state), press.finger
            press.phase.append(content["phase"])
            press.time.append(record.time)
            press.counts.append(sensing.counts(state)[finger].astype(float) - sensing.tare[finger].astype(float))
            press.shear.append(shear[finger])
            press.current.append(state["joint"]["current"].astype(float) * 1e-3)
            press.position.append(measured.joint_position.astype(float))
    if slant:  # A taxel may read some x and y that no shear has caused.
        zero = np.mean(slant, 0)
        for press in recordings.values():
            press.shear = [shear - zero[press.finger] for shear in press.shear]
    return recordings
