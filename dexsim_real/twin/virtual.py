"""A run on the emulated hand in virtual time: the bridge's loops in one process, as fast as they compute.

Exchange loop (`dexsim_real.loop`) and policy loop (`dexsim_real.control.policy_loop`) are those of a run on a hand.
Their times are events: exchanges at 83 Hz that take 9.6 ms, the policy, the IMU and the camera at their own rates.
Every exchange is encoded to frames and executed by the emulated palm board, so quantisation and delays are those of
the wire.
"""

import dataclasses
import functools
import heapq
import itertools
from collections.abc import Callable, Iterator
from typing import Any, cast

import numpy as np

from dexsim.calibration.maps import Calibration, Side
from dexsim.hand.kinematics import Hand
from dexsim_real.control.controller import Controller
from dexsim_real.control.goals import TurnGoals
from dexsim_real.control.limits import SafetyConfig
from dexsim_real.control.policy_loop import PolicyLoop, limits_for
from dexsim_real.control.safety import HandSample, Reaction, Safety, SafetyDecision, TargetRequest
from dexsim_real.loop import TARE_SAMPLES, Exchange, ExchangeLoop
from dexsim_real.sensors.camera import HeightSensor
from dexsim_real.sensors.hand import HandMeasurement, HandSensing, HardwareConfig
from dexsim_real.sensors.imu import BAUD, ImuReader, encode, multiply
from dexsim_real.sensors.object_sensors import ObjectSensors
from dexsim_real.twin.plant.drives import STALL_CURRENT
from dexsim_real.twin.plant.emulated_hand import EmulatedHand
from dexsim_real.twin.plant.shapes import matrix, turn
from dexsim_real.twin.wire.emulated_sensors import ObjectSensorConfig, outline, silhouette
from dexsim_real.twin.wire.firmware import Firmware, FirmwareConfig
from dexsim_real.wire import frames
from dexsim_real.wire.frames import Command, Frame, Parser
from dexsim_real.wire.link import HandPort, Reply

RATE = 83.0  # exchanges a second
REQUEST, ROUND_TRIP = 0.001, 0.0096  # s until a request reaches the board; until its answer has arrived
IMU_RATE, CAMERA_RATE = 100.0, 30.0  # Hz
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


class VirtualImu(ImuReader):
    """The IMU in the object, and the bridge's processing of it, without a port."""

    def __init__(self, plant: EmulatedHand):
        super().__init__()
        self._plant, self._index = plant, 0
        # The IMU's world frame has the true vertical as z and an arbitrary heading.
        up = plant.up
        level = np.array([1.0 + up[2], up[1], -up[0], 0.0]) if up[2] > -1 + 1e-9 else np.array([0.0, 1, 0, 0])
        self._level = multiply(turn((0, 0, 1), 1.0 + plant.seed), level / np.linalg.norm(level))

    def sample(self) -> bytes:
        """The bytes of the current orientation."""
        _, quat, _ = self._plant.measure_object()
        self._index += 1
        return encode(self._index, multiply(self._level, multiply(quat, self._mount)))


class VirtualCamera(HeightSensor):
    """The camera and the bridge's height sensor, without a socket."""

    def __init__(self, plant: EmulatedHand, controller: Controller):
        spec, config = controller.spec, ObjectSensorConfig()
        super().__init__(
            lambda: None, config.optics, np.asarray(spec.reference, float), spec.object_axes, spec.velocity_filter
        )
        self._plant, self._picture = plant, config.picture
        self._parts = [outline(part) for part in plant.shape.parts]

    def sample(self, time: float) -> None:
        """Take a picture at a time in s; it shows the object with the delay of the camera."""
        place, quat, _ = self._plant.measure_object()
        parts = [points @ matrix(quat).T + place for points in self._parts]
        self.see(time, silhouette(parts, self._config, self._picture))


class Unlimited(Safety):
    """Lets every finite target through, to find out what the limits cost."""

    def _lasted(self, now: float, sample: HandSample, request: TargetRequest | None) -> str:
        return ""

    def _reason_to_hold(self, now: float, sample: HandSample, request: TargetRequest | None) -> str:
        return ""

    def _follow(self, now: float, sample: HandSample, target: np.ndarray) -> SafetyDecision:
        return self._finish(now, Reaction.NONE, "", target if np.isfinite(target).all() else self.commanded)


@dataclasses.dataclass(frozen=True)
class RunOptions:
    """Options of a virtual run."""

    command: float = 0.5  # in [0, 1]
    safety: bool = True  # whether the safety limits apply
    approach: float = 2.0  # s to the start posture
    place: float = 0.5  # s in the start posture
    hardware: HardwareConfig = HardwareConfig()
    limits: SafetyConfig = SafetyConfig()


class _Line:
    """Stands for a port: the exchanges of a run in virtual time are events, and none is refused."""

    refusal = None


