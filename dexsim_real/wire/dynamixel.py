"""A driver for hands of Dynamixel motors, such as the LEAP Hand's sixteen XL330 or XC330: protocol 2.0 on pyserial.

A file of your own tells port and motors (docs/bridge.md). They run in the current-based position mode:
`--hardware.torque-max` is their goal current in mA, `--hardware.kp`, `ki` and `kd` are the registers of the position
gains. An angle of 0 is the middle of the encoder's turn, 180 degrees in the maker's tools. Packets, checksum and
registers are those of the maker's e-manual (protocol 2.0; XL330, XC330).
"""

import functools
import time
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from dexsim_real.core.errors import HandError, open_serial
from dexsim_real.core.stream import FrameParser
from dexsim_real.wire.driver import DriverState, HandDriver, JointTargets

HEADER = b"\xff\xff\xfd\x00"
BROADCAST = 0xFE
READ_ALL, WRITE_ALL, STATUS = 0x82, 0x83, 0x55  # instructions: sync read, sync write, and a motor's answer
ALERT = 0x80  # bit of an answer's error: its hardware error status is not 0; the others say why a request failed
POSITION_BY_CURRENT = 5  # operating mode: position control within a current limit
_STUFFED, _PLAIN = b"\xff\xff\xfd\xfd", b"\xff\xff\xfd"
_TICK = 2 * np.pi / 4096  # rad
_MIDDLE = 2048  # ticks
_MARGIN = 0.008  # s for the answers, besides their time on the wire
_POLL = 0.001  # s, longest wait of one read
_TRIES = 5  # at a motor's settings
_LONGEST = 64  # bytes after the length of an answer; more in a header is damage
_HEALTH_EVERY = 8  # reads between two looks at torque and errors of motors that report no alert


class Register:
    """A range of the control table: the type of its fields, and its `span`, address and size as requests have them."""

    def __init__(self, address: int, *fields: tuple[str, str]):
        self.dtype = np.dtype(list(fields))
        self.span = address.to_bytes(2, "little") + self.dtype.itemsize.to_bytes(2, "little")


SETTINGS = Register(9, ("return_delay", "u1"), ("drive_mode", "u1"), ("operating_mode", "u1"))
CURRENT_LIMIT = Register(38, ("value", "<u2"))  # mA
HEALTH = Register(64, ("torque", "u1"), ("between", "V5"), ("error", "u1"))
TORQUE = Register(64, ("value", "u1"))
GAINS = Register(80, ("kd", "<u2"), ("ki", "<u2"), ("kp", "<u2"))
GOAL_CURRENT = Register(102, ("value", "<i2"))  # mA
GOAL_POSITION = Register(116, ("value", "<i4"))  # ticks
PRESENT = Register(
    126, ("current", "<i2"), ("velocity", "<i4"), ("position", "<i4"), ("between", "V10"), ("temperature", "u1")
)  # mA; 0.229 rev/min; ticks; degC


def crc16(data: bytes | bytearray) -> int:
    """CRC-16 of the protocol: polynomial 0x8005, start 0, not reflected; 0xFEE8 for b"123456789"."""
    value = 0
    for byte in data:
        value = (value << 8 & 0xFFFF) ^ _crc_row(value >> 8 ^ byte)
    return value


@functools.cache
def _crc_row(byte: int) -> int:
    value = byte << 8
    for _ in range(8):
        value = (value << 1) ^ (0x8005 if value & 0x8000 else 0)
    return value & 0xFFFF


def packet(motor: int, instruction: int, data: bytes) -> bytes:
    """The bytes of a packet: `_PLAIN` in its content is followed by one more FD, so that no header appears there."""
    body = (bytes([instruction]) + data).replace(_PLAIN, _STUFFED)
    head = HEADER + bytes([motor]) + (len(body) + 2).to_bytes(2, "little") + body
    return head + crc16(head).to_bytes(2, "little")


class Answer(NamedTuple):
    """A status packet."""

    motor: int
    error: int
    data: bytes


def make_parser() -> FrameParser[Answer]:
    """Finds the answers in a stream of bytes; other packets are the echo of an adapter."""

    def size(header: bytes) -> int:
        length = int.from_bytes(header[5:7], "little")
        return 7 + length if 4 <= length <= _LONGEST else 0

    def decode(whole: bytes) -> Answer | None:
        body = whole[7:-2].replace(_STUFFED, _PLAIN)
        sound = crc16(whole[:-2]) == int.from_bytes(whole[-2:], "little")
        return Answer(whole[4], body[1], body[2:]) if sound and body[0] == STATUS else None

    return FrameParser(HEADER, 7, size, decode)


