"""The person beside the hand, and the reference force of a press: typed by that person, or by a function."""

import contextlib
import io
import queue
import re
import sys
import threading
import time
from collections.abc import Callable
from typing import TextIO

import numpy as np
from rich.console import Console

from dexsim_real.core.errors import HandError
from dexsim_real.core.names import find_function

_READING = re.compile(r"([0-9]+(?:[.,][0-9]*)?|[.,][0-9]+)\s*(n|g|kg|)", re.IGNORECASE)
_NEWTONS = {"": 1.0, "n": 1.0, "g": 9.80665e-3, "kg": 9.80665}
_LARGEST = 100.0  # N, largest plausible reading
_AT_ONCE = 0.005  # s in which most functions answer; the hand goes on without an exchange meanwhile
_SLOWEST = 10.0  # s, longest wait for a function


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
            raise HandError("standard input is closed; run in a terminal, or give --yes")
        return line.strip()

    def _read(self) -> None:
        with contextlib.suppress(OSError, ValueError):  # A terminal that hangs up, or no text: it ends here as well.
            for line in self._stream:
                self._lines.put(line)
        self._lines.put("")


class Gauge:
    """A force gauge.

    Args:
      source: "ask", or MODULE:FUNCTION of a function without arguments that returns newtons.
      operator: is asked for readings.

    Raises:
      HandError: the function cannot be found, or there is nobody to ask.
    """

    def __init__(self, source: str, operator: Operator):
        self._operator, self.automatic = operator, source != "ask"
        if self.automatic:
            self._function = find_function(source, f"--gauge {source}", "ask, or MODULE:FUNCTION")
        elif operator.assume_yes:
            raise HandError("--gauge ask needs answers, but --yes asks nothing; remove one of them")

    def read(self, meanwhile: Callable[[], object]) -> float | None:
        """Force N; None when the user skips the reading. `meanwhile` is called until user or function answers.

        Raises:
          HandError: the function fails, takes too long, or returns no number; or the user cannot answer.
        """
        if self.automatic:
            return self._call(meanwhile)
        while True:
            text = self._operator.ask("  reading of the gauge (newtons, or a number with g or kg; s skips):", meanwhile)
            if text.lower() in ("s", "skip"):
                return None
            try:
                return parse_reading(text)
            except HandError as error:
                self._operator.tell(f"  {error}")

    def _call(self, meanwhile: Callable[[], object]) -> float:
        """What the function returns. It has its own thread: the pressing hand needs an exchange every cycle."""
        force, failure = np.nan, "did not return in time"

        def call() -> None:
            nonlocal force, failure
            try:
                force, failure = float(self._function()), ""
            except BaseException as error:  # Also a SystemExit of the user's function.
                failure = f"failed ({type(error).__name__}: {error})"

        thread = threading.Thread(target=call, name="gauge", daemon=True)
        thread.start()
        thread.join(_AT_ONCE)
        until = time.monotonic() + _SLOWEST
        while thread.is_alive() and time.monotonic() < until:
            meanwhile()
        if failure or not abs(force) <= _LARGEST:
            failure = failure or f"returned {force:g}, but a fingertip presses with less than {_LARGEST:g} N"
            raise HandError(f"the function of --gauge {failure}; check the gauge")
        return force


def parse_reading(text: str) -> float:
    """Newtons from "5.2", "5.2 N", "530 g" or "0.53 kg".

    Raises:
      HandError: not a number with a known unit, or more than a fingertip can press.
    """
    match = _READING.fullmatch(text.strip())
    if not match:
        raise HandError(f"{text.strip()!r} is not a reading: type newtons, or a number with g or kg")
    force = float(match[1].replace(",", ".")) * _NEWTONS[match[2].lower()]
    if force > _LARGEST:
        raise HandError(f"{text.strip()!r} is {force:.0f} N, more than a fingertip can press; grams need a g")
    return force
