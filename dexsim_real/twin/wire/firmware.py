"""The emulated palm board: action and answer for each command.

Answers have the layouts of `dexsim_real.wire.frames`. It has the commands that the bridge sends, and refuses others. No
public source describes the meaning of the error bits: they are defined here.
"""

from collections.abc import Callable

import numpy as np

from dexsim_real.twin.plant.emulated_hand import EmulatedHand, PlantMeasurement
from dexsim_real.wire import frames
from dexsim_real.wire.frames import Command, Frame, Mode, passive_command
from dexsim_real.wire.identity import SERIAL_NUMBER, SIDE

OVERHEATED = 1
"""Error bit of a joint, defined by this board: too hot and off."""
VERSION = "1.3.9 emulated"
SERIALS = {"right": "2R32EMULATED", "left": "2L32EMULATED"}
FORCE_PER_COUNT = 0.1  # N of one taxel count
SHUTDOWN = 95.0  # degC at which a motor goes off until it is 10 K cooler
_PALM, _TIP = 38, 31  # degC of palm board and fingertips
_TICK = 2 * np.pi / 4096  # rad, resolution of the encoders
_ID, _PARAMETER, _MODE, _FORCE_MODE = 1, 30, 67, 81  # numbers of refusals
_ERROR_BASE = 1501000
_ADDRESS = frames.palm_address(0)


class Firmware:
    """Executes frames on a plant.

    Args:
      plant: the physics.
      note: called with one line when the motors turn on or off.
    """

    def __init__(self, plant: EmulatedHand, note: Callable[[str], None] = lambda text: None):
        self.plant, self._note = plant, note
        side = plant.hand.side
        self._registers = {SERIAL_NUMBER.to_bytes(2, "little"): SERIALS[side], SIDE.to_bytes(2, "little"): side}
        self.motors = passive_command()  # `frames.COMMAND_BLOCK` that the joints execute
        self._hot = np.zeros(frames.JOINTS, bool)

    @property
    def on(self) -> bool:
        """Whether any motor is on."""
        return bool(np.any(self.motors["mode"] != Mode.PASSIVE))

    def answer(self, frame: Frame) -> Frame | None:
        """Execute a frame and return the answer; None for a frame addressed to another hand."""
        if frame.target not in (_ADDRESS, frames.BROADCAST):
            return None
        command = Command(frame.command)
        result = self._execute(command, frame.data)
        if isinstance(result, int):
            command, result = Command.ERROR, (_ERROR_BASE + result).to_bytes(4, "little")
        return Frame(_ADDRESS, frame.source, command, result)

    def state(self, measured: PlantMeasurement) -> np.ndarray:
        """A `frames.STATE_BLOCK` of a measurement, with the quantisation of the wire."""
        block = frames.empty_state()
        joint, tip = block["joint"], block["tip"]
        joint["position"] = np.round(measured.joint_position / _TICK) * _TICK
        joint["current"] = _whole(measured.current, np.int16)
        joint["velocity"] = _whole(1e3 * measured.joint_velocity, np.int16)
        raw = (np.round(joint["position"] / _TICK).astype(int) + 2048) & 0xFFF
        joint["raw_position"] = raw << 4 | self.motors["mode"]
        joint["temperature"] = _PALM << 8 | _whole(measured.temperature, np.uint8).astype(np.uint16)
        joint["joint_error"] = OVERHEATED * self._hot
        counts = np.round(measured.taxel_force / FORCE_PER_COUNT).astype(np.int32)
        tip["taxel_temperature"] = tip["temperature"] = _TIP
        for axis, name in enumerate("xyz"):
            kind = np.uint8 if name == "z" else np.int8
            tip["taxel"][name] = _whole(counts[..., axis], kind)
            tip["total"][name] = _whole(counts[..., axis].sum(-1), kind)
        return block

    def _execute(self, command: Command, data: bytes) -> bytes | int:
        """The data of the answer, or the number of the refusal."""
        if command == Command.VERSION:
            return VERSION.encode()
        if command == Command.READ_REGISTER and data[:2] in self._registers:
            return data[:2] + self._registers[data[:2]].encode().ljust(32, b"\0")
        if command != Command.EXCHANGE:
            return _PARAMETER
        try:
            block = frames.decode_command(data)
        except frames.FrameError:
            return _ID
        if not np.isin(block["mode"], list(Mode)).all():
            return _MODE
        if np.any(block["mode"] == Mode.FORCE):
            return _FORCE_MODE
        if not np.isfinite(block["position"]).all():
            return _PARAMETER
        measured, was_on = self.plant.measure(), self.on
        hot = measured.temperature
        self._hot = (hot > SHUTDOWN) | (self._hot & (hot > SHUTDOWN - 10.0))
        block["mode"][self._hot] = Mode.PASSIVE
        self.motors = block
        self.plant.drive(block)
        if was_on != self.on:
            self._note("motors on" if self.on else "motors off")
        return self.state(measured).tobytes()


def _whole(values: np.ndarray, kind: type) -> np.ndarray:
    """Rounded and clipped to the range of an integer type."""
    span = np.iinfo(kind)
    return np.clip(np.round(values), span.min, span.max).astype(kind)
