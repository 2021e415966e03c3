"""The bridge's driver and an emulated hand on one cable in memory, in virtual time."""

from types import SimpleNamespace

from twin_plant import REST, ScriptedPlant

from dexsim_real.twin.wire.faults import BYTES, Injector
from dexsim_real.twin.wire.firmware import Firmware
from dexsim_real.twin.wire.line import HandLine
from dexsim_real.wire import frames
from dexsim_real.wire.frames import Mode
from dexsim_real.wire.link import LinkConfig
from dexsim_real.wire.serial_hand import SerialHand


class Cable:
    """Both ends of a cable in memory: a `Terminal` for the hand, pyserial's port for the host, and their clock."""

    connected, baud = True, 3_000_000

    def __init__(self):
        self.now, self.line = 1000.0, None
        self.to_hand, self.to_host = bytearray(), bytearray()

    # What the hand sees.

    def open(self):
        self.connected = True

    def close(self):
        self.connected = False
        self.to_hand, self.to_host = bytearray(), bytearray()  # Whoever holds the old ones has lost them.

    def read(self):
        data = bytes(self.to_hand)
        self.to_hand.clear()
        return data

    def write(self, data):
        self.to_host += data
        return len(data)

    # Time: it passes only where the host waits.

    def wait(self, seconds, enough=lambda: False):
        until = self.now + seconds
        while self.now < until and not enough():
            self.now = min(max(self.line.due(), self.now + 1e-6), until)
            self.line.serve(self.now)


class Port:
    """What pyserial gives the host."""

    def __init__(self, cable, timeout):
        if not cable.connected:
            raise OSError(2, "gone")
        self._cable, self._timeout, self._buffer = cable, timeout, cable.to_host

    def _check(self):
        if self._buffer is not self._cable.to_host or not self._cable.connected:
            raise OSError(5, "unplugged")

    @property
    def in_waiting(self):
        self._check()
        return len(self._buffer)

    def write(self, data):
        self._check()
        self._cable.to_hand += data
        self._cable.wait(1e-5)

    def read(self, size):
        self._check()
        self._cable.wait(self._timeout, lambda: len(self._buffer) >= size or not self._cable.connected)
        self._cable.wait(2e-5)
        self._check()
        data = bytes(self._buffer[:size])
        del self._buffer[:size]
        return data

    def close(self):
        pass


class Pair:
    """The bridge's driver and an emulated hand on one cable."""

    def __init__(self, monkeypatch, faults=(), seed=0, watchdog=0.08, **link):
        import serial

        self.cable, self.plant, self.notes = Cable(), ScriptedPlant(), []
        cable = self.cable
        monkeypatch.setattr(
            "dexsim_real.wire.serial_hand.time", SimpleNamespace(monotonic=lambda: cable.now, sleep=cable.wait)
        )
        monkeypatch.setattr(serial, "serial_for_url", lambda url, timeout, **_: Port(cable, timeout))
        self.board = Firmware(self.plant, watchdog, self.notes.append)
        self.injector = Injector(faults, seed)
        self.line = cable.line = HandLine(
            cable, self.board, self.injector, seed=seed, catch_up=self._catch_up, note=self.notes.append
        )
        self.port = SerialHand("loop://", LinkConfig(settle=0.0, backoff=(0.02, 0.1), **link))
        self.port.connect()

    def _catch_up(self, now):
        self.plant.advance(max(now - 1000.0 - self.plant.time, 1e-6))

    def exchange(self, mode=Mode.POSITION, period=0.012):
        """One exchange a cycle, as the bridge does."""
        start = self.cable.now
        reply = self.port.exchange(frames.command_block(REST, kp=100, ki=0, kd=0, torque_max=300, mode=mode))
        took = self.cable.now - start
        self.cable.wait(-took % period)
        return reply

    def run(self, seconds):
        """Times at which answers came."""
        until, replies = self.cable.now + seconds, []
        while self.cable.now < until:
            replies.append(self.exchange())
        return [reply.received for reply in replies if reply is not None]

    def settle(self):
        """Until nothing is under way any more."""
        self.cable.wait(1.0)
        for _ in range(3):
            self.exchange(Mode.PASSIVE)
        while self.exchange(Mode.PASSIVE) is None:
            pass

    def agreement(self):
        """What the host counted, beside what was injected."""
        counts, line, made = self.port.counts, self.line.counts, self.injector.injected
        damaged_answers, damaged_requests = (
            sum(made[f"{kind} {side}"] for kind in BYTES) for side in ("answer", "request")
        )
        return {
            "corrupt": (counts.corrupt, damaged_answers),
            "lost": (counts.lost, made["disconnect"]),
            # What the hand never answered, and what came too late.
            "silent": (counts.silent, damaged_requests + line["ignored"] + counts.late),
            "answered": (counts.answered + counts.refused + counts.late, line["answers"]),
            "sent": (counts.sent, line["requests"]),
            "ends": (counts.sent, counts.answered + counts.corrupt + counts.silent + counts.refused + counts.lost),
            "damaged": (line["damaged answers"] + line["damaged requests"], damaged_answers + damaged_requests),
        }
