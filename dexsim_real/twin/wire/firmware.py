"""The emulated palm board: action and answer for each command, and the watchdog.

Answers have the layouts of `dexsim_real.wire.frames`. No public source describes the payload of rare commands or the
meaning of the error bits: these are defined here, and marked as such.
"""

import dataclasses
from collections import Counter
from collections.abc import Callable

import numpy as np

from dexsim.core.config import setting, validate
from dexsim_real.twin.plant.protocol import MotorCommands, Plant, PlantMeasurement
from dexsim_real.twin.wire.faults import ALL, Fault
from dexsim_real.wire import frames
from dexsim_real.wire.frames import Command, Frame, Mode
from dexsim_real.wire.identity import SERIAL_NUMBER, SIDE

OVERHEATED, OVERLOADED, ABANDONED = 1, 2, 4
"""Error bits of a joint, defined by this board: too hot and off, overcurrent, no host."""
_COMMUNICATION, _ID, _PARAMETER, _MODE, _FORCE_MODE = 2, 1, 30, 67, 81
_ERROR_BASE = 1501000
_HAND_ID, _NAME = 53, 54  # registers


@dataclasses.dataclass(frozen=True, kw_only=True)
class FirmwareConfig:
    """The palm board."""

    hand_id: int = setting(0, unit="1", low=0, high=125)
    """Id of the hand."""
    version: str = "1.3.9 emulated"
    """Firmware version that it reports."""
    serial_number: str = "2R32EMULATED"
    """Serial number that it reports; empty for a firmware that reports neither it nor the side."""
    handedness: str = setting("right", choices=("right", "left"))
    """Side that it reports."""
    watchdog: float = setting(0.0, unit="s", low=0.0, high=10.0)
    """Time without a valid exchange after which the motors go off; 0: never. What the real hand does is not known."""
    encoder_bits: int = setting(12, unit="1", low=4, high=16)
    """Resolution of the encoders, bits per revolution."""
    force_per_count: float = setting(0.1, unit="N", low=1e-3, high=10.0)
    """Force of one taxel count."""
    palm_temperature: int = setting(38, unit="degC", low=0, high=120)
    """Temperature of the palm board."""
    tip_temperature: int = setting(31, unit="degC", low=0, high=120)
    """Temperature of the fingertips."""
    shutdown: float = setting(95.0, unit="degC", low=30.0, high=200.0)
    """Temperature at which a motor goes off until it is 10 K cooler."""
    overload: float = setting(1800.0, unit="mA", low=10.0, high=30000.0)
    """Current that sets an error bit after half a second."""

    def __post_init__(self):
        validate(self)


def idle_motors() -> MotorCommands:
    """Commands before the first exchange: all motors off."""
    zero = np.zeros(frames.JOINTS)
    off = np.full(frames.JOINTS, int(Mode.PASSIVE))
    return MotorCommands(zero.copy(), zero.copy(), zero.copy(), zero.copy(), zero.copy(), off)


