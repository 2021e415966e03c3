"""Reads the logs of a press session: one `Recording` per press."""

import dataclasses
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from dexsim.core.config import from_dict
from dexsim.hand.kinematics import Hand
from dexsim_real.calibrate.options import CheckConfig
from dexsim_real.calibrate.press_procedure import RELEASED, REST
from dexsim_real.calibrate.taxel_check import raw_sensing
from dexsim_real.core.log import Kind, LogError, LogReader, reading
from dexsim_real.sensors.hand import HandSensing, HardwareConfig
from dexsim_real.wire import frames


@dataclasses.dataclass
class Recording:
    """One press; the lists have T samples in the order of time."""

    name: str
    finger: int
    joints: tuple[int, ...]  # joints that pressed
    rate: float  # samples per second
    tare: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros(frames.TAXELS))  # [N] counts
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

    hardware: HardwareConfig
    check: CheckConfig
    serial: str  # of the hand, as it told it
    handedness: str
    rate: float
    recordings: dict[str, Recording]
    rest_current: np.ndarray  # [T, J] A, motors off


def read_logs(paths: Iterable[Path], hand: Hand) -> PressSession:
    """The presses in logs of `dexsim_real.calibrate`. A press in several logs is taken from the last that finished it.

    Raises:
      LogError: not a log of presses, or recorded with other settings than the logs before.
    """
    session: PressSession | None = None
    for path in paths:
        with reading(path):
            newer = _Reader(Path(path), hand).read()
        if session is None:
            session = newer
        elif (newer.hardware, newer.rate) != (session.hardware, session.rate):
            raise LogError(f"{path}: recorded with other --hardware options or another --rate than the logs before")
        elif newer.serial != session.serial:
            raise LogError(f"{path}: is of hand {newer.serial!r}, the logs before of hand {session.serial!r}")
        else:
            for name, press in newer.recordings.items():
                before = session.recordings.get(name)
                # A press that was skipped or missed is in its log without samples.
                if press.time and (press.finished or before is None or not before.time):
                    session.recordings[name] = press
    assert session is not None, "no log given"
    return session


class _Reader:
    def __init__(self, path: Path, hand: Hand):
        self._path, self._hand, self._number, self._frame = path, hand, -1, b""

    def read(self) -> PressSession:
        session, rest, slant = None, list[np.ndarray](), list[np.ndarray]()
        for record in LogReader(self._path):
            content = record.content
            if record.kind == Kind.META and "task" in content:
                session = self._begin(content)
            elif session is None:
                continue
            elif record.kind == Kind.META:
                self._configure(session, content)
            elif record.kind == Kind.RECEIVED:
                self._number, self._frame = content
            elif record.kind == Kind.TICK:
                self._sample(session, record.time, content, rest, slant)
        if session is None:
            raise LogError(f"{self._path}: the log ends before the hand was ready; record again")
        session.rest_current = np.array(rest)
        if slant:  # A taxel may read some x and y that no shear has caused.
            zero = np.mean(slant, 0)
            for recording in session.recordings.values():
                recording.shear = [shear - zero[recording.finger] for shear in recording.shear]
        return session

    def _begin(self, meta: dict[str, Any]) -> PressSession:
        if meta["task"] != "calibrate":
            raise LogError(f"{self._path}: this is a log of {meta['task']!r}; give a log of `dexsim_real.calibrate`")
        hardware = from_dict(HardwareConfig, meta["hardware"])
        self._sensing, self._raw = HandSensing(self._hand, hardware), raw_sensing(self._hand, hardware)
        check = from_dict(CheckConfig, meta["check"])
        return PressSession(hardware, check, meta["serial"], meta["handedness"], float(meta["rate"]), {}, np.empty(0))

    def _configure(self, session: PressSession, content: dict[str, Any]) -> None:
        if "tare" in content:
            self._sensing.tare = np.array(content["tare"], np.float32)
        if "placement" in content:
            name, finger, joints = (content["placement"][key] for key in ("name", "finger", "joints"))
            session.recordings[name] = Recording(name, finger, tuple(joints), session.rate)

    def _sample(
        self,
        session: PressSession,
        time: float,
        tick: dict[str, Any],
        rest: list[np.ndarray],
        slant: list[np.ndarray],
    ) -> None:
        recording = session.recordings.get(tick["press"])
        if recording is not None and "gauge" in tick:
            recording.gauge[tick["phase"]] = float(tick["gauge"])
            return
        if tick["sequence"] != self._number:
            return
        state = frames.decode_state(self._frame[frames.HEADER.size : -2])
        current = state["joint"]["current"].astype(float) * 1e-3
        taxel = state["tip"]["taxel"]
        shear = np.stack([taxel[axis].sum(-1, dtype=float) for axis in "xy"], -1)  # [F, 2]
        if tick["phase"] == REST:
            rest.append(current)
            slant.append(shear)
        if recording is None:
            return
        measured, finger = self._sensing.measure(state), recording.finger
        recording.tare = self._sensing.tare[finger].astype(float)
        recording.phase.append(tick["phase"])
        recording.time.append(time)
        recording.counts.append(self._raw.measure(state).taxel_force[finger].astype(float) - recording.tare)
        recording.shown.append(float(measured.taxel_force[finger].sum()) / session.hardware.force_per_count)
        recording.shear.append(shear[finger])
        recording.current.append(current)
        recording.position.append(measured.joint_position.astype(float))
