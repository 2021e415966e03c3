"""An emulated hand for tests, on a cable in memory in virtual time."""

from twin_plant import REST, ScriptedPlant

from dexsim_real.twin.wire import Firmware, HandLine
from dexsim_real.wire import frames
from dexsim_real.wire.frames import Command, Frame, Mode


def command(position=REST, mode=Mode.POSITION):
    return frames.command_block(position, kp=100, ki=0, kd=0, torque_max=300, mode=mode)


def request(block=None):
    """The bytes of an exchange."""
    return Frame(0xFE, 0x80, Command.EXCHANGE, (command() if block is None else block).tobytes()).encode()


class Cable:
    """Both ends of a cable in memory: a `Terminal` for the hand, bytes for the host, and their clock."""

    def __init__(self):
        self.now, self.plant = 1000.0, ScriptedPlant()
        self.to_hand, self.to_host = bytearray(), bytearray()
        self.line = HandLine(self, Firmware(self.plant), self._catch_up)

    def _catch_up(self, now):
        self.plant.advance(max(now - 1000.0 - self.plant.time, 1e-6))

    # What the hand sees.

    def read(self):
        data = bytes(self.to_hand)
        self.to_hand.clear()
        return data

    def write(self, data):
        self.to_host += data
        return len(data)

    def ask(self, data, seconds=0.03):
        """The pieces that come after sending these bytes, with their times; time passes only here."""
        self.to_hand += data
        self.line.serve(self.now)
        until, pieces = self.now + seconds, []
        while self.now < until:
            self.now = min(max(self.line.due(), self.now + 1e-6), until)
            self.line.serve(self.now)
            if self.to_host:
                pieces.append((self.now, bytes(self.to_host)))
                self.to_host.clear()
        return pieces
