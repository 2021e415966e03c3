"""Reference force of a press: a reading typed by the user, or a function of the user."""

import re
import threading
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from dexsim_real.calibrate.hand_loop import Operator
from dexsim_real.core.errors import HandError
from dexsim_real.core.names import find_function

_UNITS = {"": 1.0, "n": 1.0, "g": 9.80665e-3, "kg": 9.80665}
LARGEST = 100.0
"""N, largest plausible reading."""
_AT_ONCE = 0.005  # s in which most functions answer; the hand goes on without an exchange meanwhile
_SLOWEST = 10.0  # s, longest wait for a function


def parse_reading(text: str) -> float:
    """Newtons from "5.2", "5.2 N", "530 g" or "0.53 kg".

    Raises:
      HandError: not a number with a known unit, or more than a fingertip can press.
    """
    match = re.fullmatch(r"\s*([0-9]+(?:[.,][0-9]*)?|[.,][0-9]+)\s*([a-zA-Z]*)\s*", text)
    if not match or match[2].lower() not in _UNITS:
        raise HandError(f"{text.strip()!r} is not a reading: type newtons, or a number with g or kg")
    force = float(match[1].replace(",", ".")) * _UNITS[match[2].lower()]
    if force > LARGEST:
        raise HandError(f"{text.strip()!r} is {force:.0f} N, more than a fingertip can press; grams need a g")
    return force


class Gauge:
    """A force gauge.

    Args:
      source: "ask", or MODULE:FUNCTION of a function without arguments that returns newtons.
      operator: is asked for readings.

    Raises:
      HandError: the function cannot be found, or there is nobody to ask.
    """

    def __init__(self, source: str, operator: Operator):
        self._operator, self._function = operator, None
        self.automatic = source != "ask"
        if source != "ask":
            self._function = _find(source)
        elif operator.assume_yes:
            raise HandError("--gauge ask needs answers, but --yes asks nothing; remove one of them")

    def read(self, meanwhile: Callable[[], object]) -> float | None:
        """Force N; None when the user skips the reading. `meanwhile` is called until user or function answers.

        Raises:
          HandError: the function fails, takes too long, or returns no number; or the user cannot answer.
        """
        if self._function is not None:
            return _call(self._function, meanwhile)
        while True:
            text = self._operator.ask("  reading of the gauge (newtons, or a number with g or kg; s skips):", meanwhile)
            if text.lower() in ("s", "skip"):
                return None
            try:
                return parse_reading(text)
            except HandError as error:
                self._operator.tell(f"  {error}")


def _call(function: Callable[[], Any], meanwhile: Callable[[], object]) -> float:
    """What the function returns, in N. It has its own thread, since the pressing hand needs an exchange every cycle."""
    answer: list[Any] = []
    failure: list[BaseException] = []

    def call() -> None:
        try:
            answer.append(function())
        except BaseException as error:  # Also a SystemExit of the user's function.
            failure.append(error)

    thread = threading.Thread(target=call, name="gauge", daemon=True)
    thread.start()
    thread.join(_AT_ONCE)
    until = time.monotonic() + _SLOWEST
    while thread.is_alive():
        if time.monotonic() > until:
            raise HandError(f"the function of --gauge did not return within {_SLOWEST:g} s; check the gauge")
        meanwhile()
    if failure:
        raise HandError(f"the function of --gauge failed ({type(failure[0]).__name__}: {failure[0]}); check the gauge")
    try:
        force = float(answer[0])
    except Exception:
        force = np.nan
    if not abs(force) <= LARGEST:
        raise HandError(
            f"the function of --gauge returned {answer[0]!r:.80}; it must return newtons, and a fingertip presses with "
            f"less than {LARGEST:g}"
        )
    return force


def _find(source: str) -> Callable[[], float]:
    return find_function(source, f"--gauge {source}", "ask, or MODULE:FUNCTION")
