"""The emulated palm board: action and answer for each command, and the watchdog.

Answers have the layouts of `dexsim_real.wire.frames`. It has the commands that the bridge sends, and refuses others. No
public source describes the meaning of the error bits: they are defined here.
"""

import dataclasses
from collections import Counter
from collections.abc import Callable

import numpy as np

from dexsim_real.twin.plant.protocol import MotorCommands, Plant, PlantMeasurement
from dexsim_real.twin.wire.faults import ALL, Fault
from dexsim_real.wire import frames
from dexsim_real.wire.frames import Command, Frame, Mode
from dexsim_real.wire.identity import SERIAL_NUMBER, SIDE

OVERHEATED, ABANDONED = 1, 4
"""Error bits of a joint, defined by this board: too hot and off, no host."""
VERSION, SERIAL, HANDEDNESS = "1.3.9 emulated", "2R32EMULATED", "right"
FORCE_PER_COUNT = 0.1  # N of one taxel count
SHUTDOWN = 95.0  # degC at which a motor goes off until it is 10 K cooler
_PALM, _TIP = 38, 31  # degC of palm board and fingertips
_TICK = 2 * np.pi / 4096  # rad, resolution of the encoders
_ID, _PARAMETER, _MODE, _FORCE_MODE = 1, 30, 67, 81  # numbers of refusals
_ERROR_BASE = 1501000
_ADDRESS = frames.palm_address(0)


def idle_motors() -> MotorCommands:
    """Commands before the first exchange: all motors off."""
    zero = np.zeros(frames.JOINTS)
    return MotorCommands(zero, zero, zero, zero, zero, np.full(frames.JOINTS, int(Mode.PASSIVE)))


