"""An emulated hand for tests: on a cable in memory in virtual time, with or without a driver; in a thread."""

import threading
from types import SimpleNamespace

from twin_plant import REST, ScriptedPlant

from dexsim_real.twin.__main__ import Twin, TwinArguments
from dexsim_real.twin.wire.faults import Injector
from dexsim_real.twin.wire.firmware import Firmware
from dexsim_real.twin.wire.line import HandLine
from dexsim_real.wire import frames
from dexsim_real.wire.frames import Command, Frame, Mode
from dexsim_real.wire.link import LinkConfig
from dexsim_real.wire.serial_hand import SerialHand


def command(position=REST, mode=Mode.POSITION):
    return frames.command_block(position, kp=100, ki=0, kd=0, torque_max=300, mode=mode)


def request(block=None):
    """The bytes of an exchange."""
    return Frame(0xFE, 0x80, Command.EXCHANGE, (command() if block is None else block).tobytes()).encode()


class Cable:
    """Both ends of a cable in memory: a `Terminal` for the hand, pyserial's port for the host, and their clock."""

    connected = True

    def __init__(self, faults=(), seed=0):
        self.now, self.plant, self.notes = 1000.0, ScriptedPlant(), []
        self.to_hand, self.to_host = bytearray(), bytearray()
        self.board = Firmware(self.plant, self.notes.append)
        self.injector = Injector(faults, seed)
        self.line = HandLine(
            self, self.board, self.injector, seed=seed, catch_up=self._catch_up, note=self.notes.append
        )

    def _catch_up(self, now):
        self.plant.advance(max(now - 1000.0 - self.plant.time, 1e-6))

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

    def ask(self, data, seconds=0.03):
        """The pieces that come after sending these bytes, with their times."""
        self.to_hand += data
        self.line.serve(self.now)
        until, pieces = self.now + seconds, []
        while self.now < until:
            self.wait(until - self.now, lambda: self.to_host)
            if self.to_host:
                pieces.append((self.now, bytes(self.to_host)))
                self.to_host.clear()
        return pieces


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


class Pair(Cable):
    """The bridge's driver and an emulated hand on one cable."""

    def __init__(self, monkeypatch, faults=(), seed=0):
        import serial

        super().__init__(faults, seed)
        clock = SimpleNamespace(monotonic=lambda: self.now, sleep=self.wait)
        monkeypatch.setattr("dexsim_real.wire.link.time", clock)
        monkeypatch.setattr(serial, "serial_for_url", lambda url, timeout, **_: Port(self, timeout))
        self.port = SerialHand("loop://", LinkConfig(settle=0.0, backoff=(0.02, 0.1)))
        self.port.connect()

    def exchange(self, mode=Mode.POSITION, period=0.012):
        """One exchange a cycle, as the bridge does."""
        start = self.now
        reply = self.port.exchange(command(mode=mode))
        self.wait((start - self.now) % period)
        return reply

    def run(self, seconds):
        """Times at which answers came."""
        until, replies = self.now + seconds, []
        while self.now < until:
            replies.append(self.exchange())
        return [reply.received for reply in replies if reply is not None]

    def settle(self):
        """Until nothing is under way any more."""
        self.wait(1.0)
        for _ in range(3):
            self.exchange(Mode.PASSIVE)
        while self.exchange(Mode.PASSIVE) is None:
            pass

    def agreement(self):
        """What the host counted, beside what was injected."""
        counts, line, made = self.port.counts, self.line.counts, self.injector.injected
        return {
            "corrupt": (counts.corrupt, made["flip"]),
            "lost": (counts.lost, made["disconnect"]),
            # What the hand never answered, and what came too late.
            "silent": (counts.silent, line["ignored"] + counts.late),
            "answered": (counts.answered + counts.refused + counts.late, line["answers"]),
            "sent": (counts.sent, line["requests"]),
            "ends": (counts.sent, counts.answered + counts.corrupt + counts.silent + counts.refused + counts.lost),
            "damaged": (line["damaged answers"], made["flip"]),
        }


class Running:
    """A twin that runs in a thread."""

    def __init__(self, folder, plant=None, **options):
        self.plant = plant or ScriptedPlant()
        self.twin = Twin(TwinArguments(**options), self.plant, folder)
        self.port = str(self.twin.line.terminal.name)
        self._thread = threading.Thread(target=self.twin.run, daemon=True)
        self._thread.start()

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.twin.stop()
        self._thread.join()
        self.twin.close()
