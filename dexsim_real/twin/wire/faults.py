"""Faults of an emulated hand: drawn at random or scripted, and counted where they are made.

At most one befalls an exchange, so that what the host must count follows from what was injected:

| fault | what happens | what the host's `LinkCounts` show |
|---|---|---|
| flip, drop, duplicate of an answer | one to three bits, or some bytes | one `corrupt` |
| the same of a request | the hand does not understand it | one `silent` |
| late | the answer comes long after its deadline; meanwhile the hand is deaf | `silent`, and one `late` |
| stall | the hand is deaf for a while, and never answers this request | `silent` |
| disconnect | the terminal goes and comes back under its name | one `lost`, then one `reconnects` |
| heat | a motor gets hotter | none: `Safety` ends the run |
| stuck | a taxel shows one number from now on | none: the number is in every state |
"""

import dataclasses
from collections import Counter

import numpy as np

from dexsim.core.config import check_ranges, setting, validate
from dexsim_real.core.errors import HandError
from dexsim_real.wire import frames

BYTES = ("flip", "drop", "duplicate")
KINDS = (*BYTES, "late", "stall", "disconnect", "heat", "stuck")
_RUN = 40  # bytes, most that are dropped or doubled at once


@dataclasses.dataclass(frozen=True, kw_only=True)
class FaultConfig:
    """How often what goes wrong; all at zero by default."""

    flip: float = setting(0.0, unit="1", low=0.0, high=1.0)
    """Share of exchanges with one to three wrong bits."""
    drop: float = setting(0.0, unit="1", low=0.0, high=1.0)
    """Share of exchanges with missing bytes."""
    duplicate: float = setting(0.0, unit="1", low=0.0, high=1.0)
    """Share of exchanges with repeated bytes."""
    late: float = setting(0.0, unit="1", low=0.0, high=1.0)
    """Share of exchanges that are answered too late."""
    stall: float = setting(0.0, unit="1", low=0.0, high=1.0)
    """Share of exchanges at which the hand stops answering for a while."""
    disconnect: float = setting(0.0, unit="1", low=0.0, high=1.0)
    """Share of exchanges at which the port disappears for a while."""
    heat: float = setting(0.0, unit="1", low=0.0, high=1.0)
    """Share of exchanges at which a motor gets hot for a while."""
    stuck: float = setting(0.0, unit="1", low=0.0, high=1.0)
    """Share of exchanges at which one more taxel gets stuck."""
    on_request: float = setting(0.3, unit="1", low=0.0, high=1.0)
    """Share of damaged bytes that befalls the request, not the answer."""
    late_seconds: tuple[float, float] = setting((0.1, 0.15), unit="s", low=0.0, high=10.0)
    """Delay of a late answer; beyond the host's `--link.margin`, or it is not late."""
    stall_seconds: tuple[float, float] = setting((0.05, 0.4), unit="s", low=0.0, high=60.0)
    """How long the hand is deaf."""
    away_seconds: tuple[float, float] = setting((0.1, 1.0), unit="s", low=0.0, high=60.0)
    """How long the port is gone."""
    heat_degrees: float = setting(60.0, unit="K", low=0.0, high=200.0)
    """Temperature rise of a hot motor."""
    heat_seconds: float = setting(2.0, unit="s", low=0.0, high=3600.0)
    """Duration of that rise."""
    stuck_count: tuple[int, int] = setting((5, 30), unit="count", low=0, high=255)
    """What a stuck taxel shows."""
    script: tuple[str, ...] = ()
    """Faults at a time, such as "12.5 stall 0.2": seconds after the first exchange, a kind, its values
    (`flip|drop|duplicate [request|answer]`, `late|stall|disconnect SECONDS`, `heat JOINT KELVIN SECONDS`,
    `stuck TIP TAXEL COUNT`); without values they are drawn."""

    def __post_init__(self):
        validate(self)
        check_ranges(self, "late_seconds", "stall_seconds", "away_seconds", "stuck_count")
        if sum(getattr(self, kind) for kind in KINDS) > 1:
            raise HandError("FaultConfig: the shares of all faults must not exceed 1 together")
        for line in self.script:
            parse_fault(line)


@dataclasses.dataclass(frozen=True)
class Fault:
    """One fault of one exchange; what its kind does not need stays as it is."""

    kind: str
    on_request: bool = False
    seconds: float = 0.0
    joint: int = 0
    degrees: float = 0.0
    taxel: tuple[int, int] = (0, 0)  # tip, number
    count: int = 0

    @property
    def name(self) -> str:
        """What it is counted as."""
        return f"{self.kind} {'request' if self.on_request else 'answer'}" if self.kind in BYTES else self.kind


