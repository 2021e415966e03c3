"""Reads the logs of this command: marked exchanges, and from them one `Recording` per press."""

import dataclasses
from collections.abc import Iterable
from pathlib import Path
from typing import Any, NamedTuple

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
    """One press; T samples in the order of time."""

    name: str
    finger: int
    joints: tuple[int, ...]  # joints that pressed
    rate: float  # samples per second
    gauge: dict[str, float]  # N by phase
    phase: np.ndarray  # [T] str
    time: np.ndarray  # [T] s
    counts: np.ndarray  # [T, N] tared, negative ones included
    shear: np.ndarray  # [T, 2] counts, sums of x and y beyond the rest's
    current: np.ndarray  # [T, J] A, with the sign of the hand
    position: np.ndarray  # [T, J] rad

    def at(self, *phases: str) -> np.ndarray:
        """Mask [T] of the samples of these phases."""
        return np.isin(self.phase, phases)

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
        for press in _presses(source, records, hand):
            if press.finished or press.name not in recordings:
                recordings[press.name] = press
    return source, recordings


def _presses(source: Source, records: list[Record], hand: Hand) -> list[Recording]:
    """The presses of one log; those that were skipped or missed have no samples and are none."""
    sensing, slant = HandSensing(hand, source.hardware), list[np.ndarray]()
    presses = dict[str, tuple[dict[str, Any], dict[str, float], list[tuple[Any, ...]]]]()
    for record in records:
        content = record.content
        if "tare" in content:
            sensing.tare = np.array(content["tare"], np.float32)
        if "placement" in content:
            presses[content["placement"]["name"]] = content["placement"], {}, []
        if record.kind == Kind.META:
            continue
        placement, gauge, samples = presses.get(content["press"], ({"finger": 0}, {}, []))
        if "gauge" in content:
            gauge[content["phase"]] = float(content["gauge"])
            continue
        state, finger = sensing.decode(content["answer"]), placement["finger"]
        shear = np.stack([state["tip"]["taxel"][axis].sum(-1, dtype=float) for axis in "xy"], -1)  # [F, 2]
        if content["phase"] == REST:
            slant.append(shear)
        counts = sensing.counts(state)[finger].astype(float) - sensing.tare[finger]
        current, position = 1e-3 * state["joint"]["current"], sensing.measure(state).joint_position.astype(float)
        samples.append((content["phase"], record.time, counts, shear[finger], current, position))
    zero = np.mean(slant, 0) if slant else np.zeros((hand.num_fingers, 2))  # A taxel may read x and y without shear.
    recordings = []
    for name, (placement, gauge, samples) in presses.items():
        if samples:
            phase, time, counts, shear, *rest = (np.array(column) for column in zip(*samples, strict=True))
            finger, joints = placement["finger"], tuple(placement["joints"])
            parts = (phase, time, counts, shear - zero[finger], *rest)
            recordings.append(Recording(name, finger, joints, source.rate, gauge, *parts))
    return recordings
