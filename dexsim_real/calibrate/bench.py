"""A hand on the bench: options, the exchange loop of a procedure that moves and measures, the person beside it, and
the logs of all that."""

import contextlib
import dataclasses
import io
import re
import sys
import termios
import threading
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, NamedTuple, TextIO

import numpy as np

from dexsim.calibration.maps import load_calibration
from dexsim.core import cli
from dexsim.core.config import Config, from_dict, setting, to_dict
from dexsim.hand.description import Hand
from dexsim_real.control.controller import smooth
from dexsim_real.control.limits import SafetyConfig
from dexsim_real.control.safety import HandSample, Reaction, Safety
from dexsim_real.core.errors import HandError
from dexsim_real.core.log import Kind, LogError, LogReader, LogWriter, Record, reading
from dexsim_real.core.process import leave_realtime, use_realtime
from dexsim_real.loop import ExchangeLoop, LoopConfig
from dexsim_real.sensors.hand import HandSensing, HardwareConfig
from dexsim_real.wire.driver import open_port
from dexsim_real.wire.link import UNCONFIRMED, HandPort, Identity

_PATIENCE = 2.0  # s, longest hold by `Safety` or silence of the hand
_READING = re.compile(r"([0-9]+(?:[.,][0-9]*)?|[.,][0-9]+)\s*(n|g|kg|)", re.IGNORECASE)
_NEWTONS = {"": 1.0, "n": 1.0, "g": 9.80665e-3, "kg": 9.80665}
_LARGEST = 100.0  # N, largest plausible reading


