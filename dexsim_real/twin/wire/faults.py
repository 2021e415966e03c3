"""Faults of an emulated hand: random or scripted, and counted when they are injected.

An exchange has at most one fault, so the injected faults determine what the host must count:

| fault | what happens | what the host's `LinkCounts` show |
|---|---|---|
| flip, drop, duplicate in an answer | wrong bits, missing or repeated bytes | one `corrupt` |
| flip, drop, duplicate in a request | the hand ignores the request | one `silent` |
| late | the answer arrives long after its deadline; meanwhile the hand ignores requests | `silent`, and one `late` |
| stall | the hand ignores this request, and all others for a while | `silent` |
| disconnect | the terminal disappears and returns with the same name | one `lost`, then one `reconnects` |
| heat | a motor gets hotter | none: `Safety` ends the run |
| warm | a fingertip or the palm board gets hotter | none: `Safety` ends the run |
| error | a board reports error bits for a joint | none: `Safety` ends the run |
| off | the motor of a joint, or all, switch themselves off | none: `Safety` ends the run |
| jam | a joint cannot move, and reports a high current | none: `Safety` ends the run |
| refuse | the hand refuses to be driven: it answers with an error number | one `refused` for each exchange |
| angle | a joint reports a wrong angle: its own with an offset, or a constant one | none: the frame is intact |
| stuck | a taxel reports a constant count from now on | none: the count is in every state |
"""

import dataclasses
from collections import Counter
from typing import Any

import numpy as np

from dexsim.core.config import check_ranges, setting, validate
from dexsim_real.core.errors import HandError
from dexsim_real.wire import frames

BYTES = ("flip", "drop", "duplicate")
KINDS = (*BYTES, "late", "stall", "disconnect", "heat", "stuck", "angle", "warm", "error", "off", "jam", "refuse")
ALARMS = ("warm", "error", "off", "jam", "refuse")
ALL = -1  # all joints
_FORMS = ("offset", "stuck")  # of a wrong angle
BOARDS = ("palm", "joint", "tip")
_NUMBERS = (28, 35, 6)  # of random refusals: over-temperature, over-current, busy
_RUN = 40  # bytes, longest run that is dropped or duplicated


