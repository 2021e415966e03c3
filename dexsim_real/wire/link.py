"""The link to a hand: configuration, statistics, and the interface that a hand must provide.

`dexsim_real.wire.serial_hand.SerialHand` implements `HandPort` for serial ports. A vendor's SDK can be wrapped in
another implementation.
"""

import dataclasses
import math
from typing import Protocol

import numpy as np

from dexsim.core.config import Config, Range, setting
from dexsim_real.core.errors import HandError
from dexsim_real.wire import frames

BITS_PER_BYTE = 10  # 8N1
_AHEAD = 1.0  # s, by which no stamp of the same clock is ahead
_BASE = 1501000
_NAMES = {
    1: "wrong id",
    2: "unknown command",
    3: "communication error",
    4: "wrong length",
    6: "busy",
    18: "force cannot be read",
    19: "taxels cannot be read",
    20: "temperature cannot be read",
    21: "calibration error",
    26: "parameters not initialised",
    28: "over-temperature",
    29: "mode error",
    30: "parameter out of range",
    34: "position sensor error",
    35: "over-current",
    36: "still booting",
    37: "invalid device id",
    38: "not initialised",
    39: "open failed",
    40: "PDO error",
    41: "SDO error",
    50: "serial communication error",
    67: "invalid mode",
    70: "checksum error",
    80: "current sensor not zeroed",
    81: "force mode not supported",
}
_PASSING = frozenset({2, 3, 4, 6, 18, 19, 20, 36, 39, 40, 41, 50, 70})


@dataclasses.dataclass(frozen=True, kw_only=True)
class LinkConfig(Config):
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
    backoff: Range = setting((0.1, 0.5), unit="s", low=0.001, high=600.0)
    """First and longest wait between attempts to reconnect; it doubles at each attempt."""

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
class Refusal:
    """Why an exchange was refused, by the hand in an ERROR frame or by the driver."""

    text: str  # for messages
    serious: bool  # the hand itself is in trouble or is another one, or will never take this command


def read_refusal(data: bytes) -> Refusal:
    """The refusal in the data of an ERROR frame.

    Numbers and names are from the vendor's header; how the frame holds them is not public. Assumed is the full number
    as four bytes, low byte first, or its last digits alone.
    """
    for size in (4, 2, 1):
        code = int.from_bytes(data[:size], "little")
        for number in (code - _BASE, code):
            if len(data) >= size and number in _NAMES:
                return Refusal(f"the hand reports {_NAMES[number]} ({_BASE + number})", number not in _PASSING)
    return Refusal(f"the hand reports an unknown error ({data[:8].hex(' ')})", serious=False)


@dataclasses.dataclass(frozen=True)
class Reply:
    """An answered exchange."""

    state: np.ndarray  # `frames.STATE_BLOCK`
    sent: float  # s, monotonic clock
    received: float  # s
    sequence: int  # number of this exchange since the port was created
    generation: int  # number of handshakes; it grows when the hand was disconnected


def checked(reply: Reply, now: float) -> Reply:
    """A reply that the loop can rely on: a driver from elsewhere may have made it.

    A stamp a little ahead of `now` s becomes `now`: it must grow old. Raises HandError: no reply, its state is none or
    of another hand, or it was stamped by another clock.
    """
    if not isinstance(reply, Reply):
        raise HandError(f"the driver answered with {type(reply).__name__}; expected a `Reply`, or None")
    # A copy: a driver may have one buffer for all its answers. Plain numbers: a log keeps NumPy's as arrays.
    state = np.array(reply.state)
    if state.dtype != frames.STATE_BLOCK or state.shape != ():
        raise HandError(
            f"the driver's reply has a state of {state.dtype.name} {list(state.shape)}; expected a `frames.STATE_BLOCK`"
        )
    if not np.array_equal(state["joint"]["id"], np.arange(frames.JOINTS)):
        raise HandError(f"the driver's reply has joint ids {state['joint']['id'].tolist()}; expected 0 to 11")
    sent, received = float(reply.sent), float(reply.received)
    if not (math.isfinite(sent) and received <= now + _AHEAD):
        raise HandError(
            f"the driver stamped its reply {received - now:.3g} s ahead: `Reply` has times of `time.monotonic()`"
        )
    return Reply(state, sent, min(received, now), int(reply.sequence), int(reply.generation))


def refusal_of(port: "HandPort") -> Refusal | None:
    """Why the newest exchange was refused, if the port tells it."""
    return getattr(port, "refusal", None)


def greet(port: "HandPort") -> list[str]:
    """Connect a hand; returns lines for the user: what it is, and the port's warnings. HandError: see `HandPort`."""
    line = port.connect()
    warnings = port.warnings() if hasattr(port, "warnings") else []
    return [line, *(f"warning: {warning}" for warning in warnings)]


class HandPort(Protocol):
    """The interface of a hand. `exchange` is called from one thread only.

    A port may also have `warnings()`, lines for the user; `identity`, a `dexsim_real.wire.identity.Identity` or None;
    and `refusal`, a `Refusal` when the newest exchange was refused, else None.
    """

    counts: LinkCounts

    def connect(self) -> str:
        """Open the port and identify the hand; returns a line that describes it. Motors stay off.

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
