"""An emulated hand for tests: its line in virtual time, and a twin that runs in a thread."""

import threading

from twin_plant import REST, ScriptedPlant

from dexsim_real.twin.options import TwinArguments
from dexsim_real.twin.server import Twin
from dexsim_real.twin.wire.faults import Injector
from dexsim_real.twin.wire.firmware import Firmware
from dexsim_real.twin.wire.line import HandLine
from dexsim_real.twin.wire.terminal import Terminal
from dexsim_real.wire import frames
from dexsim_real.wire.frames import Command, Frame, Mode


def command(position=REST, mode=Mode.POSITION, **changes):
    block = frames.command_block(position, kp=100, ki=0, kd=0, torque_max=300, mode=mode)
    for name, value in changes.items():
        block[name] = value
    return block


def ask(board, kind, data=b"", now=0.0, target=0x80):
    return board.answer(Frame(0xFE, target, kind, data), now)


class Bench:
    """A line, and a host that writes and reads in virtual time."""

    def __init__(self, folder, watchdog=0.0):
        self.plant, self.notes = ScriptedPlant(), []
        self.board = Firmware(self.plant, watchdog, self.notes.append)
        self.line = HandLine(Terminal(folder / "hand"), self.board, Injector(), note=self.notes.append)
        self.now = 100.0
        import serial

        self.port = serial.Serial(str(self.line.terminal.name), 3_000_000, timeout=0)

    def send(self, data):
        self.port.write(data)
        self.line.serve(self.now)

    def run(self, seconds):
        """Bytes that come, with their times."""
        until, got = self.now + seconds, []
        while (due := self.line.due()) <= until:
            self.now = max(self.now, due)
            self.line.serve(self.now)
            if data := self.port.read(10_000):
                got.append((self.now, data))
        self.now = until
        self.line.serve(self.now)
        return got

    def exchange(self, block=None, period=0.012):
        """Answer and when its last byte came; None for silence."""
        start = self.now
        self.send(Frame(0xFE, 0x80, Command.EXCHANGE, (command() if block is None else block).tobytes()).encode())
        got = self.run(period)
        data = b"".join(piece for _, piece in got)
        return (got[-1][0] - start, data) if got else None

    def close(self):
        self.port.close()
        self.line.terminal.close()


class Running:
    """A twin that runs in a thread."""

    def __init__(self, folder, plant=None, **options):
        self.plant = plant or ScriptedPlant()
        self.twin = Twin(TwinArguments(**options), self.plant, folder)
        self._thread = threading.Thread(target=self.twin.run, daemon=True)
        self._thread.start()

    @property
    def port(self):
        return str(self.twin.line.terminal.name)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.twin.stop()
        self._thread.join()
        self.twin.close()