class DynamixelHand(HandDriver):
    """Driver of a hand whose joints are one Dynamixel X motor each; `ids` are those of the motors.

    Raises HandError: an id is given twice, or is none of a motor.
    """

    measures = frozenset({"currents", "temperatures"})

    def __init__(self, port: str, ids: Sequence[int], baud: int = 4_000_000):
        if len(set(ids)) < len(ids) or not set(ids) <= set(range(253)):
            raise HandError(f"motor ids {list(ids)}: expected different numbers from 0 to 252")
        self.port, self.ids, self.baud = port, list(ids), baud
        self._serial: Any = None
        self._written: dict[Register, bytes] = {}  # what the motors have, of what changes rarely
        self._limit = np.zeros(len(ids))  # [J] mA
        self._on, self._look = False, 0  # what was commanded; reads until the next look at the motors' health
        self._health = np.zeros(len(ids), HEALTH.dtype)

    def connect(self) -> str:
        """Motors are set to the current-based position mode, and to answer at once."""
        self.close()
        self._serial = open_serial(self.port, self.baud, timeout=_POLL, write_timeout=0.1)
        self._write(TORQUE, 0)  # Settings cannot be changed otherwise.
        settings = self._insist(SETTINGS)
        required = settings.copy()
        required["return_delay"], required["operating_mode"] = 0, POSITION_BY_CURRENT
        if not np.array_equal(settings, required):
            self._write(SETTINGS, required)
            if not np.array_equal(self._insist(SETTINGS), required):
                raise HandError(f"{self.port}: the motors do not keep their operating mode; power-cycle the hand")
        self._limit = self._insist(CURRENT_LIMIT)["value"].astype(float)
        self._written, self._on, self._look = {}, False, 0
        return f"{self.port}: {len(self.ids)} Dynamixel motors, current limits {self._limit.min():.0f} mA or more"

    def send(self, targets: JointTargets) -> None:
        """Motors come on after they have their first target."""
        if targets.on != self._on:
            self._look = 0
        self._on = targets.on
        if not targets.on:
            self._write(TORQUE, 0)
            self._written = {}
            return
        gains = np.zeros(len(self.ids), GAINS.dtype)
        for name in ("kp", "ki", "kd"):
            gains[name] = np.clip(getattr(targets, name), 0, 16383)
        self._write(GAINS, gains, again=False)
        # A goal above the limit would be refused, without an answer.
        self._write(GOAL_CURRENT, np.minimum(1e3 * targets.current, self._limit), again=False)
        self._write(GOAL_POSITION, np.round(targets.position / _TICK) + _MIDDLE)
        self._write(TORQUE, 1, again=False)

    def read(self) -> DriverState | None:
        present, alert = self._read(PRESENT)
        if present is None:
            return None
        if alert or not self._on or self._look <= 0:
            health, _ = self._read(HEALTH)
            if health is None:
                return None
            self._health, self._look = health, _HEALTH_EVERY
        self._look -= 1
        return DriverState(
            position=(present["position"] - _MIDDLE) * _TICK,
            on=self._health["torque"] == 1,
            current=present["current"] * 1e-3,
            temperature=present["temperature"],
            errors=self._health["error"],
        )

    def close(self) -> None:
        if self._serial is not None:
            self._serial.close()
            self._serial = None

    def _insist(self, register: Register) -> np.ndarray:
        """The values [J] of a register. HandError: a motor does not answer."""
        for _ in range(_TRIES):
            values, _ = self._read(register)
            if values is not None:
                return values
        silent = [motor for motor in self.ids if motor not in self._answered]
        which = ", ".join(map(str, silent)) or "in time"
        raise HandError(f"{self.port}: no answer of the motors {which}; check power, ids, and baud rate ({self.baud})")

    def _read(self, register: Register) -> tuple[np.ndarray | None, bool]:
        """The values [J] of a register, None unless all motors answer in time; and whether one reports an alert."""
        size = register.dtype.itemsize
        request = packet(BROADCAST, READ_ALL, register.span + bytes(self.ids))
        self._serial.reset_input_buffer()
        self._serial.write(request)
        until = time.monotonic() + 10 * (len(request) + len(self.ids) * (size + 11)) / self.baud + _MARGIN
        parser, answers = make_parser(), dict[int, Answer]()
        while len(answers) < len(self.ids) and time.monotonic() < until:
            for answer in parser.feed(self._serial.read(max(self._serial.in_waiting, 1))):
                if answer.motor in self.ids and len(answer.data) == size and not answer.error & ~ALERT:
                    answers[answer.motor] = answer
        self._answered = set(answers)
        if len(answers) < len(self.ids):
            return None, False
        data = b"".join(answers[motor].data for motor in self.ids)
        return np.frombuffer(data, register.dtype), any(answer.error & ALERT for answer in answers.values())

    def _write(self, register: Register, values: np.ndarray | float, again: bool = True) -> None:
        """Write the values [J] of a register, not `again` if the motors have them; motors do not answer it."""
        content = np.zeros(len(self.ids), register.dtype)
        content[:] = values
        rows = b"".join(bytes([motor]) + value.tobytes() for motor, value in zip(self.ids, content, strict=True))
        if again or self._written.get(register) != rows:
            self._serial.write(packet(BROADCAST, WRITE_ALL, register.span + rows))
            self._written[register] = rows
