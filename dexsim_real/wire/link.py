"""The link to a hand: configuration, statistics, and the port that the exchange loop talks to.

`SerialHand` is the `HandPort` of the XHand's serial line: it sends the frames of `dexsim_real.wire.frames` over
pyserial, to a USB adapter or a pseudo-terminal. `dexsim_real.wire.driver.DriverPort` is that of any other hand.
"""

import contextlib
import dataclasses
import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from dexsim.calibration.maps import Calibration
from dexsim.core.config import Config, Range, setting
from dexsim.hand.description import Hand
from dexsim_real.core.errors import HandError, open_serial
from dexsim_real.wire import frames
from dexsim_real.wire.frames import Command, Frame, Mode, passive_command

SIDE, SERIAL_NUMBER = 20, 21
"""Registers of the hand's side and of its serial number (32 bytes), by the vendor's header. How an answer holds a
register is not public. Assumed is what the emulated hand sends: the register's number in two bytes, low byte first,
then its content. Serial numbers begin with the model, by the manual 2L32 (left) or 2R32 (right)."""
UNCONFIRMED = "the hand did not confirm that its motors are off"
PATIENCE = 5.0  # s for which a hand whose motors may be on and that does not answer is told to turn them off
BRIEF = 0.3  # s, the same for a hand that was off already
_PAUSE = 0.002  # s, of a call while the hand is gone
_AGAIN = 0.01  # s after an error of the port, until it is told again to turn the motors off
BITS_PER_BYTE = 10  # 8N1
_POLL = 0.002  # s, longest wait of one read
_WRITE = 0.5  # s, longest write; a longer one counts as a failure of the port
_QUIET = 0.006  # s without a byte after which a frame has ended
_ATTEMPTS = 2  # to read a register
_REGISTER = 34  # bytes of the answer: number and content
_LONGEST = frames.OVERHEAD + frames.STATE_BLOCK.itemsize  # bytes of the longest answer
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
_WORDS = {"l": "left", "left": "left", "r": "right", "right": "right", "2l32": "left", "2r32": "right"}
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

    state: np.ndarray  # `frames.STATE_BLOCK` or `frames.driver_block`
    sent: float  # s, monotonic clock
    received: float  # s
    sequence: int  # number of this exchange since the port was created
    generation: int  # number of handshakes; it grows when the hand was disconnected

    @property
    def on(self) -> bool:
        """Whether a motor reports to be on. If all are told to be off, it is a late answer to a command before."""
        return bool(np.any(self.state["joint"]["raw_position"] & 0xF == Mode.POSITION))


class Identity(NamedTuple):
    """What a hand tells about itself; a field is empty if it does not."""

    serial_number: str = ""
    handedness: str = ""  # "left", "right", or "code N" when the meaning of the answer is not known

    def __str__(self) -> str:
        return f"{self.handedness or 'unknown side'}, serial number {self.serial_number or 'unknown'}"


def read_identity(serial_number: bytes, side: bytes) -> Identity:
    """The identity in the contents of the two registers; empty for one that the hand did not answer."""
    text = printable(serial_number)
    sides = [_WORDS[word] for word in (printable(side).lower(), text[:4].lower()) if word in _WORDS]
    return Identity(text, sides[0] if sides else f"code {side[0]}" if side else "")


def check_identity(identity: Identity, hand: Hand, calibration: Calibration | None = None) -> list[str]:
    """Check that a hand fits the model and the calibration; returns notes about what could not be checked.

    Raises HandError: it is another hand.
    """
    serial, side = identity
    if side in ("left", "right") and side != hand.side:
        raise HandError(f"this is a {side} hand (serial number {serial}), the model a {hand.side} one: see --hand")
    expected = (calibration.serial, calibration.handedness) if calibration else ("", "")
    if expected[0] and serial != expected[0]:
        this = f"this is hand {serial}" if serial else "the hand does not tell its serial number"
        todo = "calibrate this hand, or remove the file's serial number if it is this hand's"
        raise HandError(f"{this}, the calibration is of hand {expected[0]}: {todo}")
    if expected[1] and side and side != expected[1]:
        raise HandError(f"this hand is {side}, the calibration is of a {expected[1]} one: calibrate this hand")
    notes = []
    if not serial:
        notes.append("the hand does not tell its serial number: another hand on this port would not be noticed")
    elif calibration and not expected[0]:
        notes.append("the calibration names no serial number: it may be of another hand")
    if side.startswith("code"):
        notes.append(f"the hand gives its side as {side}, whose meaning is not known")
    return [f"warning: {note}" for note in notes]


