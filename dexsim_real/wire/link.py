"""The link to a hand: configuration, statistics, and the interface that a hand must provide.

`dexsim_real.wire.serial_hand.SerialHand` implements `HandPort` for serial ports. A vendor's SDK can be wrapped in
another implementation.
"""

import dataclasses
import math
import numbers
from typing import Any, Protocol

import numpy as np

from dexsim.core.config import check_ranges, setting, validate
from dexsim_real.core.errors import HandError
from dexsim_real.wire import frames
from dexsim_real.wire.refusals import Refusal

BITS_PER_BYTE = 10  # 8N1
_AHEAD = 1.0  # s, by which no stamp of the same clock is ahead
_NUMBERS: dict[str, type] = {
    "sent": numbers.Real,
    "received": numbers.Real,
    "sequence": numbers.Integral,
    "generation": numbers.Integral,
}
"""Fields of a `Reply` that are one number."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class LinkConfig:
    """The serial line."""

    baud: int = setting(3_000_000, unit="1/s", low=1200, high=20_000_000)
    """Bits per second."""
    hand_id: int = setting(0, unit="1", low=0, high=125)
    """Id of the hand; its palm board has the bus address 0x80 + id."""
    margin: float = setting(0.020, unit="s", low=0.0005, high=5.0)
    """Timeout of an answer, in addition to its time on the wire. A USB adapter with a latency timer of 16 ms needs
    most of it."""
    settle: float = setting(1.0, unit="s", low=0.0, high=30.0)
    """Wait after opening the port; before that the firmware answers with damaged frames."""
    handshake: float = setting(1.0, unit="s", low=0.01, high=60.0)
    """Time after which a hand that has not answered counts as absent."""
    paced: bool = setting(True)
    """Reject answers that arrive sooner than the baud rate allows: they belong to an earlier request. Turn this off for
    an emulated line without timing."""
    backoff: tuple[float, float] = setting((0.1, 0.5), unit="s", low=0.001, high=600.0)
    """First and longest wait between attempts to reconnect; it doubles at each attempt."""

    def __post_init__(self):
        validate(self)
        check_ranges(self, "backoff")

    def deadline(self, request: int, reply: int) -> float:
        """Timeout in s for `reply` bytes after sending `request` bytes."""
        return self.on_wire(request + reply) + self.margin

    def on_wire(self, size: int) -> float:
        """Seconds that this number of bytes takes on the wire."""
        return size * BITS_PER_BYTE / self.baud


@dataclasses.dataclass
class LinkCounts:
    """Statistics of a link. Each request ends as answered, corrupt, silent, refused or lost."""

    sent: int = 0
    answered: int = 0
    corrupt: int = 0  # bytes arrived, but no valid answer
    silent: int = 0  # nothing arrived in time
    refused: int = 0  # the hand answered with an error
    lost: int = 0  # the port failed
    late: int = 0  # answers that arrived after their deadline and were discarded
    crc_errors: int = 0
    resyncs: int = 0
    reconnects: int = 0


@dataclasses.dataclass(frozen=True)
class Reply:
    """An answered exchange."""

    state: np.ndarray  # `frames.STATE_BLOCK`
    sent: float  # s, monotonic clock
    received: float  # s
    sequence: int  # number of this exchange since the port was created
    generation: int  # number of handshakes; it grows when the hand was disconnected


def checked(reply: Reply, now: float) -> Reply:
    """A reply that its reader can rely on: a driver from elsewhere may have been wrong about it.

    Args:
      reply: of a port.
      now: s, of the clock that `received` is of. A stamp a little ahead of it becomes `now`: it must grow old.

    Raises:
      HandError: it is no reply, its state is none, is of another hand, or was stamped by another clock.
    """
    if not isinstance(reply, Reply):
        raise HandError(
            f"the driver answered with {type(reply).__name__}; expected a `Reply`, or None without an answer"
        )
    for name, kind in _NUMBERS.items():
        if not isinstance(value := getattr(reply, name), kind):
            raise HandError(f"the driver's reply has {name} {value!r:.80}; expected a number")
    # A copy: a driver may have one buffer for all its answers. Plain numbers: a log keeps NumPy's as arrays.
    state = np.copy(reply.state) if isinstance(reply.state, np.ndarray) else reply.state
    sent, received = float(reply.sent), float(reply.received)
    if not math.isfinite(sent):
        raise HandError(f"the driver's reply has sent {sent!r}; expected a number")
    if not isinstance(state, np.ndarray) or state.dtype != frames.STATE_BLOCK or state.shape != ():
        kind_of_state = (
            f"{state.dtype.name} {list(state.shape)}" if isinstance(state, np.ndarray) else type(state).__name__
        )
        raise HandError(f"the driver's reply has a state of {kind_of_state}; expected one `frames.STATE_BLOCK`")
    if not np.array_equal(state["joint"]["id"], np.arange(frames.JOINTS)):
        raise HandError(f"the driver's reply has joint ids {state['joint']['id'].tolist()}; expected 0 to 11")
    if not math.isfinite(received) or received > now + _AHEAD:
        raise HandError(
            f"the driver stamped its reply {received - now:.3g} s ahead: `Reply.received` is of `time.monotonic()`"
        )
    sequence, generation = int(reply.sequence), int(reply.generation)
    return Reply(state, sent, min(received, now), sequence, generation)


def refusal_of(port: "HandPort") -> Refusal | None:
    """Why the newest exchange was refused, if the port tells it.

    Raises:
      HandError: the driver tells it in another form.
    """
    refusal = getattr(port, "refusal", None)
    if refusal is not None and not isinstance(refusal, Refusal):
        raise HandError(f"the driver's `refusal` is {refusal!r:.80}; expected a `Refusal`, or None")
    return refusal


def greet(port: "HandPort") -> list[str]:
    """Connect a hand; returns lines for the user: what it is, and the port's warnings.

    Raises:
      HandError: see `HandPort.connect`; or a driver returned something else than text.
    """
    line = port.connect()
    warnings: Any = getattr(port, "warnings", list)
    warnings = warnings() if callable(warnings) else warnings
    if not isinstance(line, str):
        raise HandError(f"the driver's `connect` returned {line!r:.80}; expected one line of text")
    if not isinstance(warnings, list | tuple) or not all(isinstance(warning, str) for warning in warnings):
        raise HandError(f"the driver's `warnings` returned {warnings!r:.80}; expected a list of lines")
    return [line, *(f"warning: {warning}" for warning in warnings)]


def check_port(port: Any, spec: str) -> None:
    """Check that a driver's function returned a port.

    Raises:
      HandError: it returned something else.
    """
    lacking = [name for name in ("counts", "connect", "exchange", "close") if not hasattr(port, name)]
    if lacking:
        raise HandError(f"{spec}: it returned {type(port).__name__} without {lacking[0]!r}; expected a `HandPort`")
    if not isinstance(port.counts, LinkCounts):
        raise HandError(f"{spec}: `counts` is {type(port.counts).__name__}; expected `LinkCounts`")


class HandPort(Protocol):
    """The interface of a hand. `exchange` is called from one thread only.

    A port may also have `warnings()`, lines for the user; `identity`, a `dexsim_real.wire.identity.Identity` or None;
    and `refusal`, a `dexsim_real.wire.refusals.Refusal` when the newest exchange was refused, else None.
    """

    counts: LinkCounts

    def connect(self) -> str:
        """Open the port and identify the hand. Motors stay off.

        Returns:
          One line that describes the hand.

        Raises:
          HandError: the port cannot be opened, or the hand does not answer.
        """
        ...

    def exchange(self, command: np.ndarray) -> Reply | None:
        """Send joint commands (`frames.COMMAND_BLOCK`); None when no valid answer arrived in time.

        Line errors never raise. It returns within a second, also while the hand is gone: the guard process takes a
        runner that does not move for dead. After a reconnection the given command is not sent: the first reply of a new
        generation comes from a passive hand.
        """
        ...

    def close(self) -> None:
        """Close the port; no error where it is closed already."""
        ...
