"""A single-threaded exchange loop through `Safety`, for procedures that move and measure.

In a run a separate thread keeps the delays of a policy away from the hand. A procedure has no such delays, so one call
makes an exchange and returns its result. Clock and hand can be simulated.
"""

import contextlib
import dataclasses
import io
import queue
import sys
import threading
import time
from collections.abc import Callable
from typing import Any, TextIO

import numpy as np
from rich.console import Console

from dexsim_real.control.motors_off import patience, turn_off
from dexsim_real.control.safety import HandSample, Reaction, Safety
from dexsim_real.core.errors import HandError
from dexsim_real.core.log import Kind, LogWriter
from dexsim_real.core.process import ignore_signals
from dexsim_real.core.timing import Pace
from dexsim_real.sensors.hand import HandSensing, VelocityFilter
from dexsim_real.wire import frames
from dexsim_real.wire.frames import Command, Frame, Mode
from dexsim_real.wire.link import HandPort, Reply, checked, refusal_of

_PATIENCE = 2.0  # s, longest hold by `Safety` or silence of the hand


@dataclasses.dataclass(frozen=True)
class Exchange:
    """An answered exchange."""

    sample: HandSample
    state: np.ndarray  # `frames.STATE_BLOCK`
    command_applied: bool  # whether the requested target was sent, possibly clipped


class HandLoop:
    """Exchanges with a hand, one `step` per cycle.

    Args:
      port: not yet connected; used by this loop only.
      sensing: conversion to SI units.
      safety: decides the commands; its notes should go to the log.
      log: gets the frames while `recording` is set, and the marks.
      rate: exchanges per second.
      clock, sleep: replace those of `time`, for simulated time.
    """

    def __init__(
        self,
        port: HandPort,
        sensing: HandSensing,
        safety: Safety,
        log: LogWriter,
        rate: float,
        *,
        clock: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], None] = time.sleep,
    ):
        self.port, self.sensing, self.safety, self.log = port, sensing, safety, log
        self.clock, self.pace = clock, Pace(rate, clock, sleep)
        self.recording = False
        self._filter = VelocityFilter(sensing.config.velocity_time)
        self._failing_since: float | None = None
        self._generation: int | None = None
        self._number = 0
        self.driven = self._closed = False  # whether the motors may be on; whether the port is closed

    def step(self, target: np.ndarray | None = None) -> Exchange | None:
        """Make an exchange; None when it was not answered, or the measurement was implausible.

        Args:
          target: [J] rad, requested joint targets; None keeps the last ones.

        Raises:
          HandError: `Safety` turned the motors off, the hand was disconnected, or hold or silence lasted too long.
        """
        now = self.clock()
        if target is not None:
            self.safety.set_target(target, now)
        decision = self.safety.decide(now)
        command = self.sensing.command(decision.position, decision.mode, decision.stiffness)
        self._number += 1
        self._keep(Kind.SENT, frames.HOST, command, now)
        self.driven |= decision.mode == Mode.POSITION
        reply = self.port.exchange(command)
        if reply is None:
            self.safety.refuse(refusal_of(self.port))
        exchange = None if reply is None else self._take(checked(reply, self.clock()), decision.reaction)
        self._check(now, decision, reply)
        self.pace.wait()
        return exchange

    def mark(self, content: dict[str, Any]) -> None:
        """Annotate the newest exchange in the log."""
        self.log.add(Kind.TICK, {"sequence": self._number, **content}, self.clock())

    def collect(self, seconds: float, target: np.ndarray | None = None) -> list[Exchange]:
        """The answered exchanges of this duration in s."""
        until, found = self.clock() + seconds, []
        while self.clock() < until:
            found.append(self.step(target))
        return [exchange for exchange in found if exchange is not None]

    def engage(self) -> None:
        """Turn the motors on, and wait until they are.

        Raises:
          HandError: see `step`.
        """
        self.safety.engage()
        while not self.safety.anchor:
            self.step()

    def move(self, goal: np.ndarray, speed: float = 0.6) -> None:
        """Move to a posture [J] rad; the joint with the longest path has a mean speed of `speed` rad/s."""
        start = self.safety.commanded  # Not the last reading, which may be wrong.
        seconds = max(float(np.abs(goal - start).max()) / speed, 0.3)
        begin = self.clock()
        while (share := (self.clock() - begin) / seconds) < 1.0:
            self.step(start + share * share * (3 - 2 * share) * (goal - start))
        self.step(goal)

    def pose(self) -> np.ndarray:
        """The last measured joint angles [J] rad."""
        sample = self.safety.sample
        assert sample is not None, "no state yet"
        return sample.measured.joint_position.astype(float)

    def close(self) -> None:
        """Turn the motors off and close the port; `driven` remains True if the hand has not confirmed it."""
        ignore_signals()
        if self._closed:
            return
        off = self.sensing.command(self.sensing.hand.joint_lower, Mode.PASSIVE)
        try:
            if turn_off(self.port, off, patience(self.driven)):
                self.driven = False
        finally:
            self._closed = True
            with contextlib.suppress(Exception):  # Of a driver from elsewhere; the hand has been told.
                self.port.close()

    # --- pieces ---------------------------------------------------------------------------------

    def _take(self, reply: Reply, reaction: Reaction) -> Exchange | None:
        self._keep(Kind.RECEIVED, frames.palm_address(0), reply.state, reply.received)
        measured = self.sensing.measure(reply.state)
        velocity = self._filter.estimate(reply.received, measured.joint_position)
        sample = HandSample(reply.received, reply.sequence, reply.generation, measured, velocity)
        if not self.safety.see(sample):
            return None
        self._filter.update(reply.received, measured.joint_position)
        return Exchange(sample, reply.state, reaction <= Reaction.CLIP)

    def _keep(self, kind: Kind, source: int, block: np.ndarray, when: float) -> None:
        """Log a frame as it is on the wire of a hand with id 0."""
        if self.recording:
            target = frames.HOST if kind == Kind.RECEIVED else frames.palm_address(0)
            frame = Frame(source, target, Command.EXCHANGE, block.tobytes())
            self.log.add(kind, (self._number, frame.encode()), when)

    def _check(self, now: float, decision: Any, reply: Reply | None) -> None:
        if self.safety.latched:
            raise HandError(f"stopped: {self.safety.latched}")
        if self.log.failure:
            raise HandError(f"stopped: the log is lost ({self.log.failure})")
        if reply is not None and self._generation not in (None, reply.generation):
            raise HandError("stopped: the hand was disconnected and its pose may have changed; start again")
        self._generation = reply.generation if reply is not None else self._generation
        working = reply is not None and (decision.reaction <= Reaction.CLIP or not self.safety.engaged)
        self._failing_since = None if working else self._failing_since or now
        if self._failing_since is not None and now - self._failing_since > _PATIENCE:
            why = self.safety.refused or decision.reason or "the hand does not answer"
            raise HandError(f"stopped: {why} for {_PATIENCE:g} s")


