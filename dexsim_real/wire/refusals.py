"""What the hand says when it refuses a request: the number in an ERROR frame.

Numbers and names are from the vendor's header; how the frame holds them is not public. Assumed is the full number as
four bytes, low byte first, or its last digits alone.
"""

import dataclasses

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


@dataclasses.dataclass(frozen=True)
class Refusal:
    """Why an exchange was refused, by the hand in an ERROR frame or by the driver."""

    text: str  # for messages
    serious: bool  # the hand itself is in trouble or is another one, or will never take this command


def read_refusal(data: bytes) -> Refusal:
    """The refusal in the data of an ERROR frame."""
    for size in (4, 2, 1):
        code = int.from_bytes(data[:size], "little")
        for number in (code - _BASE, code):
            if len(data) >= size and number in _NAMES:
                return Refusal(f"the hand reports {_NAMES[number]} ({_BASE + number})", number not in _PASSING)
    return Refusal(f"the hand reports an unknown error ({data[:8].hex(' ')})", serious=False)
