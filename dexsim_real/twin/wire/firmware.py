"""The emulated palm board: action and answer for each command.

Answers have the layouts of `dexsim_real.wire.frames`. It has the commands that the bridge sends, and refuses others. No
public source describes the meaning of the error bits: they are defined here.
"""

from collections import Counter
from collections.abc import Callable
from typing import Any

import numpy as np

from dexsim_real.twin.plant.emulated_hand import EmulatedHand, PlantMeasurement
from dexsim_real.twin.wire.faults import Fault
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


class _Refusal(Exception):
    """The board refuses a command, with the hand's number."""


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
        self.counts: Counter[str] = Counter()  # executed commands by name
        self.motors = passive_command()  # `frames.COMMAND_BLOCK` that the joints execute
        self.faults: list[tuple[float, str, dict[str, Any]]] = []  # that last now: until when (s), kind, values
        self._hot = np.zeros(frames.JOINTS, bool)

    @property
    def on(self) -> bool:
        """Whether any motor is on."""
        return bool(np.any(self.motors["mode"] != Mode.PASSIVE))

    def begin(self, fault: Fault, now: float) -> None:
        """Begin a fault of the board at a time in s; it ends by itself."""
        self.faults.append((now + fault.values["seconds"], fault.kind, fault.values))

    def answer(self, frame: Frame, now: float) -> Frame | None:
        """Execute a frame and return the answer; None for a frame addressed to another hand."""
        if frame.target not in (_ADDRESS, frames.BROADCAST):
            return None
        self.faults = [fault for fault in self.faults if fault[0] >= now]
        asked = command = Command(frame.command)
        try:
            if asked == Command.EXCHANGE:
                data = self._exchange(frame.data)
            elif asked == Command.VERSION:
                data = VERSION.encode()
            elif asked == Command.READ_REGISTER and frame.data[:2] in self._registers:
                data = frame.data[:2] + self._registers[frame.data[:2]].encode().ljust(32, b"\0")
            else:
                raise _Refusal(_PARAMETER)
            self.counts[asked.name.lower()] += 1
        except _Refusal as refusal:
            command, data = Command.ERROR, (_ERROR_BASE + refusal.args[0]).to_bytes(4, "little")
            self.counts["refused"] += 1
        return Frame(_ADDRESS, frame.source, command, data)

    def state(self, measured: PlantMeasurement) -> np.ndarray:
        """A `frames.STATE_BLOCK` of a measurement, with the quantisation of the wire."""
        block = frames.empty_state()
        joint, tip = block["joint"], block["tip"]
        joint["position"] = np.round(measured.joint_position / _TICK) * _TICK
        joint["current"] = _whole(measured.current, np.int16)
        joint["velocity"] = _whole(1e3 * measured.joint_velocity, np.int16)
        raw = (np.round(joint["position"] / _TICK).astype(int) + 2048) & 0xFFF
        joint["raw_position"] = raw << 4 | self.motors["mode"]
        joint["temperature"] = _PALM << 8 | _whole(self._temperature(measured), np.uint8).astype(np.uint16)
        joint["joint_error"] = OVERHEATED * self._hot
        counts = np.round(measured.taxel_force / FORCE_PER_COUNT).astype(np.int32)
        tip["taxel_temperature"] = tip["temperature"] = _TIP
        for value in self._lasting("stuck"):
            counts[value["tip"], value["taxel"]] = 0, 0, value["count"]
        for axis, name in enumerate("xyz"):
            kind = np.uint8 if name == "z" else np.int8
            tip["taxel"][name] = _whole(counts[..., axis], kind)
            tip["total"][name] = _whole(counts[..., axis].sum(-1), kind)
        for value in self._lasting("angle"):
            joint["position"][value["joint"]] += value["radians"]
        for value in self._lasting("error"):
            joint["joint_error"][value["joint"]] |= value["bits"]
        return block

    def _exchange(self, data: bytes) -> bytes:
        try:
            block = frames.decode_command(data)
        except frames.FrameError:
            raise _Refusal(_ID) from None
        if not np.isin(block["mode"], list(Mode)).all():
            raise _Refusal(_MODE)
        if np.any(block["mode"] == Mode.FORCE):
            raise _Refusal(_FORCE_MODE)
        if not np.isfinite(block["position"]).all():
            raise _Refusal(_PARAMETER)
        for value in self._lasting("refuse"):
            if not block["mode"].any():  # It can still be turned off.
                self._command(block)
            raise _Refusal(value["number"])
        measured = self.plant.measure()
        hot = self._temperature(measured)
        self._hot = (hot > SHUTDOWN) | (self._hot & (hot > SHUTDOWN - 10.0))
        self._command(block)
        return self.state(measured).tobytes()

    def _lasting(self, kind: str) -> list[dict[str, Any]]:
        return [values for _, name, values in self.faults if name == kind]

    def _temperature(self, measured: PlantMeasurement) -> np.ndarray:
        temperature = measured.temperature.copy()
        for value in self._lasting("heat"):
            temperature[value["joint"]] += value["kelvin"]
        return temperature

    def _command(self, block: np.ndarray) -> None:
        """Set the motors; some may be too hot or off."""
        was_on = self.on
        block["mode"][self._hot] = Mode.PASSIVE
        for value in self._lasting("off"):
            block["mode"][value["joint"]] = Mode.PASSIVE
        self.motors = block
        self.plant.drive(block)
        if was_on != self.on:
            self._note("motors on" if self.on else "motors off")


def _whole(values: np.ndarray, kind: type) -> np.ndarray:
    """Rounded and clipped to the range of an integer type."""
    span = np.iinfo(kind)
    return np.clip(np.round(values), span.min, span.max).astype(kind)