class Firmware:
    """Executes frames on a plant.

    Args:
      plant: the physics.
      config: of the board.
      note: called with one line when the motors turn on or off.
    """

    def __init__(self, plant: Plant, config: FirmwareConfig, note: Callable[[str], None] = lambda text: None):
        self.plant, self.config, self._note = plant, config, note
        self.counts: Counter[str] = Counter()  # executed commands by name
        self.motors = idle_motors()
        self.stuck: dict[tuple[int, int], int] = {}  # constant counts of stuck taxels (tip, number)
        self.faults: list[Fault] = []  # that last now
        self.angles = np.zeros(frames.JOINTS)  # rad, true angles of the last state sent
        self.trips: list[float] = []  # s, times at which the watchdog acted
        self.longest = 0.0  # s, longest time from the last exchange until it acted
        self._tare = np.zeros((frames.TIPS, frames.TAXELS, 3), np.int32)
        self._alive = -np.inf  # s, time of the last valid exchange
        self._hot = np.zeros(frames.JOINTS, bool)
        self._overload_since: np.ndarray = np.full(frames.JOINTS, np.inf)
        self._abandoned = False

    @property
    def on(self) -> bool:
        """Whether any motor is on."""
        return bool(np.any(self.motors.mode != Mode.PASSIVE))

    @property
    def deadline(self) -> float:
        """Time s at which the watchdog acts without another exchange; infinite if it does not."""
        return self._alive + self.config.watchdog if self.on and self.config.watchdog else np.inf

    def watch(self, now: float) -> bool:
        """Turn the motors off if the last exchange is too long ago; returns whether it did."""
        if now < self.deadline:
            return False
        self.trips.append(now)
        self.longest = max(self.longest, now - self._alive)
        self._abandoned = True
        self._drive(dataclasses.replace(self.motors, mode=np.zeros(frames.JOINTS, int)))
        self._note(f"watchdog: no exchange for {1e3 * (now - self._alive):.0f} ms, motors off")
        return True

    def answer(self, frame: Frame, now: float) -> Frame | None:
        """Execute a frame and return the answer; None for a frame addressed to another hand."""
        if frame.target not in (frames.palm_address(self.config.hand_id), frames.BROADCAST):
            self.counts["for another"] += 1
            return None
        act = {
            Command.EXCHANGE: self._exchange,
            Command.VERSION: self._version,
            Command.SET_MODE: self._set_mode,
            Command.READ_MODE: self._read_mode,
            Command.CLEAR_PRESSURE: self._clear,
            Command.RESET: self._reset,
            Command.READ_REGISTER: self._register,
        }[Command(frame.command)]
        command, data = act(frame.data, now)
        self.counts[Command(frame.command).name.lower() if command != Command.ERROR else "refused"] += 1
        return Frame(frames.palm_address(self.config.hand_id), frame.source, command, data)

    def state(self, measured: PlantMeasurement) -> np.ndarray:
        """A `frames.STATE_BLOCK` of a measurement, with the quantisation of the wire."""
        config, block = self.config, frames.empty_state()
        joint, tip = block["joint"], block["tip"]
        joint["position"] = self._angles(measured)
        ticks = np.round(joint["position"] / self._tick)
        joint["current"] = _whole(measured.current, np.int16)
        joint["velocity"] = _whole(1e3 * measured.joint_velocity, np.int16)
        raw = (np.round(ticks * 2.0 ** (12 - config.encoder_bits)).astype(int) + 2048) & 0xFFF
        joint["raw_position"] = raw << 4 | self.motors.mode
        joint["temperature"] = config.palm_temperature << 8 | _whole(measured.temperature, np.uint8).astype(np.uint16)
        joint["joint_error"] = (
            OVERHEATED * self._hot
            + OVERLOADED * (measured.time > self._overload_since + 0.5)
            + ABANDONED * self._abandoned
        )
        counts = self._counts(measured) - self._tare
        for (finger, taxel), value in self.stuck.items():
            counts[finger, taxel] = 0, 0, value
        for axis, name in enumerate("xyz"):
            kind = np.uint8 if name == "z" else np.int8
            tip["taxel"][name] = _whole(counts[..., axis], kind)
            tip["total"][name] = _whole(counts[..., axis].sum(-1), kind)
        tip["taxel_temperature"] = tip["temperature"] = config.tip_temperature
        for fault in self.faults:
            self._report(fault, block)
        return block

    # --- commands: data and time to the answer's command and data -----------------------------------

    def _exchange(self, data: bytes, now: float) -> tuple[Command, bytes]:
        try:
            block = frames.decode_command(data)
        except frames.FrameError:
            return self._error(_ID)
        refusal = self._refusal(block["mode"])
        if refusal or not np.isfinite(block["position"]).all():
            return self._error(refusal or _PARAMETER)
        for fault in self.faults:
            if fault.kind == "refuse":  # It can still be turned off.
                if not block["mode"].any():
                    self._command(block)
                return self._error(fault.number)
        measured = self.plant.measure()
        self._protect(measured)
        self._alive, self._abandoned = now, False
        self._command(block)
        state = self.state(measured)
        self.angles = self._angles(measured)
        return Command.EXCHANGE, state.tobytes()

    def _version(self, data: bytes, now: float) -> tuple[Command, bytes]:
        return Command.VERSION, self.config.version.encode("ascii", "replace")[:64] or b"?"

    def _set_mode(self, data: bytes, now: float) -> tuple[Command, bytes]:
        """One mode for all joints, or twelve."""
        if len(data) not in (1, frames.JOINTS):
            return self._error(_PARAMETER)
        mode = np.broadcast_to(np.frombuffer(data, np.uint8).astype(int), frames.JOINTS).copy()
        if refusal := self._refusal(mode):
            return self._error(refusal)
        self._alive = now
        self._drive(dataclasses.replace(self.motors, mode=mode))
        return Command.ACKNOWLEDGE, bytes([Command.SET_MODE, 0])

    def _read_mode(self, data: bytes, now: float) -> tuple[Command, bytes]:
        return Command.READ_MODE, self.motors.mode.astype(np.uint8).tobytes()

    def _clear(self, data: bytes, now: float) -> tuple[Command, bytes]:
        """Tare the taxels of one tip, or of all."""
        tips = list(frames.TIP_IDS) if not data else list(data)
        if not set(tips) <= set(frames.TIP_IDS):
            return self._error(_ID)
        counts = self._counts(self.plant.measure())
        for tip in tips:
            self._tare[tip - frames.TIP_IDS[0]] = counts[tip - frames.TIP_IDS[0]]
        return Command.CLEAR_PRESSURE, bytes([tips[0] if data else 0, 0])

    def _reset(self, data: bytes, now: float) -> tuple[Command, bytes]:
        self._tare[:] = 0
        self._drive(idle_motors())
        return Command.ACKNOWLEDGE, bytes([Command.RESET, 0])

    def _register(self, data: bytes, now: float) -> tuple[Command, bytes]:
        """Two bytes of number and 32 of content."""
        number, config = int.from_bytes(data[:2], "little"), self.config
        known = {_HAND_ID: bytes([config.hand_id]), _NAME: b"emulated"}
        if config.serial_number:
            known |= {SERIAL_NUMBER: config.serial_number.encode("ascii", "replace"), SIDE: config.handedness.encode()}
        if number not in known:
            return self._error(_PARAMETER)
        return Command.READ_REGISTER, number.to_bytes(2, "little") + known[number][:32].ljust(32, b"\0")

    # --- pieces ---------------------------------------------------------------------------------

    @property
    def _tick(self) -> float:
        """Resolution of the encoders, rad."""
        return 2 * np.pi / 2**self.config.encoder_bits

    def _angles(self, measured: PlantMeasurement) -> np.ndarray:
        """True joint angles [12] rad, with the resolution of the encoders."""
        return np.round(measured.joint_position / self._tick) * self._tick

    def _command(self, block: np.ndarray) -> None:
        """Set the motors; some may be too hot, off or blocked."""
        was_on, mode, position = self.on, block["mode"].astype(int), block["position"].astype(float)
        mode[self._hot] = Mode.PASSIVE
        for fault in self.faults:
            if fault.kind == "off":
                mode[slice(None) if fault.joint == ALL else fault.joint] = Mode.PASSIVE
            elif fault.kind == "jam":
                position[fault.joint] = fault.radians
        others = {name: block[name].astype(float) for name in ("kp", "ki", "kd", "torque_max")}
        self._drive(MotorCommands(position=position, mode=mode, **others))
        if was_on != self.on:
            self._note("motors on" if self.on else "motors off")

    def _report(self, fault: Fault, block: np.ndarray) -> None:
        """Change a state [] as a fault does."""
        joint, tip = block["joint"], block["tip"]
        if fault.kind == "angle":
            joint["position"][fault.joint] = fault.radians + (
                joint["position"][fault.joint] if fault.form == "offset" else 0.0
            )
        elif fault.kind == "error":
            joint[f"{fault.board}_error"][fault.joint] |= fault.number
        elif fault.kind == "jam" and self.motors.mode[fault.joint] != Mode.PASSIVE:
            joint["current"][fault.joint] = -fault.current
        elif fault.kind == "warm" and fault.part == frames.TIPS:
            joint["temperature"] = min(self.config.palm_temperature + int(fault.degrees), 255) << 8 | (
                joint["temperature"] & 0xFF
            )
        elif fault.kind == "warm":
            tip["temperature"][fault.part] = min(self.config.tip_temperature + int(fault.degrees), 255)

    def _drive(self, motors: MotorCommands) -> None:
        self.motors = motors
        self.plant.drive(motors)

    def _counts(self, measured: PlantMeasurement) -> np.ndarray:
        return np.round(measured.taxel_force / self.config.force_per_count).astype(np.int32)

    def _protect(self, measured: PlantMeasurement) -> None:
        """Update which motors are too hot or overloaded."""
        hot, limit = measured.temperature, self.config.shutdown
        self._hot = (hot > limit) | (self._hot & (hot > limit - 10.0))
        self._overload_since = np.where(
            np.abs(measured.current) > self.config.overload, np.minimum(self._overload_since, measured.time), np.inf
        )

    @staticmethod
    def _refusal(mode: np.ndarray) -> int:
        """Error code of an unknown or unsupported mode; 0 for none."""
        if not np.isin(mode, list(Mode)).all():
            return _MODE
        return _FORCE_MODE if np.any(mode == Mode.FORCE) else 0

    @staticmethod
    def _error(number: int) -> tuple[Command, bytes]:
        return Command.ERROR, (_ERROR_BASE + number).to_bytes(4, "little")


def _whole(values: np.ndarray, kind: type) -> np.ndarray:
    """Rounded and clipped to the range of an integer type."""
    span = np.iinfo(kind)
    return np.clip(np.round(values), span.min, span.max).astype(kind)