@dataclasses.dataclass(frozen=True, kw_only=True)
class FaultConfig:
    """Probabilities and sizes of faults; no faults by default."""

    flip: float = setting(0.0, unit="1", low=0.0, high=1.0)
    """Probability of one to three wrong bits, per exchange."""
    drop: float = setting(0.0, unit="1", low=0.0, high=1.0)
    """Probability of missing bytes, per exchange."""
    duplicate: float = setting(0.0, unit="1", low=0.0, high=1.0)
    """Probability of repeated bytes, per exchange."""
    late: float = setting(0.0, unit="1", low=0.0, high=1.0)
    """Probability of a late answer, per exchange."""
    stall: float = setting(0.0, unit="1", low=0.0, high=1.0)
    """Probability that the hand stops answering for a while, per exchange."""
    disconnect: float = setting(0.0, unit="1", low=0.0, high=1.0)
    """Probability that the port disappears for a while, per exchange."""
    heat: float = setting(0.0, unit="1", low=0.0, high=1.0)
    """Probability that a motor gets hot for a while, per exchange."""
    stuck: float = setting(0.0, unit="1", low=0.0, high=1.0)
    """Probability that another taxel gets stuck, per exchange."""
    angle: float = setting(0.0, unit="1", low=0.0, high=1.0)
    """Probability that a joint reports a wrong angle for a while, per exchange: with an offset, stuck, or huge."""
    warm: float = setting(0.0, unit="1", low=0.0, high=1.0)
    """Probability that a fingertip or the palm board gets hot for a while, per exchange."""
    error: float = setting(0.0, unit="1", low=0.0, high=1.0)
    """Probability that a board reports an error bit for a while, per exchange."""
    off: float = setting(0.0, unit="1", low=0.0, high=1.0)
    """Probability that a motor, or all, switch themselves off for a while, per exchange."""
    jam: float = setting(0.0, unit="1", low=0.0, high=1.0)
    """Probability that a joint is blocked for a while, per exchange."""
    refuse: float = setting(0.0, unit="1", low=0.0, high=1.0)
    """Probability that the hand refuses to be driven for a while, per exchange."""
    on_request: float = setting(0.3, unit="1", low=0.0, high=1.0)
    """Probability that damaged bytes are in the request instead of the answer."""
    late_seconds: tuple[float, float] = setting((0.1, 0.15), unit="s", low=0.0, high=10.0)
    """Range of the delay of a late answer; it must exceed `--link.margin` of the host."""
    stall_seconds: tuple[float, float] = setting((0.05, 0.4), unit="s", low=0.0, high=60.0)
    """Range of the duration of a stall."""
    away_seconds: tuple[float, float] = setting((0.1, 1.0), unit="s", low=0.0, high=60.0)
    """Range of the duration of a disconnection."""
    heat_degrees: float = setting(60.0, unit="K", low=0.0, high=200.0)
    """Temperature rise of a hot motor or board."""
    heat_seconds: float = setting(2.0, unit="s", low=0.0, high=3600.0)
    """Duration for which a motor stays hot."""
    alarm_seconds: float = setting(2.0, unit="s", low=0.0, high=3600.0)
    """Duration of hot boards, error bits, motors that are off and refusals."""
    jam_seconds: float = setting(6.0, unit="s", low=0.0, high=3600.0)
    """Duration for which a joint is blocked."""
    jam_current: float = setting(1500.0, unit="mA", low=0.0, high=30000.0)
    """Current of a blocked joint."""
    angle_offset: tuple[float, float] = setting((0.7, 1.5), unit="rad", low=0.0, high=10.0)
    """Range of the magnitude of a wrong angle's offset."""
    angle_seconds: tuple[float, float] = setting((0.0, 0.8), unit="s", low=0.0, high=60.0)
    """Range of the duration of a wrong angle; 0 is a single frame."""
    stuck_count: tuple[int, int] = setting((5, 30), unit="count", low=0, high=255)
    """Range of the count of a stuck taxel."""
    script: tuple[str, ...] = ()
    """Scripted faults, such as "12.5 stall 0.2": seconds after the first exchange, kind, values
    (`flip|drop|duplicate [request|answer]`, `late|stall|disconnect SECONDS`, `heat JOINT KELVIN SECONDS`,
    `stuck TIP TAXEL COUNT`, `angle JOINT offset|stuck RADIANS SECONDS`, `warm TIP|palm KELVIN SECONDS`,
    `error palm|joint|tip JOINT BITS SECONDS`, `off JOINT|all SECONDS`, `jam JOINT MILLIAMPERES SECONDS`,
    `refuse NUMBER SECONDS`). Missing values are sampled."""

    def __post_init__(self):
        validate(self)
        check_ranges(
            self, "late_seconds", "stall_seconds", "away_seconds", "stuck_count", "angle_offset", "angle_seconds"
        )
        if sum(getattr(self, kind) for kind in KINDS) > 1:
            raise HandError("FaultConfig: the probabilities of all faults must not exceed 1 in sum")
        for line in self.script:
            parse_fault(line)


