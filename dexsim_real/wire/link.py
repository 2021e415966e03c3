"""The line to a hand: its configuration, what is counted on it, and what the bridge needs of any hand.

`dexsim_real.wire.serial_hand.SerialHand` is the one `HandPort` that comes along; a vendor's SDK that the user has
installed can be another.
"""

import dataclasses
from typing import Protocol

import numpy as np

from dexsim.core.config import check_ranges, setting, validate

BITS_PER_BYTE = 10  # 8N1


@dataclasses.dataclass(frozen=True, kw_only=True)
class LinkConfig:
    """The serial line."""

    baud: int = setting(3_000_000, unit="1/s", low=1200, high=20_000_000)
    """Bits per second."""
    hand_id: int = setting(0, unit="1", low=0, high=125)
    """Id of the hand; its palm board answers at 0x80 + id."""
    margin: float = setting(0.020, unit="s", low=0.0005, high=5.0)
    """Time that an answer may take beyond its time on the wire. A USB adapter with its latency
    timer at 16 ms needs most of this."""
    settle: float = setting(1.0, unit="s", low=0.0, high=30.0)
    """Pause after opening: the firmware answers damaged frames before."""
    handshake: float = setting(1.0, unit="s", low=0.01, high=60.0)
    """How long the hand is asked before it counts as silent."""
    paced: bool = setting(True)
    """Believe no answer that comes sooner than request and answer take on the wire: it belongs to an earlier
    request. For an emulated line that has no pace, turn it off."""
    backoff: tuple[float, float] = setting((0.1, 3.0), unit="s", low=0.001, high=600.0)
    """First and longest pause between attempts to reconnect; each is twice the one before."""

    def __post_init__(self):
        validate(self)
        check_ranges(self, "backoff")

    def deadline(self, request: int, reply: int) -> float:
        """Seconds from sending `request` bytes until `reply` bytes must have come."""
        return self.on_wire(request + reply) + self.margin

    def on_wire(self, size: int) -> float:
        """Seconds that so many bytes take."""
        return size * BITS_PER_BYTE / self.baud


@dataclasses.dataclass
class LinkCounts:
    """Every request ends as exactly one of answered, corrupt, silent, refused or lost."""

    sent: int = 0
    answered: int = 0
    corrupt: int = 0  # bytes came, but no sound answer
    silent: int = 0  # nothing came in time
    refused: int = 0  # the hand answered with an error
    lost: int = 0  # the port failed
    late: int = 0  # answers that came after their deadline and were thrown away
    crc_errors: int = 0
    resyncs: int = 0
    reconnects: int = 0


@dataclasses.dataclass(frozen=True)
class Reply:
    """An answered exchange."""

    state: np.ndarray  # `frames.STATE_BLOCK`
    sent: float  # s, monotonic clock
    received: float  # s
    sequence: int  # of this exchange since the port was made
    generation: int  # handshakes so far: another number means that the hand was away


class HandPort(Protocol):
    """What the bridge needs of a hand. `exchange` is called from one thread only."""

    counts: LinkCounts

    def connect(self) -> str:
        """Open, greet, and say in one line what was found. Motors stay off.

        Raises:
          HandError: what is wrong, and what helps.
        """
        ...

    def exchange(self, command: np.ndarray) -> Reply | None:
        """Send joint commands (`frames.COMMAND_BLOCK`); None when no sound answer came in time.

        Never raises for trouble on the line. After a reconnection the command given is not sent:
        the first reply of a new generation comes from a passive hand.
        """
        ...

    def close(self) -> None: ...
