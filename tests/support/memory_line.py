"""A serial line in memory to a scripted hand: an answer arrives when it is due, however busy the machine is."""

import time

from pty_hand import PtyHand

from dexsim_real.wire.frames import HOST_REQUESTS, Parser


class Clock:
    """In place of the module `time`: only waiting passes its time."""

    def __init__(self):
        self.now = 1000.0

    def monotonic(self):
        return self.now

    def sleep(self, seconds):
        self.now += seconds


class MemoryLine:
    """What pyserial gives the host. The hand answers `peer.delay` s after the request."""

    def __init__(self, peer: PtyHand, timeout: float, clock=time):
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


def connect(monkeypatch, peer, clock=time):
    """Every port that opens from now on is a line to this hand, and the driver's clock is this one."""
    monkeypatch.setattr("serial.serial_for_url", lambda url, timeout, **_: MemoryLine(peer, timeout, clock))
    monkeypatch.setattr("dexsim_real.wire.link.time", clock)