@dataclasses.dataclass(frozen=True)
class Fault:
    """The fault of an exchange. Fields that its kind does not need keep their defaults."""

    kind: str  # one of `KINDS`
    on_request: bool = False  # whether the request is damaged instead of the answer
    seconds: float = 0.0  # s, delay or duration
    joint: int = 0  # or `ALL`
    board: str = ""  # of error bits
    number: int = 0  # error bits, or number of a refusal
    part: int = 0  # a tip, or `frames.TIPS` for the palm board
    current: float = 0.0  # mA, of a blocked joint
    form: str = "offset"  # of a wrong angle
    radians: float = 0.0
    degrees: float = 0.0  # K
    taxel: tuple[int, int] = (0, 0)  # tip, number
    count: int = 0

    @property
    def name(self) -> str:
        """Name under which the fault is counted."""
        return f"{self.kind} {'request' if self.on_request else 'answer'}" if self.kind in BYTES else self.kind

    def describe(self) -> str:
        """A fault of the hand in a few words."""
        joint = "all joints" if self.joint == ALL else f"joint {self.joint}"
        what = {
            "heat": f"{joint}, {self.degrees:.0f} K",
            "warm": f"{'palm board' if self.part == frames.TIPS else f'tip {self.part}'}, {self.degrees:.0f} K",
            "angle": f"{joint} reports {self.form} {self.radians:.3g} rad",
            "error": f"{self.board} board of {joint}, bits 0x{self.number:04x}",
            "off": joint,
            "jam": f"{joint}, {self.current:.0f} mA",
            "refuse": f"number {self.number}",
        }
        return f"{self.kind}: {what[self.kind]}, for {self.seconds:.2f} s"


def parse_fault(line: str) -> tuple[float, str, tuple[str, ...]]:
    """Time s, kind and values of a scripted fault.

    Raises:
      HandError: the line is not a fault.
    """
    words = line.split()
    try:
        when, kind, values = float(words[0]), words[1], tuple(words[2:])
        if kind not in KINDS:
            raise HandError(f"fault {line!r}: no kind {kind!r}; choose from {', '.join(KINDS)}")
        _with_values(Fault(kind), values)
    except (IndexError, ValueError):
        raise HandError(f"fault {line!r}: give a time in s, a kind and its values, such as '12.5 stall 0.2'") from None
    if not 0 <= when < 1e9:
        raise HandError(f"fault {line!r}: its time must be at least 0 s")
    return when, kind, values


