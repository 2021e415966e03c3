"""What an instrument shows while a fingertip presses on it: typed in, or read by the user's function."""

import importlib
import re
from collections.abc import Callable

import numpy as np

from dexsim_real.calibrate.loop import Operator
from dexsim_real.core.errors import HandError

_UNITS = {"": 1.0, "n": 1.0, "g": 9.80665e-3, "kg": 9.80665}
_LARGEST = 100.0  # N


def parse_reading(text: str) -> float:
    """Newtons from "5.2", "5.2 N", "530 g" or "0.53 kg".

    Raises:
      HandError: not a reading, or none that a fingertip can make.
    """
    match = re.fullmatch(r"\s*([0-9]+(?:[.,][0-9]*)?|[.,][0-9]+)\s*([a-zA-Z]*)\s*", text)
    if not match or match[2].lower() not in _UNITS:
        raise HandError(f"{text.strip()!r} is no reading: type newtons, or a number with g or kg")
    force = float(match[1].replace(",", ".")) * _UNITS[match[2].lower()]
    if force > _LARGEST:
        raise HandError(f"{text.strip()!r} is {force:.0f} N: more than a fingertip can press; grams need a g")
    return force


class Gauge:
    """An instrument.

    Args:
      source: "ask", or MODULE:FUNCTION; the function takes nothing and gives newtons.

    Raises:
      HandError: the function cannot be found.
    """

    def __init__(self, source: str, operator: Operator):
        self._operator, self._function = operator, None
        self.tireless = source != "ask"
        if source != "ask":
            self._function = _find(source)
        elif operator.silent:
            raise HandError("--gauge ask needs answers, --yes asks nothing: leave one of them out")

    def read(self, meanwhile: Callable[[], object]) -> float | None:
        """Newtons; None where the user skips. `meanwhile` is called while the user reads."""
        if self._function is not None:
            force = float(self._function())
            if not np.isfinite(force):
                raise HandError(f"the gauge's function gave {force}")
            return force
        while True:
            text = self._operator.ask("  the gauge shows (newtons, or a number with g or kg; s skips):", meanwhile)
            if text.lower() in ("s", "skip"):
                return None
            try:
                return parse_reading(text)
            except HandError as error:
                self._operator.tell(f"  {error}")


def _find(source: str) -> Callable[[], float]:
    module, _, name = source.partition(":")
    try:
        return getattr(importlib.import_module(module), name)
    except (ImportError, AttributeError, ValueError) as error:
        raise HandError(f"--gauge {source}: {error}; give ask, or MODULE:FUNCTION") from None