class Firmware:
    """Executes frames on a plant.

    Args:
      plant: the physics.
      watchdog: s without a valid exchange after which the motors go off; 0: never.
      note: called with one line when the motors turn on or off.
    """

    def __init__(self, plant: Plant, watchdog: float = 0.0, note: Callable[[str], None] = lambda text: None):
        self.plant, self.watchdog, self._note = plant, watchdog, note
        self.counts: Counter[str] = Counter()  # executed commands by name
        self.motors = idle_motors()
        self.faults: list[tuple[float, Fault]] = []  # that last now, and until when (s)
        self.angles = np.zeros(frames.JOINTS)  # rad, true angles of the last state sent
        self.trips: list[float] = []  # s, times at which the watchdog acted
        self._alive = -np.inf  # s, time of the last valid exchange
        self._hot = np.zeros(frames.JOINTS, bool)
        self._abandoned = False
        self._commands = {
            Command.EXCHANGE: self._exchange,
            Command.VERSION: lambda data, now: (Command.VERSION, VERSION.encode()),
            Command.READ_REGISTER: self._register,
        }

    @property
    def on(self) -> bool:
        """Whether any motor is on."""
        return bool(np.any(self.motors.mode != Mode.PASSIVE))

    @property
    def deadline(self) -> float:
        """Time s at which the watchdog acts without another exchange; infinite if it does not."""
        return self._alive + self.watchdog if self.on and self.watchdog else np.inf

    def watch(self, now: float) -> bool:
        """Turn the motors off if the last exchange is too long ago; returns whether it did."""
        if now < self.deadline:
            return False
        self.trips.append(now)
        self._abandoned = True
        self._drive(dataclasses.replace(self.motors, mode=np.zeros(frames.JOINTS, int)))
        self._note(f"watchdog: no exchange for {1e3 * (now - self._alive):.0f} ms, motors off")
        return True

    def begin(self, fault: Fault, now: float) -> None:
        """Begin a fault of the board at a time in s; it ends by itself."""
        if fault.kind == "jam":  # Where the joint is now.
            fault = dataclasses.replace(fault, radians=float(self.angles[fault.joint]))
        self.faults.append((now + fault.seconds, fault))

    def answer(self, frame: Frame, now: float) -> Frame | None:
        """Execute a frame and return the answer; None for a frame addressed to another hand."""
        if frame.target not in (_ADDRESS, frames.BROADCAST):
            return None
        self.faults = [(until, fault) for until, fault in self.faults if until >= now]
        asked = Command(frame.command)
        try:
            if asked not in self._commands:
                raise _Refusal(_PARAMETER)
            command, data = self._commands[asked](frame.data, now)
            self.counts[asked.name.lower()] += 1
        except _Refusal as refusal:
            command, data = Command.ERROR, (_ERROR_BASE + refusal.number).to_bytes(4, "little")
            self.counts["refused"] += 1
        return Frame(_ADDRESS, frame.source, command, data)

    def state(self, measured: PlantMeasurement) -> np.ndarray:
        """A `frames.STATE_BLOCK` of a measurement, with the quantisation of the wire."""
        block = frames.empty_state()
        joint, tip = block["joint"], block["tip"]
        joint["position"] = self._angles(measured)
        joint["current"] = _whole(measured.current, np.int16)
        joint["velocity"] = _whole(1e3 * measured.joint_velocity, np.int16)
        raw = (np.round(joint["position"] / _TICK).astype(int) + 2048) & 0xFFF
        joint["raw_position"] = raw << 4 | self.motors.mode
        joint["temperature"] = _PALM << 8 | _whole(self._temperature(measured), np.uint8).astype(np.uint16)
        joint["joint_error"] = OVERHEATED * self._hot + ABANDONED * self._abandoned
        counts = np.round(measured.taxel_force / FORCE_PER_COUNT).astype(np.int32)
        tip["taxel_temperature"] = tip["temperature"] = _TIP
        for fault in self._lasting("stuck"):
            counts[fault.tip, fault.taxel] = 0, 0, fault.count
        for axis, name in enumerate("xyz"):
            kind = np.uint8 if name == "z" else np.int8
            tip["taxel"][name] = _whole(counts[..., axis], kind)
            tip["total"][name] = _whole(counts[..., axis].sum(-1), kind)
        for _, fault in self.faults:
            self._report(fault, block)
        return block

    # --- commands: data and time to the answer's command and data -----------------------------------

    def _exchange(self, data: bytes, now: float) -> tuple[Command, bytes]:
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
        for fault in self._lasting("refuse"):
            if not block["mode"].any():  # It can still be turned off.
                self._command(block)
            raise _Refusal(fault.number)
        measured = self.plant.measure()
        hot = self._temperature(measured)
        self._hot = (hot > SHUTDOWN) | (self._hot & (hot > SHUTDOWN - 10.0))
        self._alive, self._abandoned = now, False
        self._command(block)
        self.angles = self._angles(measured)
        return Command.EXCHANGE, self.state(measured).tobytes()

    def _register(self, data: bytes, now: float) -> tuple[Command, bytes]:
        """Two bytes of number and 32 of content."""
        contents = {SERIAL_NUMBER: SERIAL, SIDE: HANDEDNESS}
        number = int.from_bytes(data[:2], "little")
        if number not in contents:
            raise _Refusal(_PARAMETER)
        return Command.READ_REGISTER, data[:2] + contents[number].encode().ljust(32, b"\0")

    # --- pieces ---------------------------------------------------------------------------------

    def _lasting(self, kind: str) -> list[Fault]:
        return [fault for _, fault in self.faults if fault.kind == kind]

    def _angles(self, measured: PlantMeasurement) -> np.ndarray:
        """True joint angles [12] rad, with the resolution of the encoders."""
        return np.round(measured.joint_position / _TICK) * _TICK

    def _temperature(self, measured: PlantMeasurement) -> np.ndarray:
        temperature = measured.temperature.copy()
        for fault in self._lasting("heat"):
            if fault.part.isdigit():
                temperature[int(fault.part)] += fault.kelvin
        return temperature

    def _command(self, block: np.ndarray) -> None:
        """Set the motors; some may be too hot, off or blocked."""
        was_on, mode, position = self.on, block["mode"].astype(int), block["position"].astype(float)
        mode[self._hot] = Mode.PASSIVE
        for fault in self._lasting("off"):
            mode[slice(None) if fault.joint == ALL else fault.joint] = Mode.PASSIVE
        for fault in self._lasting("jam"):
            position[fault.joint] = fault.radians
        others = {name: block[name].astype(float) for name in ("kp", "ki", "kd", "torque_max")}
        self._drive(MotorCommands(position=position, mode=mode, **others))
        if was_on != self.on:
            self._note("motors on" if self.on else "motors off")

    def _drive(self, motors: MotorCommands) -> None:
        self.motors = motors
        self.plant.drive(motors)

    def _report(self, fault: Fault, block: np.ndarray) -> None:
        """Change a state [] as a fault does."""
        joint, tip = block["joint"], block["tip"]
        if fault.kind == "angle":
            own = joint["position"][fault.joint] if fault.form == "offset" else 0.0
            joint["position"][fault.joint] = own + fault.radians
        elif fault.kind == "error":
            joint[f"{fault.board}_error"][fault.joint] |= fault.bits
        elif fault.kind == "jam" and self.motors.mode[fault.joint] != Mode.PASSIVE:
            joint["current"][fault.joint] = -fault.milliamperes
        elif fault.kind == "heat" and fault.part == "palm":
            joint["temperature"] += np.uint16(fault.kelvin) << 8
        elif fault.kind == "heat" and fault.part.startswith("tip"):
            tip["temperature"][int(fault.part[3:])] += np.uint8(fault.kelvin)


class _Refusal(Exception):
    """The board refuses a command, with the hand's number."""

    def __init__(self, number: int):
        super().__init__(number)
        self.number = number


def _whole(values: np.ndarray, kind: type) -> np.ndarray:
    """Rounded and clipped to the range of an integer type."""
    span = np.iinfo(kind)
    return np.clip(np.round(values), span.min, span.max).astype(kind)
