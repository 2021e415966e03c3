"""The person beside the hand, who answers questions and reads a gauge while the hand keeps moving."""

import contextlib
import io
import re
import sys
import termios
import threading
from collections.abc import Callable
from typing import TextIO

from rich.console import Console

from dexsim_real.core.errors import HandError

_READING = re.compile(r"([0-9]+(?:[.,][0-9]*)?|[.,][0-9]+)\s*(n|g|kg|)", re.IGNORECASE)
_NEWTONS = {"": 1.0, "n": 1.0, "g": 9.80665e-3, "kg": 9.80665}
_LARGEST = 100.0  # N, largest plausible reading


class Operator:
    """The person beside the hand.

    Args:
      console: for output.
      assume_yes: ask nothing and assume that every answer is yes.
      stream: of the answers; None is the standard input.
    """

    def __init__(self, console: Console, *, assume_yes: bool = False, stream: TextIO | None = None):
        self.console, self.assume_yes = console, assume_yes
        self._stream = stream or sys.stdin or io.StringIO()  # Python has no `sys.stdin` where it was closed.

    def tell(self, text: str) -> None:
        """Print one line."""
        self.console.print(text, highlight=False, markup=False, soft_wrap=True)

    def ask(self, text: str, meanwhile: Callable[[], object]) -> str:
        """Ask a question; returns the stripped answer. `meanwhile` is called until it arrives.

        Raises:
          HandError: the input is closed.
        """
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
        return lines[-1].strip()

    def ask_force(self, meanwhile: Callable[[], object]) -> float | None:
        """Ask for the reading of the gauge in N until it is one; None when the user skips it."""
        while True:
            text = self.ask("  reading of the gauge (newtons, or a number with g or kg; s skips):", meanwhile)
            if text.lower() in ("s", "skip"):
                return None
            try:
                return parse_reading(text)
            except HandError as error:
                self.tell(f"  {error}")


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