def parse_fault(line: str) -> tuple[float, str, tuple[str, ...]]:
    """Time s, kind and values of a scripted fault.

    Raises:
      HandError: what is wrong with the line.
    """
    words = line.split()
    try:
        when, kind, values = float(words[0]), words[1], tuple(words[2:])
        if kind not in KINDS:
            raise HandError(f"fault {line!r}: no kind {kind!r}; there are {', '.join(KINDS)}")
        _with_values(Fault(kind), values)
    except (IndexError, ValueError):
        raise HandError(
            f"fault {line!r}: expected a time in s, a kind and its values, such as '12.5 stall 0.2'"
        ) from None
    if not 0 <= when < 1e9:
        raise HandError(f"fault {line!r}: its time must be at least 0 s")
    return when, kind, values


class Injector:
    """Decides the fault of each exchange.

    Args:
      seed: of what is drawn; the same seed and exchanges give the same faults.
    """

    def __init__(self, config: FaultConfig, seed: int):
        self.config = config
        self.injected: Counter[str] = Counter()
        self._rng = np.random.default_rng(seed)
        self._script = sorted(parse_fault(line) for line in config.script)
        self._first: float | None = None  # s, time of the first exchange
        self._rates = np.cumsum([getattr(config, kind) for kind in KINDS])

    def draw(self, now: float) -> Fault | None:
        """The fault of the exchange that was asked for at `now` s, counted already."""
        self._first = now if self._first is None else self._first
        fault = None
        if self._script and now - self._first >= self._script[0][0]:
            _, kind, values = self._script.pop(0)
            fault = _with_values(self._drawn(kind), values)
        elif self._rates[-1] > 0:
            at = int(np.searchsorted(self._rates, self._rng.random(), side="right"))
            fault = self._drawn(KINDS[at]) if at < len(KINDS) else None
        if fault:
            self.injected[fault.name] += 1
        return fault

    def damage(self, fault: Fault, frame: bytes) -> bytes:
        """A frame's bytes after the fault; the frame itself is nowhere among them."""
        while frame in (bad := self._damage(fault.kind, bytearray(frame))):
            pass
        return bad

    def expected(self) -> dict[str, int]:
        """What the host's counters must show of the faults that have one to themselves."""
        made = self.injected
        return {"corrupt": sum(made[f"{kind} answer"] for kind in BYTES), "lost": made["disconnect"]}

    def _drawn(self, kind: str) -> Fault:
        rng, config = self._rng, self.config
        spans = {
            "late": config.late_seconds,
            "stall": config.stall_seconds,
            "disconnect": config.away_seconds,
            "heat": (config.heat_seconds, config.heat_seconds),
        }
        return Fault(
            kind,
            bool(kind in BYTES and rng.random() < config.on_request),
            float(rng.uniform(*spans[kind])) if kind in spans else 0.0,
            int(rng.integers(frames.JOINTS)),
            config.heat_degrees,
            (int(rng.integers(frames.TIPS)), int(rng.integers(frames.TAXELS))),
            int(rng.integers(config.stuck_count[0], config.stuck_count[1] + 1)),
        )

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


def _with_values(fault: Fault, values: tuple[str, ...]) -> Fault:
    """A fault with scripted values in place of drawn ones; ValueError where they do not fit."""
    if not values:
        return fault
    if fault.kind in BYTES:
        (side,) = values
        return dataclasses.replace(fault, on_request=("answer", "request").index(side) == 1)
    if fault.kind == "heat":
        joint, degrees, seconds = values
        changes = {"joint": _within(joint, frames.JOINTS), "degrees": float(degrees), "seconds": float(seconds)}
    elif fault.kind == "stuck":
        tip, taxel, count = values
        changes = {"taxel": (_within(tip, frames.TIPS), _within(taxel, frames.TAXELS)), "count": _within(count, 256)}
    else:
        (seconds,) = values
        changes = {"seconds": float(seconds)}
    if not 0 <= changes.get("seconds", 0) < 1e6:
        raise ValueError
    return dataclasses.replace(fault, **changes)


def _within(text: str, end: int) -> int:
    number = int(text)
    if not 0 <= number < end:
        raise ValueError
    return number