class VirtualRun:
    """One trial of a policy on an emulated hand: the bridge's loop, with the plant's time as its clock.

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
        limits = limits_for(options.limits, controller)
        self.safety = Safety(hand, limits) if options.safety else Unlimited(hand, limits)
        self._schedule, self._now = Schedule(), 0.0
        sensing = HandSensing(hand, options.hardware, calibration)
        self._loop = ExchangeLoop(cast(HandPort, _Line()), sensing, self.safety, RATE, clock=lambda: self._now)
        self._requests, self._replies = Parser(frames.HOST_REQUESTS), Parser(frames.HAND_REPLIES)
        self._exchanges = 0
        self._newest: Exchange | None = None
        self.imu = VirtualImu(plant) if "imu" in controller.sources else None
        self.camera = VirtualCamera(plant, controller) if "camera" in controller.sources else None
        self.policy = PolicyLoop(
            controller,
            self.safety,
            ObjectSensors(np.asarray(controller.spec.reference, float), self.camera, self.imu),
            command=options.command,
            approach=options.approach,
            place=options.place,
        )
        self.trace: list[dict[str, Any]] | None = None

    def run(self) -> dict[str, Any]:
        """Run the trial; returns the referee's report, with the measurements of the bridge as `bridge`."""
        trial = self.plant.trial
        for _ in self.ticking():
            pass
        return self._summary(trial)

    def ticking(self) -> Iterator[None]:
        """Run the trial in pieces: yields after each tick of the policy, and ends with the trial."""
        trial, limit, policy = self.plant.trial, self.plant.limit + _SLACK, self.policy
        self._schedule.at(0.0, self._exchange)
        if self.imu:
            self._schedule.at(0.001, functools.partial(self._sense_orientation, self.imu))
        if self.camera:
            self._schedule.at(0.002, functools.partial(self._take_picture, self.camera))
        self._tare()
        self._loop.engage()
        while not self.safety.anchor or policy.approach(self._now):
            self._until(self._now + 1 / RATE)
        policy.begin()
        began = self._now
        for tick in itertools.count(1):
            if self.plant.trial != trial or self._now >= began + limit:
                break
            policy.command = self.options.command
            newest = policy.tick(self._now)
            if newest is not None and self.trace is not None:
                self.trace.append({"time": self._now, "tick": newest.tick, "measured": newest.sample.measured})
            self._until(began + tick * self.controller.period)
            yield

    @property
    def now(self) -> float:
        """Virtual time since the start, s."""
        return self._now

    @property
    def goals(self) -> TurnGoals | None:
        """Goals of the rotation task; None without."""
        return self.policy.goals

    def measured(self) -> HandMeasurement:
        """What the bridge measured last."""
        assert self.safety.sample is not None, "no state yet"
        return self.safety.sample.measured

    # --- events -----------------------------------------------------------------------------------

    def _exchange(self) -> None:
        """A cycle of the exchange loop: a request; its answer arrives 9.6 ms later."""
        decision, block = self._loop.request()
        self._exchanges += 1
        data = Frame(frames.HOST, frames.palm_address(0), Command.EXCHANGE, block.tobytes()).encode()
        self._schedule.at(self._now + REQUEST, functools.partial(self._answer, decision, data, self._now))
        self._schedule.at(self._now + 1 / RATE, self._exchange)

    def _answer(self, decision: SafetyDecision, data: bytes, sent: float) -> None:
        for frame in self._requests.feed(data):
            reply = self.firmware.answer(frame, self._now)
            assert reply is not None, "a request of our own is answered"
            receive = functools.partial(self._receive, decision, reply.encode(), sent)
            self._schedule.at(sent + ROUND_TRIP, receive)

    def _receive(self, decision: SafetyDecision, data: bytes, sent: float) -> None:
        for frame in self._replies.feed(data):
            reply = Reply(frames.decode_state(frame.data), sent, self._now, self._exchanges, generation=1)
            self._newest = self._loop.take(decision, reply)

    def _sense_orientation(self, imu: VirtualImu) -> None:
        data = imu.sample()
        there = self._now + 10 * len(data) / BAUD  # ten bits a byte
        self._schedule.at(there, functools.partial(imu.receive, there, data))
        self._schedule.at(self._now + 1 / IMU_RATE, functools.partial(self._sense_orientation, imu))

    def _take_picture(self, camera: VirtualCamera) -> None:
        camera.sample(self._now)
        self._schedule.at(self._now + 1 / CAMERA_RATE, functools.partial(self._take_picture, camera))

    # --- pieces ---------------------------------------------------------------------------------

    def _tare(self) -> None:
        states: list[np.ndarray] = []
        self._loop.track_taxels = False
        while len(states) < TARE_SAMPLES:
            self._newest = None
            self._until(self._now + 1 / RATE)
            states += [self._newest.state] if self._newest is not None else []
        self._loop.track_taxels = True
        self._loop.sensing.set_tare(states)

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
        policy = self.policy
        measured = {
            "ticks": policy.ticks,
            "sensed_force": np.round(policy.finger_force / max(policy.ticks, 1), 4).tolist(),
            "safety": dict(self.safety.counts),
            "latched": self.safety.latched,
            "successes": self.goals.successes if self.goals else None,
        }
        return report | {"command": self.options.command, "bridge": measured}
