"""The exchange loop of a procedure that moves and measures, and the person beside the hand.

In a run a thread keeps the delays of a policy away from the hand. A procedure has no such delays, so one call makes an
exchange and returns its result. Clock and hand can be simulated.
"""

import contextlib
import io
import queue
import sys
import threading
import time
from collections.abc import Callable
from typing import Any, TextIO

import numpy as np
from rich.console import Console

from dexsim_real.control.policy_loop import smooth
from dexsim_real.control.safety import Reaction, Safety
from dexsim_real.core.errors import HandError
from dexsim_real.core.log import Kind, LogWriter
from dexsim_real.loop import Exchange, ExchangeLoop
from dexsim_real.sensors.hand import HandSensing
from dexsim_real.wire import frames
from dexsim_real.wire.frames import Command, Frame
from dexsim_real.wire.link import HandPort

_PATIENCE = 2.0  # s, longest hold by `Safety` or silence of the hand


class HandLoop(ExchangeLoop):
    """The exchange loop with a log and a goal, one `step` per cycle.

    The taxels' zeros stay as they were tared: what they read is measured.

    Args:
      port, sensing, safety, rate, clock, sleep: see `ExchangeLoop`; the notes of `safety` should go to the log.
      log: gets the frames while `recording` is set, and the marks.
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
        super().__init__(port, sensing, safety, rate, track_taxels=False, clock=clock, sleep=sleep)
        self.log, self.recording = log, False
        self._failing_since: float | None = None
        self._connection: int | None = None
        self._number = 0

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
        decision, command = self.request()
        self._number += 1
        self._record(Kind.SENT, command, now)
        exchange = self.take(decision, self.port.exchange(command))
        if exchange is not None:
            self._record(Kind.RECEIVED, exchange.state, exchange.sample.time)
        self._check(now, exchange)
        self.pace.wait()
        return exchange if exchange is not None and exchange.plausible else None

    def mark(self, content: dict[str, Any]) -> None:
        """Annotate the newest exchange in the log."""
        self.log.add(Kind.TICK, {"sequence": self._number, **content}, self.clock())

    def collect(self, seconds: float, target: np.ndarray | None = None) -> list[Exchange]:
        """The answered exchanges of this duration in s."""
        until, exchanges = self.clock() + seconds, []
        while self.clock() < until:
            exchanges.append(self.step(target))
        return [exchange for exchange in exchanges if exchange is not None]

    def await_motors(self) -> None:
        """Turn the motors on, and wait until they are.

        Raises:
          HandError: see `step`.
        """
        self.engage()
        while not self.safety.anchor:
            self.step()

    def move(self, goal: np.ndarray, speed: float = 0.6) -> None:
        """Move to a posture [J] rad; the joint with the longest path has a mean speed of `speed` rad/s."""
        start = self.safety.commanded  # Not the last reading, which may be wrong.
        seconds = max(float(np.abs(goal - start).max()) / speed, 0.3)
        begin = self.clock()
        while (share := (self.clock() - begin) / seconds) < 1.0:
            self.step(smooth(start, goal, share))
        self.step(goal)

    def pose(self) -> np.ndarray:
        """The last measured joint angles [J] rad."""
        sample = self.safety.sample
        assert sample is not None, "no state yet"
        return sample.measured.joint_position.astype(float)

    # --- pieces ---------------------------------------------------------------------------------

    def _record(self, kind: Kind, block: np.ndarray, when: float) -> None:
        """Log a frame as it is on the wire of a hand with id 0."""
        if self.recording:
            ends = frames.HOST, frames.palm_address(0)
            source, target = ends if kind == Kind.SENT else ends[::-1]
            frame = Frame(source, target, Command.EXCHANGE, block.tobytes())
            self.log.add(kind, (self._number, frame.encode()), when)

    def _check(self, now: float, exchange: Exchange | None) -> None:
        safety = self.safety
        if safety.latched:
            raise HandError(f"stopped: {safety.latched}")
        if self.log.failure:
            raise HandError(f"stopped: the log is lost ({self.log.failure})")
        if exchange is not None and self._connection not in (None, exchange.sample.generation):
            raise HandError("stopped: the hand was disconnected and its pose may have changed; start again")
        self._connection = exchange.sample.generation if exchange is not None else self._connection
        reaction, reason = safety.last
        working = exchange is not None and (reaction <= Reaction.CLIP or not safety.engaged)
        self._failing_since = None if working else self._failing_since or now
        if self._failing_since is not None and now - self._failing_since > _PATIENCE:
            why = safety.refused or reason or "the hand does not answer"
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