class Injector:
    """Decides the fault of each exchange.

    Args:
      config: probabilities and sizes.
      seed: of the random numbers; the same seed and exchanges give the same faults.
    """

    def __init__(self, config: FaultConfig, seed: int):
        self.config = config
        self.injected: Counter[str] = Counter()
        self._rng = np.random.default_rng(seed)
        self._script = sorted(parse_fault(line) for line in config.script)
        self._first: float | None = None  # s, time of the first exchange
        self._rates = np.cumsum([getattr(config, kind) for kind in KINDS])

    def sample(self, now: float) -> Fault | None:
        """The fault of the exchange requested at `now` s; None for none. It is counted as injected."""
        self._first = now if self._first is None else self._first
        fault = None
        if self._script and now - self._first >= self._script[0][0]:
            _, kind, values = self._script.pop(0)
            fault = _with_values(self._random_fault(kind), values)
        elif self._rates[-1] > 0:
            at = int(np.searchsorted(self._rates, self._rng.random(), side="right"))
            fault = self._random_fault(KINDS[at]) if at < len(KINDS) else None
        if fault:
            self.injected[fault.name] += 1
        return fault

    def damage(self, fault: Fault, frame: bytes) -> bytes:
        """The damaged bytes of a frame; they never contain the intact frame."""
        while frame in (bad := self._damage(fault.kind, bytearray(frame))):
            pass
        return bad

    def expected(self) -> dict[str, int]:
        """Counters of the host that the injected faults determine exactly."""
        made = self.injected
        return {"corrupt": sum(made[f"{kind} answer"] for kind in BYTES), "lost": made["disconnect"]}

    def _random_fault(self, kind: str) -> Fault:
        rng, config = self._rng, self.config
        spans = {
            "late": config.late_seconds,
            "stall": config.stall_seconds,
            "disconnect": config.away_seconds,
            "heat": (config.heat_seconds, config.heat_seconds),
            "angle": config.angle_seconds,
            "jam": (config.jam_seconds, config.jam_seconds),
            **dict.fromkeys(("warm", "error", "off", "refuse"), (config.alarm_seconds, config.alarm_seconds)),
        }
        form, radians = self._wrong_angle() if kind == "angle" else ("offset", 0.0)
        fault = Fault(
            kind,
            bool(kind in BYTES and rng.random() < config.on_request),
            float(rng.uniform(*spans[kind])) if kind in spans else 0.0,
            int(rng.integers(frames.JOINTS)),
            form=form,
            radians=radians,
            degrees=config.heat_degrees,
            taxel=(int(rng.integers(frames.TIPS)), int(rng.integers(frames.TAXELS))),
            count=int(rng.integers(config.stuck_count[0], config.stuck_count[1] + 1)),
        )
        return self._random_alarm(fault) if kind in ALARMS else fault

    def _random_alarm(self, fault: Fault) -> Fault:
        """Values of an alarm that are needed by no other fault."""
        rng = self._rng
        number = int(rng.choice(_NUMBERS)) if fault.kind == "refuse" else 1 << int(rng.integers(16))
        return dataclasses.replace(
            fault,
            joint=ALL if fault.kind == "off" and rng.random() < 0.5 else fault.joint,
            board=BOARDS[int(rng.integers(3))],
            number=number,
            part=int(rng.integers(frames.TIPS + 1)),
            current=self.config.jam_current,
        )

    def _wrong_angle(self) -> tuple[str, float]:
        """Form and rad of a wrong angle: an offset, an angle within or near the limits, or a huge number."""
        rng = self._rng
        sort = int(rng.integers(3))
        if sort == 0:
            return "offset", float(rng.choice([-1.0, 1.0]) * rng.uniform(*self.config.angle_offset))
        return "stuck", float(rng.uniform(-0.5, 2.5)) if sort == 1 else float(rng.choice([-1e30, 1e30]))

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
    """A fault with scripted values instead of random ones; ValueError if they do not fit its kind."""
    if not values:
        return fault
    if fault.kind in BYTES:
        (side,) = values
        return dataclasses.replace(fault, on_request=("answer", "request").index(side) == 1)
    if fault.kind == "heat":
        joint, degrees, seconds = values
        changes: dict[str, Any] = {
            "joint": _within(joint, frames.JOINTS),
            "degrees": float(degrees),
            "seconds": float(seconds),
        }
    elif fault.kind == "angle":
        joint, form, radians, seconds = values
        fault = dataclasses.replace(fault, form=_FORMS[_FORMS.index(form)])
        changes = {"joint": _within(joint, frames.JOINTS), "radians": float(radians), "seconds": float(seconds)}
    elif fault.kind == "stuck":
        tip, taxel, count = values
        changes = {"taxel": (_within(tip, frames.TIPS), _within(taxel, frames.TAXELS)), "count": _within(count, 256)}
    elif fault.kind in ALARMS:
        changes = {**_alarm_values(fault.kind, values[:-1]), "seconds": float(values[-1])}
    else:
        (seconds,) = values
        changes = {"seconds": float(seconds)}
    if not 0 <= changes.get("seconds", 0) < 1e6:
        raise ValueError
    return dataclasses.replace(fault, **changes)


def _alarm_values(kind: str, values: tuple[str, ...]) -> dict[str, Any]:
    """Fields of an alarm by its scripted values without the duration."""
    if kind == "error":
        board, joint, bits = values
        return {
            "board": BOARDS[BOARDS.index(board)],
            "joint": _within(joint, frames.JOINTS),
            "number": _within(bits, 1 << 16),
        }
    if kind == "warm":
        part, degrees = values
        return {"part": frames.TIPS if part == "palm" else _within(part, frames.TIPS), "degrees": float(degrees)}
    if kind == "jam":
        joint, current = values
        return {"joint": _within(joint, frames.JOINTS), "current": float(current)}
    (value,) = values
    if kind == "off":
        return {"joint": ALL if value == "all" else _within(value, frames.JOINTS)}
    return {"number": _within(value, 1000)}


def _within(text: str, end: int) -> int:
    number = int(text)
    if not 0 <= number < end:
        raise ValueError
    return number
