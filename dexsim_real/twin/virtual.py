"""A run on the emulated hand in virtual time: the bridge's loops in one process, as fast as they compute.

Exchange loop (`dexsim_real.loop`) and policy loop (`dexsim_real.control.controller`) are those of a run on a hand.
Whoever waits lets the time pass: meanwhile the plant advances, and policy, IMU and camera have their events. Every
exchange is executed by the emulated palm board in the blocks of the wire, so quantisation and delays are those of the
wire.
"""

import dataclasses
import sched
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from dexsim.calibration.maps import Calibration, Side, blank_calibration
from dexsim.hand.description import Hand
from dexsim.task_spec import TaskSpec
from dexsim_real.control.controller import Controller, PolicyLoop, Tick, limits_for
from dexsim_real.control.limits import SafetyConfig
from dexsim_real.control.safety import Safety
from dexsim_real.core.errors import HandError
from dexsim_real.loop import ExchangeLoop
from dexsim_real.sensors.camera import CameraConfig, HeightSensor, ObjectSensors
from dexsim_real.sensors.hand import HandSensing, HardwareConfig
from dexsim_real.sensors.imu import BAUD, ImuReader
from dexsim_real.twin.plant.drives import STALL_CURRENT
from dexsim_real.twin.plant.emulated_hand import EmulatedHand
from dexsim_real.twin.wire import CAMERA_RATE, FORCE_PER_COUNT, IMU_RATE, Firmware, imu_frames, picture
from dexsim_real.wire.frames import HOST, Command, Frame, decode, palm_address
from dexsim_real.wire.link import BITS_PER_BYTE, HandPort, Reply

RATE = 83.0  # exchanges a second
REQUEST, ROUND_TRIP = 0.001, 0.0096  # s until a request reaches the board; until its answer has arrived
_LEVER = 2.0**-4  # m, of a fingertip about any joint; cancels out in the ideal calibration
_APPROACH, _PLACE = 2.0, 0.5  # s to the start posture, and in it
_SLACK = 5.0  # s after the time limit of a trial at which a run ends anyway


def ideal_calibration(hand: Hand) -> Calibration:
    """The calibration of an emulated hand with nominal motors; a trial's current and taxel errors are errors of it."""

    def side(gain: np.ndarray) -> Side:
        both, one = np.broadcast_to(gain, (2, hand.num_joints)).astype(float), np.ones(hand.num_joints)
        zero = np.zeros_like(both)
        return Side(both, zero, zero, zero, zero + 1, 0 * one, one, one)

    return dataclasses.replace(
        blank_calibration(hand),
        real=side(-STALL_CURRENT / hand.torque_limit * _LEVER),
        sim=side(np.full(hand.num_joints, _LEVER)),
        force_per_count=np.full(hand.num_fingers, FORCE_PER_COUNT),
        notes=(),
    )


class VirtualPort(HandPort):
    """`HandPort` of an emulated hand in virtual time, and that time: `clock` and `sleep` take the place of `time`'s."""

    def __init__(self, plant: EmulatedHand):
        self.plant, self.firmware = plant, Firmware(plant)
        self.time, self.sequence = 0.0, 0  # s; number of exchanges
        self.events = sched.scheduler(self.clock)

    def connect(self) -> str:
        """There is nothing to open."""
        return "emulated: hand 0"

    def close(self) -> None:
        """There is nothing to close."""

    def exchange(self, command: np.ndarray) -> Reply:
        """Send a command and wait for the answer, which always comes."""
        sent = self.time
        self.wait_until(sent + REQUEST)
        request = Frame(HOST, palm_address(0), Command.EXCHANGE, command.tobytes())
        answer = self.firmware.answer(request)
        assert answer is not None, "the request is addressed to this hand"
        self.wait_until(sent + ROUND_TRIP)
        self.sequence += 1
        return Reply(decode(answer.data), sent, self.time, self.sequence, generation=1)

    def clock(self) -> float:
        """Virtual time in s."""
        return self.time

    def sleep(self, seconds: float) -> None:
        """Let a duration in s pass."""
        self.wait_until(self.time + seconds)

    def every(self, period: float, first: float, call: Callable[[], None]) -> None:
        """Schedule a call every `period` s from a time in s on."""

        def repeat() -> None:
            call()
            self.events.enterabs(self.time + period, 0, repeat)

        self.events.enterabs(first, 0, repeat)

    def wait_until(self, time: float) -> None:
        """Let the time pass until a time in s, with all events up to it."""
        while (due := self.events.queue) and due[0].time <= time:
            self._pass(due[0].time)
            self.events.run(blocking=False)
        self._pass(time)

    def _pass(self, time: float) -> None:
        if time > self.time:
            self.plant.advance(time - self.time)
            self.time = time