class Operator:
    """The person beside the hand: reads instructions, and answers questions while the hand keeps moving.

    Args:
      console: for output.
      assume_yes: ask nothing and assume that every answer is yes.
      stream: of the answers; None is the standard input.
    """

    def __init__(self, console: Console, *, assume_yes: bool = False, stream: TextIO | None = None):
        self.console, self.assume_yes = console, assume_yes
        self._stream = stream or sys.stdin or io.StringIO()  # Python has no `sys.stdin` where it was closed.
        self._lines: queue.SimpleQueue[str] = queue.SimpleQueue()
        self._reader: threading.Thread | None = None

    def tell(self, text: str) -> None:
        """Print one line."""
        self.console.print(text, highlight=False, markup=False, soft_wrap=True)

    def ask(self, text: str, meanwhile: Callable[[], object]) -> str:
        """Ask a question; returns the stripped answer. `meanwhile` is called until it arrives.

        Raises:
          HandError: the input is closed.
        """
        while self._stream.isatty() and not self._lines.empty():  # Discard keys pressed before the question.
            if not self._lines.get():
                self._lines.put("")  # The end of the input remains: no answer will follow.
                break
        self.tell(text)
        if self._reader is None:
            self._reader = threading.Thread(target=self._read, name="answers", daemon=True)
            self._reader.start()
        while self._lines.empty():
            meanwhile()
        line = self._lines.get()
        if not line:
            self._lines.put("")  # For the next question.
            raise HandError("nobody can answer: standard input is closed (--yes asks nothing)")
        return line.strip()

    def _read(self) -> None:
        with contextlib.suppress(OSError, ValueError):  # A terminal that hangs up, or no text: it ends here as well.
            for line in self._stream:
                self._lines.put(line)
        self._lines.put("")