def printable(content: bytes) -> str:
    """The text at the beginning of a register or an answer; empty for what is none."""
    text = content.split(b"\0")[0].decode("ascii", "replace").strip()
    return text if text.isprintable() and text.isascii() else ""


class HandPort:
    """A hand on a line that is opened again when it fails, after waits that double at each attempt.

    `exchange` is called from one thread only. `tap` is called there with ("tx" or "rx", bytes) for every frame.
    """

    identity = Identity()  # what the hand tells about itself
    refusal: Refusal | None = None  # why the newest exchange was refused

    def __init__(self, config: LinkConfig, passive: np.ndarray):
        self.config, self.counts = config, LinkCounts()
        self.passive = passive  # turns the motors off; until its answer no other command is sent on a line that is new
        self.tap: Callable[[str, bytes], None] = lambda direction, data: None
        self._clock, self._sleep = time.monotonic, time.sleep
        self._connected, self._returning, self._generation = False, False, 0
        self._retry_at, self._pause = 0.0, self.config.backoff[0]

    @property
    def missing(self) -> list[str]:
        """What the hand does not measure, names in `dexsim_real.wire.driver.WITHOUT`."""
        return []

    def greet(self, hand: Hand, calibration: Calibration | None) -> list[str]:
        """Connect the hand of a model; returns lines for the user. HandError: as for `connect`, or another hand."""
        lines = [self.connect(), *(f"warning: {warning}" for warning in self.warnings())]
        return lines + check_identity(self.identity, hand, calibration)

    def warnings(self) -> list[str]:
        """Lines for the user about what is connected."""
        return []

    def connect(self) -> str:
        """Open the port and identify the hand; returns a line that describes it. Motors stay off.

        Raises HandError: the port cannot be opened, or the hand does not answer.
        """
        try:
            return self._connect()
        except (OSError, HandError) as error:
            self.close()
            if isinstance(error, HandError):
                raise
            raise HandError(f"the hand cannot be reached ({error}); check cable and power") from None

    def exchange(self, command: np.ndarray) -> Reply | None:
        """Send joint commands (`frames.command_block`); None when no valid answer arrived in time.

        Line errors never raise. It returns within a second, also while the hand is gone: the guard process takes a
        runner that does not move for dead. After a reconnection the given command is not sent: the first reply of a new
        generation comes from a passive hand. A passive command is answered only once the motors are off.
        """
        self.refusal = None
        try:
            if not self._connected:
                if self._clock() < self._retry_at:
                    self._sleep(_PAUSE)
                    return None
                try:
                    self._connect(again=True)
                except HandError as error:
                    raise OSError from error
                self.counts.reconnects += 1
                self._returning, self._pause = True, self.config.backoff[0]
            reply = self._exchange(self.passive if self._returning else command)
        except OSError:  # Base class of pyserial's errors.
            self.close()
            self._retry_at = self._clock() + self._pause
            self._pause = min(2 * self._pause, self.config.backoff[1])
            return None
        self._returning &= reply is None
        return reply

    def close(self) -> None:
        """Close the port, motors as they are; no error where it is closed already."""
        raise NotImplementedError

    def turn_off(self, command: np.ndarray, seconds: float) -> bool:
        """Send a command with all motors off until the hand answers it, over a lost cable too; a port that fails is
        asked again. Gives up after so many `seconds`; returns whether the hand has confirmed it."""
        until = time.monotonic() + seconds
        while True:
            try:
                reply = self.exchange(command)
                if isinstance(reply, Reply) and not reply.on:
                    return True
            except (Exception, SystemExit):  # Of a driver from elsewhere, which may work again.
                time.sleep(_AGAIN)
            if time.monotonic() > until:
                return False

    def _exchange(self, command: np.ndarray) -> Reply | None:
        """One exchange on an open line. OSError: the line failed."""
        raise NotImplementedError

    def _connect(self, again: bool = False) -> str:
        """Open the line, `again` to the hand that was there before. OSError or HandError: it cannot be reached."""
        raise NotImplementedError