def virtual_imu(port: VirtualPort, seed: int) -> ImuReader:
    """The bridge's reader of the IMU in the object, without a terminal."""
    reader, frames = ImuReader(), imu_frames(port.plant, seed)

    def sample() -> None:
        data = next(frames)
        arrival = port.time + BITS_PER_BYTE * len(data) / BAUD
        port.events.enterabs(arrival, 0, reader.receive, (arrival, data))

    port.every(1 / IMU_RATE, 0.001, sample)
    return reader


def virtual_camera(port: VirtualPort, spec: TaskSpec) -> HeightSensor:
    """The bridge's height sensor, without a socket; its pictures come when they are scheduled."""
    optics = CameraConfig()
    sensor = HeightSensor(lambda: None, optics, spec)
    port.every(1 / CAMERA_RATE, 0.002, lambda: sensor.update(port.time, picture(port.plant, optics)))
    return sensor


@dataclasses.dataclass(eq=False)
class VirtualRun:
    """One trial of a policy on an emulated hand: the bridge's loops, with the plant's time as their clock.

    Raises HandError: the policy was trained with another mount than the emulated hand's.
    """

    plant: EmulatedHand  # a new one, before its first trial
    controller: Controller  # warmed; it is restarted
    command: float = 0.5  # grip command in [0, 1]
    limits: SafetyConfig = SafetyConfig()  # of the bridge's safety

    def __post_init__(self) -> None:
        plant, controller = self.plant, self.controller
        trained, mounted = np.asarray(controller.spec.gravity), plant.start.gravity
        if np.abs(trained - mounted).max() > 0.01:
            raise HandError(f"gravity {np.round(trained, 2)} in training, {np.round(mounted, 2)} here: another mount")
        self._trial = plant.trial
        self.safety = Safety(controller.hand, limits_for(self.limits, controller))
        self.port = port = VirtualPort(plant)
        sensing = HandSensing(controller.hand, HardwareConfig(), ideal_calibration(controller.hand))
        self.loop = ExchangeLoop(port, sensing, self.safety, RATE, clock=port.clock, sleep=port.sleep)
        objects = ObjectSensors(controller.spec.reference, controller.spec.gravity)
        # Who mounts a hand measures how it leans, here as well as the object's IMU does.
        objects.imu = virtual_imu(port, plant.seed) if controller.sources & {"imu", "mount"} else None
        objects.camera = virtual_camera(port, controller.spec) if "camera" in controller.sources else None
        self.policy = PolicyLoop(
            controller, self.safety, objects, command=self.command, approach_seconds=_APPROACH, place_seconds=_PLACE
        )

    def report(self) -> dict[str, Any]:
        """The referee's report of a trial that has ended, with the measurements of the bridge as `bridge`."""
        policy = self.policy
        measured = {
            "ticks": policy.ticks,
            "sensed_force": np.round(policy.finger_force / max(policy.ticks, 1), 4).tolist(),
            "safety": dict(self.safety.counts),
            "latched": self.safety.latched,
            "successes": policy.goals.successes if policy.goals else None,
        }
        report = next(r for r in self.plant.results() if r["trial"] == self._trial)
        return report | {"command": policy.command, "bridge": measured}

    def ticking(self) -> Iterator[tuple[float, Tick]]:
        """Run the trial: yields time in s and tick, after the policy's ticks, and ends with the trial (`report`)."""
        policy, port, period, ticks = self.policy, self.port, self.controller.period, list[tuple[float, Tick]]()
        self.loop.tare()
        self.loop.engage()
        self.loop.pace.next = port.time + self.loop.pace.period
        while not self.safety.anchor or policy.approach(port.time):
            self._cycle()
        policy.begin()

        def tick() -> None:
            if (made := policy.tick(port.time)) is not None:
                ticks.append((port.time, made))

        tick()
        until = port.time + self.plant.limit + _SLACK
        port.every(period, port.time + period, tick)
        while self.plant.trial == self._trial and port.time < until:
            self._cycle()
            yield from ticks
            ticks.clear()

    def _cycle(self) -> None:
        self.loop.cycle()
        self.loop.pace.wait()
