"""The hand's wire format on RS485: frames, checksum, command and state blocks, parser.

    55 AA | source | target | command | length, low byte first | data | CRC, low byte first

The CRC is CRC-16/XMODEM (polynomial 0x1021, start 0) over everything before it. A host sends `EXCHANGE` with twelve
joint commands and receives the whole state; an emulated hand does the reverse. Layouts come from public drivers and
headers; docs/hardware.md says how certain each one is.
"""

import binascii
import dataclasses
import enum
import struct
from collections.abc import Mapping

import numpy as np

from dexsim_real.core.errors import HandError
from dexsim_real.core.stream import FrameParser

HEAD = b"\x55\xaa"
HEADER = struct.Struct("<2sBBBH")
OVERHEAD = HEADER.size + 2  # bytes of a frame without data
HOST = 0xFE
BROADCAST = 0xFF
JOINTS, TIPS, TAXELS = 12, 5, 120


class Command(enum.IntEnum):
    """Command byte of a frame, in requests and answers: those that the bridge knows."""

    ERROR = 0x00
    EXCHANGE = 0x02  # request: joint commands; answer: whole state
    VERSION = 0x13
    READ_REGISTER = 0x15


class Mode(enum.IntEnum):
    """Control mode of a joint."""

    PASSIVE = 0  # motor off; on some firmware not fully limp
    POSITION = 3
    FORCE = 5  # rejected by some units


JOINT_COMMAND = np.dtype(
    [
        ("id", "<u2"),
        ("kp", "<i2"),
        ("ki", "<i2"),
        ("kd", "<i2"),
        ("position", "<f4"),  # rad
        ("torque_max", "<i2"),  # mA
        ("mode", "<u2"),
        ("reserved", "<u2", 4),
    ]
)
COMMAND_BLOCK = np.dtype((JOINT_COMMAND, JOINTS))
"""Data of an `EXCHANGE` from the host, 288 bytes."""

JOINT_STATE = np.dtype(
    [
        ("id", "u1"),
        ("sensor_id", "u1"),
        ("position", "<f4"),  # rad
        ("current", "<i2"),  # mA; vendor headers call it torque
        ("raw_position", "<u2"),  # bits 0-3 mode, 4-15 encoder
        ("temperature", "<u2"),  # degC: low byte joint board, high byte palm board
        ("palm_error", "<u2"),
        ("joint_error", "<u2"),
        ("tip_error", "<u2"),  # bit fields
        ("velocity", "<i2"),  # 1e-3 rad/s on newer firmware, undefined on older
        ("reserved", "<u2", 2),
    ]
)
FORCE = np.dtype([("x", "i1"), ("y", "i1"), ("z", "u1")])  # counts; z presses into the tip
TIP_STATE = np.dtype(
    [("total", FORCE), ("taxel", FORCE, TAXELS), ("taxel_temperature", "u1", 20), ("temperature", "u1")]
)  # degC
STATE_BLOCK = np.dtype([("joint", JOINT_STATE, JOINTS), ("tip", TIP_STATE, TIPS)])
"""Data of an `EXCHANGE` from the hand, 2208 bytes."""


def driver_block(joints: int, fingers: int, taxels: int) -> np.dtype:
    """The state of a hand with a driver of its own: fields of `STATE_BLOCK`, not rounded to the wire's integers.

    Units are those of the wire, in which sensing has its limits: mA, and taxel counts of 0.1 N. Currents are NaN where
    the hand has none.
    """
    words = ("raw_position", "temperature", "palm_error", "joint_error", "tip_error")
    joint = np.dtype([("id", "<u2"), ("position", "<f4"), ("current", "<f4"), *((word, "<u2") for word in words)])
    force = np.dtype([(axis, "<f4") for axis in "xyz"])
    tip = np.dtype([("taxel", force, (taxels,)), ("temperature", "u1")])
    return np.dtype([("joint", joint, (joints,)), ("tip", tip, (fingers,))])