class SerialHand(HandPort):
    """`HandPort` over a serial port: a device, by-id link, pseudo-terminal or pyserial URL.

    `identity` is what the hand told about itself when it was connected. Another hand on the port is refused: it is told
    to turn its motors off, and nothing else.
    """

    def __init__(self, port: str, config: LinkConfig | None = None):
        super().__init__(config or LinkConfig(), passive_command())
        self.port = port
        self._serial: Any = None
        self._parser = frames.Parser(frames.HAND_REPLIES)
        self._received = 0  # bytes since the port was opened, without late answers

    def close(self) -> None:
        self._connected = False
        if self._serial is not None:
            with contextlib.suppress(OSError):
                self._serial.close()
            self._serial = None

    def warnings(self, sysfs: Path = Path("/sys/bus/usb-serial/devices")) -> list[str]:
        """An FTDI adapter's latency timer of more than 1 ms: at the usual 16 ms the loop runs at half its rate."""
        timer = sysfs / os.path.basename(os.path.realpath(self.port)) / "latency_timer"
        value = int(timer.read_text()) if timer.is_file() else 0
        if value <= 1:
            return []
        return [
            f"{self.port}: the adapter waits {value} ms before it forwards short packets. Set 1 ms now: "
            f"`echo 1 | sudo tee {timer}`. docs/hardware.md says how to keep it"
        ]

    # --- one exchange ---------------------------------------------------------------------

    def _exchange(self, command: np.ndarray) -> Reply | None:
        frame, sent = self._request(Command.EXCHANGE, command.tobytes(), frames.STATE_BLOCK.itemsize)
        if frame is None:
            return None
        try:
            state = frames.decode(frame.data)
        except HandError:
            self.counts.answered -= 1
            self.counts.corrupt += 1
            return None
        return Reply(state, sent, self._clock(), self.counts.sent, self._generation)

    def _request(self, command: Command, data: bytes, reply: int) -> tuple[Frame | None, float]:
        """Send a command; its answer and the time s of sending."""
        request = Frame(frames.HOST, frames.palm_address(self.config.hand_id), command, data).encode()
        self.counts.sent += 1
        self.refusal = None
        try:
            self._discard()
            self.tap("tx", request)
            sent, before = self._clock(), self._received
            self._serial.write(request)
            answer = self._wait(command, sent, len(request), frames.OVERHEAD + reply)
        except OSError:
            self.counts.lost += 1
            raise
        finally:
            self.counts.crc_errors = self._parser.damaged
        if answer is None:
            self.counts.corrupt += self._received > before
            self.counts.silent += self._received == before
        elif answer.command == Command.ERROR:
            self.counts.refused += 1
            self.refusal, answer = read_refusal(answer.data), None
        else:
            self.counts.answered += 1
        return answer, sent

    def _wait(self, command: Command, sent: float, request: int, reply: int) -> Frame | None:
        """Wait for the answer. A frame that is arriving at the deadline is still received: on a two-wire line no other
        frame could be sent meanwhile."""
        deadline = sent + self.config.deadline(request, reply)
        answer, final, heard = None, False, sent
        while answer is None and not final:
            data, now = self._read(), self._clock()
            heard = now if data else heard
            final = now > deadline and (now - heard > _QUIET or now > deadline + self.config.on_wire(_LONGEST))
            for frame in self._answers(self._parser.feed(data, final)):
                self.tap("rx", frame.encode())
                size = frames.OVERHEAD + len(frame.data)
                possible = not self.config.paced or now - sent >= self.config.on_wire(request + size)
                if possible and frame.command in (command, Command.ERROR):
                    self.counts.late += answer is not None  # The newer of two answers counts.
                    answer = frame
                else:  # It answers an earlier request.
                    self.counts.late += 1
                    self._received -= size
        return answer

    def _read(self) -> bytes:
        data = self._serial.read(1)
        if data:
            data += self._serial.read(self._serial.in_waiting)
        self._received += len(data)
        return data

    def _discard(self) -> None:
        """Discard late answers to their last byte, so that none is mistaken for the next answer."""
        late, until = [], self._clock() + self.config.on_wire(_LONGEST) + _QUIET
        while (self._serial.in_waiting or self._parser.pending) and self._clock() < until:
            late += self._parser.feed(self._read())
        late += self._parser.feed(b"", final=True)
        self.counts.late += len(self._answers(late))

    def _answers(self, answers: list[Frame]) -> list[Frame]:
        """The frames that are from no other hand, whose state must never be taken for this one's.

        Other addresses pass: no capture of a real hand's replies is published.
        """
        own = frames.palm_address(self.config.hand_id)
        return [frame for frame in answers if frame.source == own or frame.source not in frames.PALMS]

    # --- opening and reopening --------------------------------------------------------------

    def _connect(self, again: bool = False) -> str:
        self._open()
        if not again:
            self._sleep(self.config.settle)
        version = self._handshake(0.0 if again else self.config.handshake)
        if not again:
            self.identity = self._read_identity()
        elif self.identity != Identity() and (identity := self._read_identity()) != self.identity:
            text = f"another hand is on {self.port}: {identity}, not {self.identity}"
            self.refusal = Refusal(text, serious=True)
            raise OSError(text)
        return f"{self.port}: hand {self.config.hand_id}, {self.identity}, firmware {version}"

    def _open(self) -> None:
        self.close()
        self._serial = open_serial(self.port, self.config.baud, timeout=_POLL, write_timeout=_WRITE)
        # Only real adapters support it. The FTDI driver then sets its latency timer to 1 ms.
        with contextlib.suppress(OSError, ValueError, AttributeError, NotImplementedError):
            self._serial.set_low_latency_mode(True)
        self._parser.feed(b"", final=True)
        self._received, self._connected = 0, True

    def _handshake(self, patience: float) -> str:
        """Handshake: ask for the version and one state with the motors off. The version may stay unknown."""
        until, version = self._clock() + patience, "unknown"
        self._generation += 1
        while True:
            frame, _ = self._request(Command.VERSION, b"", 64)
            if frame is not None:
                version = printable(frame.data) or frame.data.hex(" ")
            if self._exchange(passive_command()) is not None:
                return version
            if self._clock() > until:
                raise HandError(self._silence())

    def _read_identity(self) -> Identity:
        return read_identity(self._register(SERIAL_NUMBER), self._register(SIDE))

    def _register(self, number: int) -> bytes:
        """Content of a register; empty when the hand does not tell."""
        name = number.to_bytes(2, "little")
        for _ in range(_ATTEMPTS):
            frame, _ = self._request(Command.READ_REGISTER, name, _REGISTER)
            if frame is not None and frame.data.startswith(name):
                return frame.data[len(name) :]
            if self.refusal is not None:
                break
        return b""

    def _silence(self) -> str:
        """Why there is no valid answer, and what to do."""
        config, counts = self.config, self.counts
        if not self._received and not counts.late:
            why = f"no answer; check the power, the A and B wires of RS485, and --link.hand-id (now {config.hand_id})"
        elif counts.late:
            why = f"answers come too late; raise --link.margin (now {config.margin:g} s), or check the latency timer"
            why += "; an emulated line without the timing of the wire needs --link.no-paced"
        elif self.refusal is not None:
            why = f"{self.refusal.text}; power-cycle the hand, and check that it is cool and moves freely"
        elif not self._parser.frames and not self._parser.damaged:
            why = f"no bytes belong to a frame; set --link.baud to that of the hand (now {config.baud} baud)"
        else:
            what = f"{counts.crc_errors} wrong checksums, {counts.refused} refusals"
            why = f"no valid state ({what}); check cable, termination and --link.hand-id (now {config.hand_id})"
        return f"{self.port}: {why}"
