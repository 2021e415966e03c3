"""Reference force of a press: a reading typed by the user, or a function of the user."""

import re
from collections.abc import Callable

import numpy as np

from dexsim_real.calibrate.hand_loop import Operator
from dexsim_real.core.errors import HandError
from dexsim_real.core.names import find_function

_UNITS = {"": 1.0, "n": 1.0, "g": 9.80665e-3, "kg": 9.80665}
_LARGEST = 100.0  # N, largest plausible reading


def parse_reading(text: str) -> float:
    """Newtons from "5.2", "5.2 N", "530 g" or "0.53 kg".

    Raises:
      HandError: not a number with a known unit, or more than a fingertip can press.
    """
    match = re.fullmatch(r"\s*([0-9]+(?:[.,][0-9]*)?|[.,][0-9]+)\s*([a-zA-Z]*)\s*", text)
    if not match or match[2].lower() not in _UNITS:
        raise HandError(f"{text.strip()!r} is not a reading: type newtons, or a number with g or kg")
    force = float(match[1].replace(",", ".")) * _UNITS[match[2].lower()]
    if force > _LARGEST:
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
        """Force N; None when the user skips the reading. `meanwhile` is called until the user answers."""
        if self._function is not None:
            force = float(self._function())
            if not np.isfinite(force):
                raise HandError(f"the function of --gauge returned {force}; it must return newtons")
            return force
        while True:
            text = self._operator.ask("  reading of the gauge (newtons, or a number with g or kg; s skips):", meanwhile)
            if text.lower() in ("s", "skip"):
                return None
            try:
                return parse_reading(text)
            except HandError as error:
                self._operator.tell(f"  {error}")


def _find(source: str) -> Callable[[], float]:
    return find_function(source, f"--gauge {source}", "ask, or MODULE:FUNCTION")
