"""A scripted hand at the other end of a pseudo-terminal, or of a line in memory on which an answer arrives when it is
due, however busy the machine is: what each answer is, the test decides."""

import os
import select
import tempfile
import threading
from collections.abc import Callable
from pathlib import Path

import numpy as np

from dexsim_real.twin.wire import Terminal
from dexsim_real.wire import frames
from dexsim_real.wire.frames import HOST_REQUESTS, Command, Frame, Parser
from dexsim_real.wire.link import LinkConfig

QUICK = LinkConfig(settle=0.0, margin=0.12, handshake=0.1, backoff=(0.02, 0.05), paced=False)
"""For a hand that answers at once."""


class PtyHand:
    """Answers every request from a thread; use as a context manager.

    Args:
      answer: (number of the exchange, command block [12], state block) to the bytes to send; None for the
        whole, sound answer. It may change the state in place.
      version: what a version request is answered with; None for silence.
      registers: contents by number; other registers are answered with silence.
    """

    def __init__(self, answer: Callable | None = None, version: bytes | None = b"1.3.9", registers: dict | None = None):
        self.answer, self.version = answer, version
        self.registers = {20: b"right", 21: b"2R32SCRIPTED"} if registers is None else registers
        self.state = frames.empty_state()
        self.state["joint"]["temperature"] = 30
        self.commands: list[np.ndarray] = []
        self.delay = 0.0  # s, of the next answer on a line in memory
        self.port, self._folder, self._stop = "", tempfile.TemporaryDirectory(), threading.Event()

    def __enter__(self):
        self.open()
        return self

    def __exit__(self, *_):
        self.close()
        self._folder.cleanup()

    def open(self):
        """Make the terminal; its name is gone with it, or a bridge that looks for its lost hand would find the next
        program's that opens one."""
        self.terminal, self._stop = Terminal(Path(self._folder.name, "hand")), threading.Event()
        self.port = str(self.terminal.name)
        self._thread = threading.Thread(target=self._serve, daemon=True)
        self._thread.start()

    def close(self):
        self._stop.set()
        self._thread.join()
        self.terminal.close()

    def _serve(self):
        parser = Parser(HOST_REQUESTS)
        while not self._stop.is_set():
            select.select([self.terminal], [], [], 0.01)
            for frame in parser.feed(self.terminal.read()):
                reply = self.reply(frame)
                while reply and not self._stop.is_set():  # The kernel's buffer holds 4 KiB.
                    if select.select([], [self.terminal], [], 0.01)[1]:
                        reply = reply[os.write(self.terminal.fileno(), reply[:1024]) :]

    def reply(self, frame: Frame) -> bytes:
        """The answer to a request; empty for silence."""
        if frame.command == Command.VERSION:
            return b"" if self.version is None else Frame(0x80, 0xFE, Command.VERSION, self.version).encode()
        if frame.command == Command.READ_REGISTER:
            content = self.registers.get(int.from_bytes(frame.data, "little"))
            whole = b"" if content is None else frame.data + content.ljust(32, b"\0")
            return whole and Frame(0x80, 0xFE, Command.READ_REGISTER, whole).encode()
        if frame.command != Command.EXCHANGE:
            return b""
        command = frames.decode(frame.data, frames.COMMAND_BLOCK)
        self.commands.append(command)
        custom = self.answer(len(self.commands) - 1, command, self.state) if self.answer else None
        return self.whole() if custom is None else custom

    def whole(self) -> bytes:
        """The sound answer with the state as it is."""
        return Frame(0x80, 0xFE, Command.EXCHANGE, self.state.tobytes()).encode()


class MemoryLine:
    """What pyserial gives the host. The hand answers `peer.delay` s after the request."""

    def __init__(self, peer: PtyHand, timeout: float, clock):
        self.peer, self.timeout, self.clock = peer, timeout, clock
        self.parser, self.coming = Parser(HOST_REQUESTS), []  # (time at which it is there, bytes)

    @property
    def in_waiting(self):
        return len(self._arrived()[0])

    def _arrived(self):
        """The bytes that are there, and what is still coming."""
        now = self.clock.monotonic()
        there = b"".join(data for when, data in self.coming if when <= now)
        return there, [(when, data) for when, data in self.coming if when > now]

    def write(self, data):
        if self.peer._stop.is_set():
            raise OSError("the cable is out")
        for frame in self.parser.feed(bytes(data)):
            reply = self.peer.reply(frame)
            self.coming.append((self.clock.monotonic() + self.peer.delay, reply))

    def read(self, size):
        if not self.in_waiting:
            wait = min((when - self.clock.monotonic() for when, data in self.coming if data), default=self.timeout)
            self.clock.sleep(min(max(wait, 1e-6), self.timeout))
        there, later = self._arrived()
        self.coming = [(0.0, there[size:]), *later]
        return there[:size]

    def close(self):
        pass


def connect_in_memory(monkeypatch, peer, clock):
    """Every port that opens from now on is a line to this hand, and the driver's clock is this one."""
    monkeypatch.setattr("serial.serial_for_url", lambda url, timeout, **_: MemoryLine(peer, timeout, clock))
    monkeypatch.setattr("dexsim_real.wire.link.time", clock)
