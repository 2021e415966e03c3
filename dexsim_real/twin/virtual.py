"""A run on the emulated hand in virtual time: the parts of the bridge in one process, without a clock.

What `dexsim_real.run.session` does with threads and a serial port is simulated as events: exchanges at 83 Hz that take
9.6 ms, the policy, the IMU and the camera at their own rates. Every exchange is encoded to frames and executed by the
emulated palm board, so quantisation and delays are those of the wire.
"""

import dataclasses
import functools
import heapq
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from dexsim.calibration.maps import Calibration, Side
from dexsim.hand.kinematics import Hand
from dexsim_real.control.controller import IDENTITY, Controller
from dexsim_real.control.goals import TurnGoals
from dexsim_real.control.limits import SafetyConfig
from dexsim_real.control.safety import HandSample, Safety
from dexsim_real.sensors.camera import HeightSensor
from dexsim_real.sensors.hand import HandMeasurement, HandSensing, HardwareConfig, VelocityFilter
from dexsim_real.sensors.imu import BAUD, UPRIGHT_X, RvcParser, align, conjugate, encode, multiply
from dexsim_real.sensors.readings import ObjectEstimate
from dexsim_real.twin.plant.assistant import POSTURES
from dexsim_real.twin.plant.drives import STALL_CURRENT
from dexsim_real.twin.plant.emulated_hand import EmulatedHand
from dexsim_real.twin.plant.shapes import matrix, turn
from dexsim_real.twin.wire.emulated_sensors import ObjectSensorConfig, outline, silhouette
from dexsim_real.twin.wire.firmware import Firmware, FirmwareConfig
from dexsim_real.wire import frames
from dexsim_real.wire.frames import Command, Frame, Mode, Parser

RATE = 83.0  # exchanges a second
REQUEST, ROUND_TRIP = 0.001, 0.0096  # s until a request reaches the board; until its answer has arrived
IMU_RATE, CAMERA_RATE = 100.0, 30.0  # Hz
_TARE_SAMPLES = 30
_LEVER = 2.0**-4  # m, of a fingertip about any joint; cancels out in the ideal calibration
_SLACK = 5.0  # s after the time limit of a trial at which a run ends anyway


def ideal_calibration(hand: Hand) -> Calibration:
    """The calibration of an emulated hand with nominal motors, the mean result of the press procedure.

    The sampled errors of current and taxels in a trial are errors of this calibration.
    """

    def side(gain: np.ndarray) -> Side:
        both, one = np.broadcast_to(gain, (2, hand.num_joints)).astype(float), np.ones(hand.num_joints)
        zero = np.zeros_like(both)
        return Side(both, both, both, zero, zero, zero, zero, zero + 1, zero + 1, zero, zero, 0 * one, one, one)

    return Calibration(
        real=side(-STALL_CURRENT / hand.torque_limit * _LEVER),
        sim=side(np.full(hand.num_joints, _LEVER)),
        torque_scale=hand.torque_limit,
        force_per_count=np.full(hand.num_fingers, FirmwareConfig().force_per_count),
        hand=hand.name,
        joint_names=hand.joint_names,
        finger_names=hand.finger_names,
    )


class Schedule:
    """A queue of events in virtual time."""

    def __init__(self) -> None:
        self._queue: list[tuple[float, int, Callable[[], None]]] = []
        self._count = 0

    def at(self, time: float, what: Callable[[], None]) -> None:
        """Schedule a call at a time in s."""
        heapq.heappush(self._queue, (time, self._count, what))
        self._count += 1

    def pop(self) -> tuple[float, Callable[[], None]]:
        """Remove and return the next event: its time in s and its call."""
        time, _, what = heapq.heappop(self._queue)
        return time, what


class VirtualImu:
    """The IMU in the object and the bridge's processing of it, without a port."""

    def __init__(self, plant: EmulatedHand):
        self._plant = plant
        self._mount = np.asarray(UPRIGHT_X)
        self._parser, self._index = RvcParser(), 0
        # The IMU's world frame has the true vertical as z and an arbitrary heading.
        up = plant.up
        level = np.array([1.0 + up[2], up[1], -up[0], 0.0]) if up[2] > -1 + 1e-9 else np.array([0.0, 1, 0, 0])
        self._level = multiply(turn((0, 0, 1), 1.0 + plant.seed), level / np.linalg.norm(level))
        self._world: np.ndarray | None = None
        self._sensed, self.time = IDENTITY, 0.0

    def sample(self) -> bytes:
        """The bytes of the current orientation."""
        _, quat, _ = self._plant.measure_object()
        self._index += 1
        return encode(self._index, multiply(self._level, multiply(quat, self._mount)))

    def receive(self, time: float, data: bytes) -> None:
        """Process received bytes at a time in s."""
        for quat in self._parser.feed(data):
            self._sensed = quat if quat @ self._sensed >= 0 else -quat
            self.time = time

    def calibrate(self) -> None:
        """Align: the object now has the identity orientation."""
        self._world = align(self._sensed, multiply(IDENTITY, self._mount))

    def read(self) -> np.ndarray:
        """Orientation [4] of the object in the palm frame, as measured by the bridge."""
        if self._world is None:
            return IDENTITY
        return multiply(multiply(self._world, self._sensed), conjugate(self._mount))


