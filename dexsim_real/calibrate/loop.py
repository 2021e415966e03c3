"""One thread, one hand: exchanges at a steady rate through `Safety`, for procedures that wait and measure.

A run's servo thread keeps a policy's delays away from the hand. A procedure has no such delays, so here the
exchange and what comes of it are one call, which also lets clock and hand be simulated.
"""

import dataclasses
import queue
import sys
import threading
import time
from collections.abc import Callable
from typing import Any, TextIO

import numpy as np
from rich.console import Console

from dexsim_real.control.safety import Reaction, Safety, Sample
from dexsim_real.core.errors import HandError
from dexsim_real.core.log import Kind, LogWriter
from dexsim_real.core.timing import Pace
from dexsim_real.sensors.hand import HandSensing, VelocityFilter
from dexsim_real.wire import frames
from dexsim_real.wire.frames import Command, Frame, Mode
from dexsim_real.wire.link import HandPort, Reply

_PATIENCE = 2.0  # s that `Safety` may hold, or the hand may be silent


@dataclasses.dataclass(frozen=True)
class Moment:
    """One exchange that was answered."""

    sample: Sample
    state: np.ndarray  # `frames.STATE_BLOCK`
    command_applied: bool  # whether the hand was told what was asked for


class HandLoop:
    """The hand, one `step` a cycle.

    Args:
      port: not yet connected; belongs to this loop from then on.
      safety: whose limits hold; its notes should go to the log.
      log: gets every frame while `marks` is set, and what `mark` is given.
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
        self._trouble_since: float | None = None
        self._generation: int | None = None
        self._number = 0

    def step(self, target: np.ndarray | None = None) -> Moment | None:
        """One exchange; None when it was not answered.

        Args:
          target: where the joints [J] shall be, rad; None leaves them where `Safety` has them.

        Raises:
          HandError: `Safety` has turned the motors off, the hand was away, or does what it was told for too long
            a time no more.
        """
        now = self.clock()
        if target is not None:
            self.safety.wish(target, now)
        decision = self.safety.decide(now)
        command = self.sensing.command(decision.position, decision.mode)
        self._number += 1
        self._keep(Kind.SENT, frames.HOST, command, now)
        reply = self.port.exchange(command)
        moment = None if reply is None else self._take(reply, decision.reaction)
        self._check(now, decision, reply)
        self.pace.wait()
        return moment

    def mark(self, content: dict[str, Any]) -> None:
        """What the newest frame in the log means."""
        self.log.add(Kind.TICK, {"sequence": self._number, **content}, self.clock())

    def collect(self, seconds: float, target: np.ndarray | None = None) -> list[Moment]:
        """The answers of this much time."""
        until, found = self.clock() + seconds, []
        while self.clock() < until:
            found.append(self.step(target))
        return [moment for moment in found if moment is not None]

    def move(self, goal: np.ndarray, speed: float = 0.6) -> None:
        """To a posture [J] rad, the joint with the longest way at `speed` rad/s on average."""
        start = self.pose()
        seconds = max(float(np.abs(goal - start).max()) / speed, 0.3)
        begin = self.clock()
        while (share := (self.clock() - begin) / seconds) < 1.0:
            self.step(start + share * share * (3 - 2 * share) * (goal - start))
        self.step(goal)

    def pose(self) -> np.ndarray:
        """Joint angles [J] rad, measured last."""
        return self.safety.sample.measured.joint_position.astype(float)

    def close(self) -> None:
        """Motors off: until the hand has confirmed it, or ten times; then the port is closed."""
        off = self.sensing.command(self.sensing.hand.joint_lower, Mode.PASSIVE)
        try:
            for _ in range(10):
                if self.port.exchange(off) is not None:
                    break
        finally:
            self.port.close()

    # --- pieces ---------------------------------------------------------------------------------

    def _take(self, reply: Reply, reaction: Reaction) -> Moment:
        self._keep(Kind.RECEIVED, frames.palm_address(0), reply.state, reply.received)
        measured = self.sensing.measure(reply.state)
        velocity = self._filter.update(reply.received, measured.joint_position)
        sample = Sample(reply.received, reply.sequence, reply.generation, measured, velocity)
        self.safety.see(sample)
        return Moment(sample, reply.state, reaction <= Reaction.CLIP)

    def _keep(self, kind: Kind, source: int, block: np.ndarray, when: float) -> None:
        """A frame for the log, as it goes over the wire of hand 0."""
        if self.recording:
            target = frames.HOST if kind == Kind.RECEIVED else frames.palm_address(0)
            frame = Frame(source, target, Command.EXCHANGE, block.tobytes())
            self.log.add(kind, (self._number, frame.encode()), when)

    def _check(self, now: float, decision: Any, reply: Reply | None) -> None:
        if self.safety.latched:
            raise HandError(f"stopped: {self.safety.latched}")
        if reply is not None and self._generation not in (None, reply.generation):
            raise HandError("stopped: the hand was away and came back, its pose may be another; begin again")
        self._generation = reply.generation if reply is not None else self._generation
        fine = reply is not None and (decision.reaction <= Reaction.CLIP or not self.safety.engaged)
        self._trouble_since = None if fine else self._trouble_since or now
        if self._trouble_since is not None and now - self._trouble_since > _PATIENCE:
            raise HandError(f"stopped: {decision.reason or 'the hand does not answer'} for {_PATIENCE:g} s")


class Operator:
    """Who stands beside the hand: is told what to do, and asked while the hand goes on.

    Args:
      silent: ask nothing and take every answer to be yes.
    """

    def __init__(self, console: Console, *, silent: bool = False, stream: TextIO | None = None):
        self.console, self.silent = console, silent
        self._stream = stream or sys.stdin
        self._lines: queue.SimpleQueue[str] = queue.SimpleQueue()
        self._reader: threading.Thread | None = None

    def tell(self, text: str) -> None:
        """One line."""
        self.console.print(text, highlight=False, markup=False, soft_wrap=True)

    def ask(self, text: str, meanwhile: Callable[[], object]) -> str:
        """The answer, stripped; `meanwhile` is called until it comes.

        Raises:
          HandError: there is nobody to answer.
        """
        while self._stream.isatty() and not self._lines.empty():  # Keys pressed before the question do not answer it.
            self._lines.get()
        self.tell(text)
        if self._reader is None:
            self._reader = threading.Thread(target=self._read, name="answers", daemon=True)
            self._reader.start()
        while self._lines.empty():
            meanwhile()
        line = self._lines.get()
        if not line:
            raise HandError("nobody answers: standard input is closed (--yes asks nothing)")
        return line.strip()

    def _read(self) -> None:
        for line in self._stream:
            self._lines.put(line)
        self._lines.put("")
