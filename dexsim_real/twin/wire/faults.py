"""Faults of an emulated hand: random or at given times, and counted when they are injected.

An exchange has at most one fault, so the injected faults determine what the host must count (docs/emulated_hand.md).
"""

from collections import Counter
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from dexsim_real.core.errors import HandError
from dexsim_real.wire import frames

KINDS = {
    "flip": (),
    "late": ("seconds",),
    "stall": ("seconds",),
    "disconnect": ("seconds",),
    "heat": ("joint", "kelvin", "seconds"),
    "error": ("joint", "bits", "seconds"),
    "off": ("joint", "seconds"),
    "refuse": ("number", "seconds"),
    "angle": ("joint", "radians", "seconds"),
    "stuck": ("tip", "taxel", "count", "seconds"),
}
"""Values of each kind in the order in which a line gives them. The first four are faults of the line."""
LINE = tuple(KINDS)[:4]
_BELOW = {
    "joint": frames.JOINTS,
    "tip": frames.TIPS,
    "taxel": frames.TAXELS,
    "bits": 1 << 16,
    "count": 256,
    "number": 100,
}
"""Values that are whole numbers, and their bounds; others are finite numbers."""


class Fault(NamedTuple):
    """What a line such as "12.5 stall 0.2" or "1% flip" asks for."""

    kind: str
    values: dict[str, Any]  # by the names in `KINDS`
    time: float  # s after the first exchange; infinite for a random fault
    probability: float  # per exchange; 0 for a fault at a time


def parse_fault(line: str) -> Fault:
    """Parse a line: seconds after the first exchange or a percentage of the exchanges, kind, values (`KINDS`).

    Raises:
      HandError: the line is not a fault.
    """
    try:
        when, kind, *words = line.split()
        values = {name: _parse(name, word) for name, word in zip(KINDS[kind], words, strict=True)}
        number, share = float(when.removesuffix("%")), when.endswith("%")
        if not 0 <= number <= (100 if share else 1e6):
            raise ValueError
    except (KeyError, ValueError):
        kinds = "; ".join(" ".join((kind, *map(str.upper, names))) for kind, names in KINDS.items())
        raise HandError(
            f"fault {line!r}: give a time in s or a percentage of the exchanges, a kind and its values, such as "
            f"'12.5 stall 0.2' or '1% flip'; {kinds}"
        ) from None
    return Fault(kind, values, np.inf, number / 100) if share else Fault(kind, values, number, 0.0)


def _parse(name: str, word: str) -> Any:
    value = int(word) if name in _BELOW else float(word)
    if not (0 <= value < _BELOW[name] if name in _BELOW else np.isfinite(value)):
        raise ValueError
    return value


class Injector:
    """Decides the fault of each exchange.

    Args:
      lines: see `parse_fault`.
      seed: of the random numbers; the same seed and exchanges give the same faults.

    Raises:
      HandError: a line is not a fault, or the percentages exceed 100 in sum.
    """

    def __init__(self, lines: Sequence[str] = (), seed: int = 0):
        self.injected: Counter[str] = Counter()
        self._rng = np.random.default_rng(seed)
        self._first: float | None = None  # s, time of the first exchange
        parsed = [parse_fault(line) for line in lines]
        self._script = sorted((fault for fault in parsed if not fault.probability), key=lambda fault: fault.time)
        self._random = [fault for fault in parsed if fault.probability]
        self._below = np.cumsum([fault.probability for fault in self._random])
        if self._random and self._below[-1] > 1 + 1e-9:
            raise HandError("faults: the percentages must not exceed 100 in sum")

    def sample(self, now: float) -> Fault | None:
        """The fault of the exchange requested at `now` s; None for none."""
        self._first = now if self._first is None else self._first
        fault = None
        if self._script and now - self._first >= self._script[0].time:
            fault = self._script.pop(0)
        elif self._random:
            at = int(np.searchsorted(self._below, self._rng.random(), side="right"))
            fault = self._random[at] if at < len(self._random) else None
        self.injected.update([fault.kind] if fault else [])
        return fault

    def damage(self, frame: bytes) -> bytes:
        """A frame [bytes] with one to three wrong bits, which its checksum finds in any frame of this length."""
        data, rng = bytearray(frame), self._rng
        for bit in rng.choice(8 * len(data), int(rng.integers(1, 4)), replace=False):
            data[bit >> 3] ^= 1 << (bit & 7)
        return bytes(data)
