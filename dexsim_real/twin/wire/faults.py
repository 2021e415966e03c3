"""Faults of an emulated hand: random or at given times, and counted when they are injected.

An exchange has at most one fault, so the injected faults determine what the host must count (docs/emulated_hand.md).
"""

from collections import Counter
from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np

from dexsim_real.core.errors import HandError
from dexsim_real.wire import frames

BYTES = ("flip", "drop", "duplicate")
ALL = -1  # all joints
BOARDS = ("palm", "joint", "tip")
PARTS = (*map(str, range(frames.JOINTS)), *(f"tip{tip}" for tip in range(frames.TIPS)), "palm")
_RUN = 40  # bytes, longest run that is dropped or duplicated
Span = tuple | range
_SIDE: dict[str, Span] = {"side": ("answer", "request")}
_JOINT: dict[str, Span] = {"joint": range(frames.JOINTS)}

KINDS: dict[str, dict[str, Span]] = {
    "flip": _SIDE,
    "drop": _SIDE,
    "duplicate": _SIDE,
    "late": {"seconds": (0.1, 0.15)},
    "stall": {"seconds": (0.05, 0.4)},
    "disconnect": {"seconds": (0.1, 1.0)},
    "heat": {"part": PARTS, "kelvin": (60.0, 60.0), "seconds": (2.0, 2.0)},
    "error": {"board": BOARDS, **_JOINT, "bits": range(1, 1 << 16), "seconds": (2.0, 2.0)},
    "off": {"joint": range(ALL, frames.JOINTS), "seconds": (2.0, 2.0)},
    "jam": {**_JOINT, "milliamperes": (1500.0, 1500.0), "seconds": (6.0, 6.0)},
    "refuse": {"number": range(100), "seconds": (2.0, 2.0)},
    "angle": {**_JOINT, "form": ("offset", "stuck"), "radians": (-1.5, 1.5), "seconds": (0.0, 0.8)},
    "stuck": {"tip": range(frames.TIPS), "taxel": range(frames.TAXELS), "count": range(256)},
}
"""Values of each kind in the order in which a line gives them: the words or whole numbers that are possible, or from
where to where a number is drawn that the line leaves out. Without seconds a fault lasts to the end."""


class Fault(SimpleNamespace):
    """The fault of an exchange: its `kind`, and its values by the names in `KINDS`."""

    def __str__(self) -> str:
        return " ".join(f"{value:g}" if name == "seconds" else str(value) for name, value in vars(self).items())


class FaultLine(NamedTuple):
    """What a line such as "12.5 stall 0.2" or "1% flip" asks for."""

    kind: str
    given: dict[str, Any]
    time: float  # s after the first exchange; infinite for a random fault
    probability: float  # per exchange; 0 for a fault at a time


def parse_fault(line: str) -> FaultLine:
    """Parse a line: seconds after the first exchange or a percentage of the exchanges, kind, values (`KINDS`).

    Raises:
      HandError: the line is not a fault.
    """
    try:
        when, kind, *words = line.split()
        spans, share = KINDS[kind], when.endswith("%")
        given = {name: _parse(span, word) for (name, span), word in zip(spans.items(), words, strict=False)}
        number = float(when.removesuffix("%"))
        if len(words) > len(spans) or not 0 <= number <= (100 if share else 1e6):
            raise ValueError
    except (KeyError, ValueError):
        kinds = "; ".join(f"{kind} {' '.join(values).upper()}" for kind, values in KINDS.items())
        raise HandError(
            f"fault {line!r}: give a time in s or a percentage of the exchanges, a kind and its values, such as "
            f"'12.5 stall 0.2' or '1% flip'; {kinds}"
        ) from None
    return FaultLine(kind, given, np.inf, number / 100) if share else FaultLine(kind, given, number, 0.0)


def _parse(span: Span, word: str) -> Any:
    """A value of a line: one of the words or whole numbers of its span, or any finite number."""
    if isinstance(span[0], float):
        if not np.isfinite(number := float(word)):
            raise ValueError
        return number
    return span[span.index(type(span[0])(word))]


def _draw(span: Span, rng: np.random.Generator) -> Any:
    return float(rng.uniform(*span)) if isinstance(span[0], float) else span[int(rng.integers(len(span)))]


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
        self._script = sorted((line for line in parsed if not line.probability), key=lambda line: line.time)
        self._random = [line for line in parsed if line.probability]
        self._below = np.cumsum([line.probability for line in self._random])
        if self._random and self._below[-1] > 1 + 1e-9:
            raise HandError("faults: the percentages must not exceed 100 in sum")

    def sample(self, now: float) -> Fault | None:
        """The fault of the exchange requested at `now` s, what its line leaves out drawn; None for none."""
        self._first = now if self._first is None else self._first
        line = None
        if self._script and now - self._first >= self._script[0].time:
            line = self._script.pop(0)
        elif self._random:
            at = int(np.searchsorted(self._below, self._rng.random(), side="right"))
            line = self._random[at] if at < len(self._random) else None
        if line is None:
            return None
        values = {name: _draw(span, self._rng) for name, span in KINDS[line.kind].items()} | line.given
        self.injected[f"{line.kind} {values['side']}" if line.kind in BYTES else line.kind] += 1
        return Fault(kind=line.kind, **values)

    def damage(self, kind: str, frame: bytes) -> bytes:
        """The damaged bytes of a frame [bytes]; they never contain the intact frame."""
        while frame in (bad := self._damage(kind, bytearray(frame))):
            pass
        return bad

    def _damage(self, kind: str, data: bytearray) -> bytes:
        rng, at = self._rng, int(self._rng.integers(len(data)))
        if kind == "flip":  # The checksum finds up to three wrong bits in any frame of this length.
            for bit in rng.choice(8 * len(data), int(rng.integers(1, 4)), replace=False):
                data[bit >> 3] ^= 1 << (bit & 7)
        elif kind == "drop":
            del data[at : at + int(rng.integers(1, min(_RUN, len(data) - 1) + 1))]
        else:
            data[at:at] = data[at : at + int(rng.integers(1, _RUN + 1))]
        return bytes(data)