HAND_REPLIES: dict[int, range] = {
    Command.EXCHANGE: range(STATE_BLOCK.itemsize, STATE_BLOCK.itemsize + 1),
    Command.ERROR: range(1, 65),
    Command.VERSION: range(1, 65),
    Command.READ_REGISTER: range(5, 65),
}
"""Valid data lengths of answers. None fits a request, so the echo of an adapter is never mistaken for the hand."""
HOST_REQUESTS: dict[int, range] = {
    Command.EXCHANGE: range(COMMAND_BLOCK.itemsize, COMMAND_BLOCK.itemsize + 1),
    Command.VERSION: range(0, 1),
    Command.READ_REGISTER: range(1, 5),
}
"""Valid data lengths of requests."""


def palm_address(hand_id: int) -> int:
    """Bus address of a hand's palm board."""
    return hand_id | 0x80


PALMS = range(palm_address(0), palm_address(125) + 1)  # bus addresses of all palm boards


@dataclasses.dataclass(frozen=True)
class Frame:
    """A frame without head and checksum."""

    source: int
    target: int
    command: int
    data: bytes = b""

    def encode(self) -> bytes:
        """The bytes on the wire."""
        body = HEADER.pack(HEAD, self.source, self.target, self.command, len(self.data)) + self.data
        return body + binascii.crc_hqx(body, 0).to_bytes(2, "little")


class Parser(FrameParser[Frame]):
    """The frames of a stream; `lengths` are `HAND_REPLIES` or `HOST_REQUESTS`.

    A header is valid only with a known command and a length that this command can have. Then the checksum decides.
    """

    def __init__(self, lengths: Mapping[int, range]):
        def size(header: bytes) -> int:
            *_, command, size = HEADER.unpack(header)
            return OVERHEAD + size if size in lengths.get(command, ()) else 0

        super().__init__(HEAD, HEADER.size, size, _read_frame)


def _read_frame(data: bytes) -> Frame | None:
    _, source, target, command, _ = HEADER.unpack_from(data)
    sound = binascii.crc_hqx(data[:-2], 0) == int.from_bytes(data[-2:], "little")
    return Frame(source, target, command, data[HEADER.size : -2]) if sound else None


def command_block(position: np.ndarray, mode: int = Mode.POSITION, **fields: np.ndarray | int) -> np.ndarray:
    """Joint commands [J], a `COMMAND_BLOCK` on the wire: angles [J] rad, then gains kp, ki and kd in the firmware's
    units and torque_max in mA, which are 0 unless given; a scalar is for all."""
    block = np.zeros(len(position), JOINT_COMMAND)
    for name, value in {"id": np.arange(len(position)), "position": position, "mode": mode, **fields}.items():
        block[name] = value
    return block


def empty_state() -> np.ndarray:
    """A `STATE_BLOCK` of zeros with its ids set."""
    block = np.zeros((), STATE_BLOCK)
    block["joint"]["id"] = np.arange(JOINTS)
    return block


def passive_command(joints: int = JOINTS) -> np.ndarray:
    """Joint commands [J] with all motors off."""
    return command_block(np.zeros(joints), Mode.PASSIVE)


def decode(data: bytes, dtype: np.dtype = STATE_BLOCK) -> np.ndarray:
    """The block in the data of an `EXCHANGE`: the hand's state, or joint commands (`COMMAND_BLOCK`).

    Raises HandError: wrong size, or joint ids that do not count up.
    """
    if len(data) != dtype.itemsize:
        raise HandError(f"block of {len(data)} bytes, expected {dtype.itemsize}")
    block = np.frombuffer(data, dtype.base).reshape(dtype.shape).copy()
    ids = block["id"] if dtype.base == JOINT_COMMAND else block["joint"]["id"]
    if not np.array_equal(ids, np.arange(len(ids))):
        raise HandError(f"expected joint ids 0 to {len(ids) - 1} in order, got {ids.tolist()}")
    return block