class VirtualCamera:
    """The camera and the bridge's height sensor, without a socket."""

    def __init__(self, plant: EmulatedHand, controller: Controller):
        spec = controller.spec
        self._plant, self._config = plant, ObjectSensorConfig()
        self._parts = [outline(part) for part in plant.shape.parts]
        self.sensor = HeightSensor(
            lambda: None,
            self._config.optics,
            np.asarray(spec.reference, float),
            spec.object_axes,
            spec.velocity_filter,
        )

    def sample(self, time: float) -> None:
        """Take a picture at a time in s; it shows the object with the delay of the camera."""
        place, quat, _ = self._plant.measure_object()
        parts = [points @ matrix(quat).T + place for points in self._parts]
        self.sensor.see(time, silhouette(parts, self._config.optics, self._config.picture))


@dataclasses.dataclass(frozen=True)
class RunOptions:
    """Options of a virtual run."""

    command: float = 0.5  # in [0, 1]
    safety: bool = True  # whether the safety limits apply
    approach: float = 2.0  # s to the start posture
    place: float = 0.5  # s in the start posture
    hardware: HardwareConfig = HardwareConfig()
    limits: SafetyConfig = SafetyConfig()


class VirtualRun:
    """One trial of a policy on an emulated hand.

    Args:
      plant: a new one, before its first trial.
      controller: warmed; it is restarted.
      calibration: of this hand.
      options: of the run.
    """

    def __init__(self, plant: EmulatedHand, controller: Controller, calibration: Calibration, options: RunOptions):
        self.plant, self.controller, self.options = plant, controller, options
        hand = controller.hand
        self.firmware = Firmware(plant, FirmwareConfig())
        self.sensing = HandSensing(hand, options.hardware, calibration)
        limits = dataclasses.replace(options.limits, watchdog=max(options.limits.watchdog, 2.5 * controller.period))
        self.safety = Safety(hand, limits)
        self._filter = VelocityFilter(options.hardware.velocity_time)
        self._requests, self._replies = Parser(frames.HOST_REQUESTS), Parser(frames.HAND_REPLIES)
        self._schedule, self._now = Schedule(), 0.0
        self._state: np.ndarray | None = None
        self._mode, self._target = Mode.PASSIVE, hand.joint_lower
        self.imu = VirtualImu(plant)
        self.camera = VirtualCamera(plant, controller) if "camera" in controller.sources else None
        self.goals: TurnGoals | None = None
        self.ticks, self.sums = 0, np.zeros(5)
        self.trace: list[dict[str, Any]] | None = None

    def run(self) -> dict[str, Any]:
        """Run the trial; returns the referee's report, with the measurements of the bridge as `bridge`."""
        trial = self.plant.trial
        for _ in self.ticking():
            pass
        return self._summary(trial)

    def ticking(self) -> Iterator[None]:
        """Run the trial in pieces: yields after each tick of the policy, and ends with the trial."""
        trial, limit = self.plant.trial, self.plant.limit + _SLACK
        self._schedule.at(0.0, self._exchange)
        if "imu" in self.controller.sources:
            self._schedule.at(0.001, self._sense_orientation)
        if self.camera:
            self._schedule.at(0.002, functools.partial(self._take_picture, self.camera))
        self._tare()
        self._mode = Mode.POSITION
        self.safety.engage()
        start, began = self._resting(), self._now
        goal = np.asarray(POSTURES[self.plant.task], np.float32)
        while self._now < began + self.options.approach + self.options.place:
            share = np.float32(min((self._now - began) / self.options.approach, 1.0))
            self._set_target(start + share * share * (3 - 2 * share) * (goal - start))
            self._until(self._now + 1 / RATE)
        if "imu" in self.controller.sources:
            self.imu.calibrate()
        spec = self.controller.spec
        if spec.turn:
            self.goals = TurnGoals(spec.turn, np.asarray(spec.reference))
        self.controller.start(self._resting())
        anchor, began, tick = self.safety.anchor, self._now, 0
        while self.plant.trial == trial and self._now < began + limit:
            if anchor != self.safety.anchor:
                anchor = self.safety.anchor
                self.controller.resume(self.safety.commanded)
            self._tick()
            tick += 1
            self._until(began + tick * self.controller.period)
            yield

    @property
    def now(self) -> float:
        """Virtual time since the start, s."""
        return self._now

    # --- the bridge's threads ---------------------------------------------------------------------

    def _tick(self) -> None:
        measured = self.measured()
        position, velocity = np.asarray(self.controller.spec.reference, float), np.zeros(3)
        if self.camera:
            _, position, velocity = self.camera.sensor.read()
        seen = ObjectEstimate(position, velocity, self.imu.read())
        goal = self.goals.update(self.imu.time, seen) if self.goals else IDENTITY
        tick = self.controller.tick(measured, seen, goal, self.options.command)
        self._set_target(tick.target)
        self.sums += measured.finger_force
        self.ticks += 1
        if self.trace is not None:
            self.trace.append({"time": self._now, "tick": tick, "measured": measured})

    def _set_target(self, target: np.ndarray) -> None:
        self.safety.set_target(target, self._now)
        if np.isfinite(target).all():
            self._target = target

    def _exchange(self) -> None:
        """The exchange thread's cycle: send a request; its answer arrives 9.6 ms later."""
        position, mode, stiffness = self._target, self._mode, 1.0
        if self.safety.engaged and self.options.safety:
            decision = self.safety.decide(self._now)
            position, mode, stiffness = decision.position, decision.mode, decision.stiffness
        block = self.sensing.command(position, mode, stiffness)
        data = Frame(frames.HOST, frames.palm_address(0), Command.EXCHANGE, block.tobytes()).encode()
        self._schedule.at(self._now + REQUEST, lambda: self._answer(data, self._now))
        self._schedule.at(self._now + 1 / RATE, self._exchange)

    def _answer(self, data: bytes, now: float) -> None:
        for frame in self._requests.feed(data):
            reply = self.firmware.answer(frame, now)
            assert reply is not None, "a request of our own is answered"
            self._schedule.at(self._now + ROUND_TRIP - REQUEST, functools.partial(self._receive, reply.encode()))

    def _receive(self, data: bytes) -> None:
        for frame in self._replies.feed(data):
            self._state = frames.decode_state(frame.data)
            self.sensing.track_zero(self._now, self._state)
            measured = self.sensing.measure(self._state)
            velocity = self._filter.estimate(self._now, measured.joint_position)
            if self.safety.see(HandSample(self._now, 0, 0, measured, velocity)):
                self._filter.update(self._now, measured.joint_position)

    def _sense_orientation(self) -> None:
        data = self.imu.sample()
        there = self._now + 10 * len(data) / BAUD  # ten bits a byte
        self._schedule.at(there, lambda: self.imu.receive(there, data))
        self._schedule.at(self._now + 1 / IMU_RATE, self._sense_orientation)

    def _take_picture(self, camera: VirtualCamera) -> None:
        camera.sample(self._now)
        self._schedule.at(self._now + 1 / CAMERA_RATE, functools.partial(self._take_picture, camera))

    # --- pieces ---------------------------------------------------------------------------------

    def _tare(self) -> None:
        states: list[np.ndarray] = []
        while len(states) < _TARE_SAMPLES:
            self._state = None
            self._until(self._now + 1 / RATE)
            states += [self._state] if self._state is not None else []
        self.sensing.set_tare(states)

    def measured(self) -> HandMeasurement:
        """What the bridge measured last."""
        assert self.safety.sample is not None, "no state yet"
        return self.safety.sample.measured

    def _resting(self) -> np.ndarray:
        """Where commands continue."""
        return self.safety.commanded if self.options.safety else self.measured().joint_position

    def _until(self, time: float) -> None:
        """Run the plant and the events up to a time in s."""
        while True:
            when, what = self._schedule.pop()
            if when > time:
                self._schedule.at(when, what)
                break
            self._go(when)
            what()
        self._go(time)

    def _go(self, time: float) -> None:
        self.plant.advance(time - self._now)
        self._now = time

    def _summary(self, trial: int) -> dict[str, Any]:
        report = next(r for r in self.plant.results() if r["trial"] == trial)
        mean = self.sums / max(self.ticks, 1)
        measured = {
            "ticks": self.ticks,
            "sensed_force": np.round(mean, 4).tolist(),
            "safety": dict(self.safety.counts),
            "latched": self.safety.latched,
            "successes": self.goals.successes if self.goals else None,
        }
        return report | {"command": self.options.command, "bridge": measured}