@dataclasses.dataclass(frozen=True, kw_only=True)
class PressConfig(Config):
    """Forces and speeds of a press."""

    peak: float = setting(8.0, unit="N", low=1.0, high=20.0)
    """Peak force of a press, measured by the taxels; choose it above the forces of the task."""
    current: float = setting(1.4, unit="A", low=0.01, high=10.0)
    """Current of a joint above which the press ends before its peak force."""
    cycles: int = setting(4, unit="1", low=1, high=20)
    """Number of presses, each with rising and falling force. The first one finds the travel."""
    seconds: float = setting(6.0, unit="s", low=0.5, high=60.0)
    """Time from contact to peak force, and back. Long, so that the current shows force and friction only."""
    first_speed: float = setting(0.06, unit="rad/s", low=0.005, high=1.0)
    """Speed of the joint targets in the first press."""
    approach_speed: float = setting(0.15, unit="rad/s", low=0.01, high=2.0)
    """Speed of the joint targets until contact."""
    pause: float = setting(0.5, unit="s", low=0.1, high=10.0)
    """Pause before a measurement."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class CalibrateArguments(LoopConfig):
    """Options of `python -m dexsim_real.calibrate`."""

    port: str | None = None
    """Serial port of the XHand (names under /dev/serial/by-id are stable), or sdk:MODULE:FUNCTION for the driver of
    another hand (docs/bridge.md). None only with --from-log."""
    hand: str = ""
    """The TOML of a hand, or the name of a shipped one (`xhand_left`); empty for the right XHand."""
    output: Path | None = None
    """Output file; None for hand.toml, or hand.json with --identify."""
    force: bool = False
    """Overwrite an existing output file."""
    from_log: tuple[Path, ...] = ()
    """Fit logs of this command again, without a hand. A press in several logs is taken from the last that
    finished it."""
    identify: bool = False
    """Identify the drives instead: move each free joint, and fit stiffness, damping, friction and latency."""
    gauge: bool = False
    """Compare the taxels with a kitchen scale or force gauge, whose readings you type. Otherwise the taxels are the
    reference, as in the paper."""
    fingers: tuple[str, ...] = ()
    """Fingers to press; all by default. The other joints get the mean of those with the same torque limit."""
    sides: bool = True
    """Also press with the sides of thumb and index finger, to load the joints that spread them."""
    yes: bool = False
    """Ask nothing: assume that the fingers always have something to press on."""
    calibration: Path | None = None
    """With --identify: calibration file of this hand; None leaves torques unknown."""
    joints: tuple[str, ...] = ()
    """With --identify: joints to move; all by default."""
    plot: Path | None = None
    """Image file for the figure (.png, .pdf or .svg); None draws no figure."""
    log: Path | None = None
    """Log file; None for a new file in runs/real."""
    realtime: bool = True
    """Request real-time priority; continue without it if not permitted."""
    press: PressConfig = setting(PressConfig())
    """Presses."""
    safety: SafetyConfig = setting(SafetyConfig(watchdog=0.3, stale=0.15, stall_current=1.8))
    """Safety limits. Presses hold still at currents that a run need not hold."""

    def __post_init__(self):
        super().__post_init__()
        if (self.port is None) == (not self.from_log):
            raise HandError("give --port for a hand, or --from-log FILE for a log of this command")
        if self.destination.exists() and not self.force:
            raise HandError(f"{self.destination} already exists: give another --output, or --force to overwrite it")
        outputs = {"--output": self.destination, "--plot": self.plot, "--log": self.log}
        inputs = {f"--from-log {path}": path for path in self.from_log}
        cli.check_no_overwrite(outputs, inputs | {"calibration": self.calibration})
        if self.gauge and self.yes:
            raise HandError("--gauge needs answers, but --yes asks nothing; remove one of them")
        # With another finger or joint than meant the wrong one would move.
        for name in ("fingers", "gauge", "plot") if self.identify else ("joints",):
            if getattr(self, name):
                raise HandError(f"--{name} is {'not' if self.identify else 'only'} for --identify")
        if self.press.current >= self.safety.current:
            raise HandError(f"--press.current must be below --safety.current, {self.safety.current:g} A")
        if self.press.peak >= 0.9 * self.safety.finger_force:
            raise HandError(f"--press.peak must be well below --safety.finger-force, {self.safety.finger_force:g} N")

    @property
    def destination(self) -> Path:
        return self.output or Path("hand.json" if self.identify else "hand.toml")


class Operator:
    """The person beside the hand, who reads `out` and answers on `stream`, by default the standard input.

    With `assume_yes` nothing is asked, and every answer is yes.
    """

    def __init__(self, out: TextIO, *, assume_yes: bool = False, stream: TextIO | None = None):
        self.out, self.assume_yes = out, assume_yes
        self._stream = stream or sys.stdin or io.StringIO()  # Python has no `sys.stdin` where it was closed.

    def tell(self, text: str) -> None:
        print(text, file=self.out, flush=True)

    def ask(self, text: str, meanwhile: Callable[[], object]) -> str | None:
        """Ask a question; returns the stripped answer, None for an s. `meanwhile` is called until it arrives.

        Raises HandError: the input is closed.
        """
        if self.assume_yes:
            return ""
        if self._stream.isatty():
            termios.tcflush(self._stream, termios.TCIFLUSH)  # Discard keys pressed before the question.
        self.tell(text)
        lines = [""]  # What remains if the terminal hangs up.

        def read() -> None:
            with contextlib.suppress(OSError, ValueError):
                lines.append(self._stream.readline())

        reader = threading.Thread(target=read, name="answer", daemon=True)
        reader.start()
        while reader.is_alive():
            meanwhile()
        if not lines[-1]:
            raise HandError("standard input is closed; run in a terminal, or give --yes")
        return None if (answer := lines[-1].strip()).lower() in ("s", "skip", "stop") else answer

    def ask_force(self, meanwhile: Callable[[], object]) -> float | None:
        """Ask for the reading of the gauge in N until it is one; None when the user skips it."""
        while True:
            text = self.ask("  reading of the gauge (newtons, or a number with g or kg; s skips):", meanwhile)
            if text is None:
                return None
            try:
                return parse_reading(text)
            except HandError as error:
                self.tell(f"  {error}")


def parse_reading(text: str) -> float:
    """Newtons from "5.2", "5.2 N", "530 g" or "0.53 kg".

    Raises HandError: not a number with a known unit, or more than a fingertip can press.
    """
    match = _READING.fullmatch(text.strip())
    if not match:
        raise HandError(f"{text.strip()!r} is not a reading: type newtons, or a number with g or kg")
    force = float(match[1].replace(",", ".")) * _NEWTONS[match[2].lower()]
    if force > _LARGEST:
        raise HandError(f"{text.strip()!r} is {force:.0f} N, more than a fingertip can press; grams need a g")
    return force


class Bench(ExchangeLoop):
    """The exchange loop, one `step` per cycle. A context manager that ends with the motors off.

    In a run a thread keeps the delays of a policy away from the hand. A procedure has no such delays, so one call makes
    an exchange and returns its result. The taxels' zeros stay as they were tared: what they read is measured.

    Args:
      port: replaces the port that the arguments name.
      clock: `clock` and `sleep` of `ExchangeLoop`, for simulated time.
    """

    def __init__(
        self,
        arguments: CalibrateArguments,
        hand: Hand,
        operator: Operator,
        *,
        port: HandPort | None = None,
        **clock: Any,
    ):
        self.arguments, self.operator = arguments, operator
        port = port or open_port(str(arguments.port), hand, arguments.link)
        if not arguments.identify and (lacking := [name for name in port.missing if name != "temperatures"]):
            raise HandError(f"presses need taxels and currents, and the hand has no {lacking[0]}: --identify")
        self.log = LogWriter(arguments.log or Path("runs/real") / time.strftime("calibrate-%Y%m%d-%H%M%S.log"))
        safety = Safety(hand, arguments.safety, self._react)
        sensing = HandSensing(hand, arguments.hardware)
        super().__init__(port, sensing, safety, arguments.rate, track_taxels=False, **clock)
        self._newest: dict[str, Any] = {}  # the last exchange, as the log has it
        self._failing_since: float | None = None
        self._connection: int | None = None

    def __enter__(self) -> "Bench":
        arguments, hand = self.arguments, self.sensing.hand
        try:
            # Only during the procedure: long computations in a real-time thread would starve the machine.
            if arguments.realtime:
                use_realtime()
            calibration = load_calibration(arguments.calibration, hand) if arguments.calibration else None
            for line in self.port.greet(hand, calibration):
                self._say(line)
            meta = {name: to_dict(getattr(arguments, name)) for name in ("hardware", "safety", "press")}
            meta |= {"task": "identify" if arguments.identify else "calibrate", "rate": arguments.rate}
            meta |= {"identity": tuple(self.port.identity), "environment": cli.environment_report()}
            self.log.add(Kind.META, meta | {"clock": time.time()})
        except BaseException:
            self.__exit__(*sys.exc_info())
            raise
        return self

    def __exit__(self, kind: Any, error: Any, trace: Any) -> None:
        try:
            self.close()
        finally:
            end = "" if error is None else str(error) or kind.__name__
            if self.driven:
                self._say(f"{UNCONFIRMED}: press the emergency stop")
            self.log.add(Kind.NOTE, f"end: {end or 'done'}")
            self.log.add(Kind.END, {"end": end})
            self.log.close()
            if self.arguments.realtime:
                leave_realtime()
        if error is None and self.driven:
            raise HandError(f"{UNCONFIRMED}: press the emergency stop")
        if error is None and self.log.losses:
            raise HandError(self.log.losses)

    def step(self, target: np.ndarray | None = None) -> HandSample | None:
        """Make an exchange; None when it was not answered, or the measurement was implausible.

        `target` [J] rad are the requested joint targets, None keeps the last ones.

        Raises HandError: `Safety` turned the motors off, the hand was disconnected, or hold or silence lasted too long.
        """
        now = self.clock()
        if target is not None:
            self.safety.set_target(target, now)
        sample = self.cycle()
        answer = b"" if sample is None else sample.state.tobytes()
        self._newest = {"sent": now, "command": self.command["position"].copy(), "answer": answer}
        self._check(now, sample)
        self.pace.wait()
        return None if self.safety.problem else sample

    def annotate(self, mark: dict[str, Any]) -> None:
        """Log the newest exchange with an annotation."""
        self.log.add(Kind.TICK, mark | self._newest, self.clock())

    def collect(
        self, seconds: float, target: np.ndarray | None = None, mark: dict[str, Any] | None = None
    ) -> list[HandSample]:
        """The samples of this duration in s, logged with this annotation; errors as for `step`, or there is none."""
        until, samples = self.clock() + seconds, list[HandSample]()
        while self.clock() < until:
            if (sample := self.step(target)) is not None:
                samples.append(sample)
                if mark:
                    self.annotate(mark)
        if not samples:
            raise HandError(f"no usable answer in {seconds:g} s; check the cable")
        return samples

    def set_zero(self, samples: list[HandSample]) -> None:
        """Tare the taxels with samples of an untouched hand.

        Raises HandError: something touches a fingertip, or a taxel is stuck.
        """
        if stuck := self.sensing.set_tare([sample.state for sample in samples]):
            raise HandError(f"{'; '.join(stuck)}; power-cycle the hand")
        self.log.add(Kind.META, {"tare": self.sensing.tare})
        self.step()  # What `Safety` has seen so far was not tared.

    def await_motors(self) -> None:
        """Turn the motors on, and wait until they are."""
        self.engage()
        while not self.safety.anchor:
            self.step()

    def move(self, goal: np.ndarray, speed: float = 0.6) -> None:
        """Move to a posture [J] rad; the joint with the longest path has a mean speed of `speed` rad/s."""
        start, begin = self.safety.commanded, self.clock()  # Not the last reading, which may be wrong.
        seconds = max(float(np.abs(goal - start).max()) / speed, 0.3)
        while (share := (self.clock() - begin) / seconds) < 1.0:
            self.step(smooth(start, goal, share))
        self.step(goal)

    def _check(self, now: float, sample: HandSample | None) -> None:
        safety = self.safety
        if safety.latched:
            raise HandError(f"stopped: {safety.latched}")
        if self.log.failure:
            raise HandError(f"stopped: the log is lost ({self.log.failure})")
        if sample is not None:
            if self._connection not in (None, sample.generation):
                raise HandError("stopped: the hand was disconnected and its pose may have changed; start again")
            self._connection = sample.generation
        reaction, reason = safety.last
        working = sample is not None and (reaction <= Reaction.CLIP or not safety.engaged)
        self._failing_since = None if working else self._failing_since or now
        if self._failing_since is not None and now - self._failing_since > _PATIENCE:
            why = safety.alarms.refused or reason or "the hand does not answer"
            raise HandError(f"stopped: {why} for {_PATIENCE:g} s")

    def _react(self, text: str) -> None:
        self.log.add(Kind.NOTE, text)
        if text.startswith(("hold", "relax")) and self.safety.engaged:
            self.operator.tell(f"  {text}")

    def _say(self, text: str) -> None:
        self.log.add(Kind.NOTE, text)
        self.operator.tell(text)


class Source(NamedTuple):
    """How logs were recorded, and on which hand."""

    hardware: HardwareConfig
    rate: float  # Hz
    identity: Identity


def read_logs(paths: Iterable[Path], task: str) -> tuple[Source, list[list[Record]]]:
    """The source of logs of one hand, task and configuration; of each log the further settings and marked exchanges.

    Raises LogError: a log of another task, hand or configuration than the logs before.
    """
    sources, logs = list[Source](), []
    for path in paths:
        with reading(path):
            records = [record for record in LogReader(path) if record.kind in (Kind.META, Kind.TICK)]
            if not records:
                raise LogError(f"{path}: the log ends before the hand was ready; record again")
            meta = records.pop(0).content
            if meta["task"] != task:
                raise LogError(f"{path}: this is a log of {meta['task']!r}; give one of {task!r}")
            hardware = from_dict(HardwareConfig, meta["hardware"])
            sources.append(Source(hardware, meta["rate"], Identity(*meta["identity"])))
        logs.append(records)
        for what, own, first in zip(("--hardware options", "--rate", "hand"), sources[-1], sources[0], strict=True):
            if own != first:
                raise LogError(f"{path}: has another {what} than the logs before: {own!r:.80}")
    return sources[0], logs
