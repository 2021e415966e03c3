"""Whose hand it is: serial number and side, read at start and after every reconnection.

The vendor's header names register 20 (side of the hand) and 21 (serial number, 32 bytes), and its manual the models
2L32 (left) and 2R32 (right), with which serial numbers begin. How an answer holds a register is not public. Assumed is
what the emulated hand sends: the register's number in two bytes, low byte first, then its content.
"""

from typing import NamedTuple

from dexsim.calibration.maps import Calibration
from dexsim.hand.description import Hand
from dexsim_real.core.errors import HandError

SIDE, SERIAL_NUMBER = 20, 21
"""Registers."""
_WORDS = {"l": "left", "left": "left", "r": "right", "right": "right", "2l32": "left", "2r32": "right"}


class Identity(NamedTuple):
    """What a hand tells about itself; a field is empty if it does not."""

    serial_number: str = ""
    handedness: str = ""  # "left", "right", or "code N" when the meaning of the answer is not known

    def __str__(self) -> str:
        return f"{self.handedness or 'unknown side'}, serial number {self.serial_number or 'unknown'}"


def read_identity(serial_number: bytes, side: bytes) -> Identity:
    """The identity in the contents of the two registers; empty for one that the hand did not answer."""
    text = printable(serial_number)
    known = [_WORDS[word] for word in (printable(side).lower(), text[:4].lower()) if word in _WORDS]
    return Identity(text, known[0] if known else f"code {side[0]}" if side else "")


def check_identity(identity: Identity, hand: Hand, calibration: Calibration | None = None) -> list[str]:
    """Check that a hand fits the model and the calibration; returns notes about what could not be checked.

    Raises:
      HandError: it is another hand.
    """
    serial, side = identity
    if side in ("left", "right") and side != hand.side:
        raise HandError(f"this is a {side} hand (serial number {serial}), the model a {hand.side} one: see --hand")
    known = (calibration.serial, calibration.handedness) if calibration else ("", "")
    if known[0] and serial != known[0]:
        this = f"this is hand {serial}" if serial else "the hand does not tell its serial number"
        raise HandError(
            f"{this}, the calibration is of hand {known[0]}: calibrate this hand, or remove the serial number from the "
            "file if it is this hand's"
        )
    if known[1] and side and side != known[1]:
        raise HandError(f"this hand is {side}, the calibration is of a {known[1]} one: calibrate this hand")
    notes = []
    if not serial:
        notes.append("the hand does not tell its serial number: another hand on this port would not be noticed")
    elif calibration and not known[0]:
        notes.append("the calibration names no serial number: it may be of another hand")
    if side.startswith("code"):
        notes.append(f"the hand gives its side as {side}, whose meaning is not known")
    return [f"warning: {note}" for note in notes]


def printable(content: bytes) -> str:
    """The text at the beginning of a register or an answer; empty for what is none."""
    text = content.split(b"\0")[0].decode("ascii", "replace").strip()
    return text if text.isprintable() and text.isascii() else ""
