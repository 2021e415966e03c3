"""A hand's port in virtual time, for procedures that step the exchange loop themselves."""

import numpy as np

from dexsim_real.twin.plant.emulated_hand import EmulatedHand
from dexsim_real.twin.virtual import REQUEST, ROUND_TRIP
from dexsim_real.twin.wire.firmware import Firmware, FirmwareConfig
from dexsim_real.wire.frames import HOST, Command, Frame, decode_state, palm_address
from dexsim_real.wire.link import LinkCounts, Reply


class VirtualPort:
    """`HandPort` of an emulated hand in virtual time, through its palm board and the bytes of both frames."""

    def __init__(self, plant: EmulatedHand):
        self.plant, self.firmware = plant, Firmware(plant, FirmwareConfig())
        self.counts, self.sequence, self.time = LinkCounts(), 0, 0.0

    def connect(self) -> str:
        """There is nothing to open."""
        return "emulated: hand 0"

    def exchange(self, command: np.ndarray) -> Reply:
        """Send a command and wait for the answer, which always comes."""
        sent = self.time
        self.sleep(REQUEST)
        request = Frame(HOST, palm_address(0), Command.EXCHANGE, command.tobytes())
        answer = self.firmware.answer(request, self.time)
        assert answer is not None, "the request is addressed to this hand"
        self.sleep(ROUND_TRIP - REQUEST)
        self.sequence += 1
        self.counts.sent += 1
        self.counts.answered += 1
        return Reply(decode_state(answer.data), sent, self.time, self.sequence, 1)

    def close(self) -> None:
        """There is nothing to close."""

    def clock(self) -> float:
        """Virtual time in s."""
        return self.time

    def sleep(self, seconds: float) -> None:
        """Advance the hand by a duration in s."""
        self.plant.advance(max(seconds, 0.0))
        self.time += max(seconds, 0.0)
