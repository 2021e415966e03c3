"""The hand on a serial port: requests and answers with deadlines, statistics, reconnection.

`SerialHand` sends the frames of `dexsim_real.wire.frames` over pyserial, to a USB adapter or a pseudo-terminal.
`open_port` opens it, or a `HandDriver` for another hand.
"""

import contextlib
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from dexsim.hand.description import Hand
from dexsim_real.core.errors import HandError, find_function, open_serial
from dexsim_real.wire import frames, link
from dexsim_real.wire.driver import DriverPort
from dexsim_real.wire.frames import Command, Frame, passive_command
from dexsim_real.wire.link import HandPort, Identity, LinkConfig, Refusal, Reply

_POLL = 0.002  # s, longest wait of one read
_WRITE = 0.5  # s, longest write; a longer one counts as a failure of the port
_QUIET = 0.006  # s without a byte after which a frame has ended

_ATTEMPTS = 2  # to read a register
_REGISTER = 34  # bytes of the answer: number and content
_LONGEST = frames.OVERHEAD + frames.STATE_BLOCK.itemsize  # bytes of the longest answer


class SerialHand(HandPort):
    """`HandPort` over a serial port: a device, by-id link, pseudo-terminal or pyserial URL.

    `identity` is what the hand told about itself when it was connected. Another hand on the port is refused: it is told
    to turn its motors off, and nothing else. `options` are those of `HandPort`.
    """

    def __init__(self, port: str, config: LinkConfig | None = None, **options: Any):
        super().__init__(config or LinkConfig(), passive_command(), **options)
        self.port = port
        self._serial: Any = None
        self._parser = frames.Parser(frames.HAND_REPLIES)
        self._received = 0  # bytes since the port was opened, without late answers

    def connect(self) -> str:
        """Open the port and identify the hand; see `HandPort.connect`."""
        self._open()
        try:
            self._sleep(self.config.settle)
            version = self._handshake(self.config.handshake)
            self.identity = self._read_identity()
        except HandError:
            self.close()
            raise
        except OSError as error:
            self.close()
            raise HandError(f"{self.port}: the connection failed in the handshake ({error}); check the cable") from None
        return f"{self.port}: hand {self.config.hand_id}, {self.identity}, firmware {version}"

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
            state = frames.decode_state(frame.data)
        except frames.FrameError:
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
            self._tap("tx", request)
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
            self.refusal, answer = link.read_refusal(answer.data), None
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
            for frame in self._answers(self._parser.feed(data) + (self._parser.expire() if final else [])):
                self._tap("rx", frame.encode())
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
        late += self._parser.expire()
        self.counts.late += len(self._answers(late))

    def _answers(self, answers: list[Frame]) -> list[Frame]:
        """The frames that are from no other hand, whose state must never be taken for this one's.

        Other addresses pass: no capture of a real hand's replies is published.
        """
        own = frames.palm_address(self.config.hand_id)
        return [frame for frame in answers if frame.source == own or frame.source not in frames.PALMS]

    # --- opening and reopening --------------------------------------------------------------

    def _open(self) -> None:
        self.close()
        self._serial = open_serial(self.port, self.config.baud, timeout=_POLL, write_timeout=_WRITE)
        # Only real adapters support it. The FTDI driver then sets its latency timer to 1 ms.
        with contextlib.suppress(OSError, ValueError, AttributeError, NotImplementedError):
            self._serial.set_low_latency_mode(True)
        self._parser.expire()
        self._received, self._connected = 0, True

    def _handshake(self, patience: float) -> str:
        """Handshake: ask for the version and one state with the motors off. The version may stay unknown."""
        until, version = self._clock() + patience, "unknown"
        self._generation += 1
        while True:
            frame, _ = self._request(Command.VERSION, b"", 64)
            if frame is not None:
                version = link.printable(frame.data) or frame.data.hex(" ")
            if self._exchange(passive_command()) is not None:
                return version
            if self._clock() > until:
                raise HandError(self._silence())

    def _read_identity(self) -> Identity:
        return link.read_identity(self._register(link.SERIAL_NUMBER), self._register(link.SIDE))

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

    def _reopen(self) -> None:
        self._open()
        self._handshake(0.0)
        if self.identity != Identity() and (identity := self._read_identity()) != self.identity:
            text = f"another hand is on {self.port}: {identity}, not {self.identity}"
            self.refusal = Refusal(text, serious=True)
            raise OSError(text)


def check_wire(hand: Hand) -> None:
    """Raises HandError: the hand has other joints or taxels than the frames carry."""
    if (hand.num_joints, hand.num_fingers, hand.num_taxels) != (frames.JOINTS, frames.TIPS, frames.TAXELS):
        has = f"{hand.num_joints} joints and {hand.num_fingers} x {hand.num_taxels} taxels"
        raise HandError(f"{hand.name}: {has}, unlike the XHand: give a driver, --port sdk:MODULE (docs/bridge.md)")


def open_port(spec: str, hand: Hand, config: LinkConfig, tap: Callable[[str, bytes], None] | None = None) -> HandPort:
    """The hand at a port: an XHand's serial port, or `sdk:MODULE:FUNCTION` for a function that takes the `Hand` and a
    `LinkConfig` and returns a `HandDriver`. `tap` is that of `SerialHand`.

    Raises HandError: the module or function cannot be found, or the serial port is for another hand.
    """
    if not spec.startswith("sdk:"):
        check_wire(hand)
        return SerialHand(spec, config, tap=tap)
    form = "sdk:MODULE:FUNCTION of an importable module"
    driver = find_function(spec.removeprefix("sdk:"), spec, form, default="open_hand")(hand, config)
    return DriverPort(driver, hand, config, tap=tap)
