"""The emulated hand's end of the line: bytes with the timing of RS485.

An exchange takes as long as on the real hand: the bytes of the request at 3 Mbaud, a delay in the palm board, and the
bytes of the answer, forwarded in chunks like a USB adapter does: 9.6 ms. The constants are measured on a hand (mean
9.60 ms, 95 % below 9.63 ms, maximum 10.7 ms).
"""

import contextlib
import os
import tty
from collections import Counter, deque
from collections.abc import Callable
from pathlib import Path

import numpy as np

from dexsim_real.core.errors import HandError
from dexsim_real.twin.wire.firmware import Firmware
from dexsim_real.wire import frames
from dexsim_real.wire.frames import Frame, Parser
from dexsim_real.wire.link import BITS_PER_BYTE

BAUD = 3_000_000
PROCESSING, JITTER = 0.00120, 0.00002  # s from a request's last byte to its answer's first: mean, standard deviation
EXTRA_DELAY, EXTRA_PROBABILITY = 0.0011, 0.01  # s, largest extra delay of an exchange; how often there is one
CHUNK = 510  # bytes that the adapter forwards at once
_SILENCE = 0.003  # s without a byte after which an incomplete request is dropped


class Terminal:
    """A pseudo-terminal; `name` is a link to it.

    Args:
      link: path of the link.

    Raises:
      HandError: the path exists and is not a link to a terminal like this one, or no terminal can be created.
    """

    def __init__(self, link: Path):
        self.name = Path(link)
        self._master = self._slave = -1
        ours = self.name.is_symlink() and os.path.realpath(self.name).startswith("/dev/pts/")
        if self.name.exists() and not ours:
            raise HandError(f"{link}: already exists and is not a link to a pseudo-terminal; choose another path")
        try:
            self._master, self._slave = os.openpty()
            tty.setraw(self._slave)
            os.set_blocking(self._master, False)
            # Renamed into place, so that the link changes atomically.
            fresh = self.name.with_name(f".{self.name.name}.{os.getpid()}")
            fresh.symlink_to(os.ttyname(self._slave))
            fresh.replace(self.name)
        except OSError as error:
            self.close()
            raise HandError(
                f"{self.name}: no pseudo-terminal can be created here ({error.strerror}); choose another path"
            ) from None

    def close(self) -> None:
        """Disconnect: programs that have the terminal open get an error."""
        if self._master >= 0:
            with contextlib.suppress(OSError):
                if os.readlink(self.name) == os.ttyname(self._slave):
                    self.name.unlink()
            os.close(self._master)
            os.close(self._slave)
        self._master = self._slave = -1

    def fileno(self) -> int:
        return self._master

    def read(self) -> bytes:
        """Received bytes; empty if there are none."""
        try:
            return os.read(self._master, 65536)
        except BlockingIOError:
            return b""

    def write(self, data: bytes) -> None:
        """Send bytes; what nobody reads is lost, as on a wire."""
        with contextlib.suppress(BlockingIOError):
            os.write(self._master, data)


class HandLine:
    """Serves one terminal. It has no clock: call `serve` with the time, often, and whenever `due` has passed.

    Args:
      terminal: the hand's end of the cable.
      firmware: executes the requests.
      seed: of the delays.
      catch_up: called with a time s before the hand acts, to advance the plant to that time.
    """

    def __init__(
        self,
        terminal: Terminal,
        firmware: Firmware,
        *,
        seed: int = 0,
        catch_up: Callable[[float], None] = lambda now: None,
    ):
        self.terminal, self.firmware = terminal, firmware
        self.counts: Counter[str] = Counter()
        self._catch_up = catch_up
        self._rng, self._parser = np.random.default_rng(seed), Parser(frames.HOST_REQUESTS)
        self._tasks: deque[tuple[float, Frame | bytes]] = deque()  # when (s): a request to execute, bytes to send
        self._heard = -np.inf

    def due(self) -> float:
        """Time s at which `serve` must be called at the latest; infinite while it can only wait for a request."""
        return self._tasks[0][0] if self._tasks else np.inf

    def serve(self, now: float) -> None:
        """Do what is due."""
        data, rng = self.terminal.read(), self._rng
        if not data and now - self._heard > _SILENCE:
            self._parser.expire()
        self._heard = now if data else self._heard
        for frame in self._parser.feed(data):
            self.counts["requests"] += 1
            if self._tasks:  # It cannot listen and talk on one pair of wires.
                self.counts["ignored"] += 1
                continue
            extra = rng.uniform(0.0, EXTRA_DELAY) if rng.random() < EXTRA_PROBABILITY else 0.0
            delay = max(PROCESSING + JITTER * rng.standard_normal(), 0.0) + extra
            self._tasks.append((now + _on_wire(len(frame.encode())) + delay, frame))
        while self._tasks and self._tasks[0][0] <= now:
            due, task = self._tasks.popleft()
            if isinstance(task, Frame):
                self._execute(task, due, now)
            else:
                self.terminal.write(task)

    def _execute(self, request: Frame, due: float, now: float) -> None:
        """Execute a request that was due at a time, and plan the bytes of its answer."""
        self._catch_up(now)
        answer = self.firmware.answer(request)
        if answer is None:
            return
        data = answer.encode()
        # From when it was due: a late machine catches up during the transfer.
        start = max(due, now - _on_wire(len(data)) / 2)
        self.counts["answers"] += 1
        for end in [*range(CHUNK, len(data), CHUNK), len(data)]:
            self._tasks.append((start + _on_wire(end), data[(end - 1) // CHUNK * CHUNK : end]))


def _on_wire(size: int) -> float:
    """Seconds that this number of bytes takes on the wire."""
    return size * BITS_PER_BYTE / BAUD
