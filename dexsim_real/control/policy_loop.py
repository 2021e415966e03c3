"""The policy's side of a run: from the pose at which the motors came on to the start posture, then tick after tick.

It has no clock and no thread: whoever owns it says what time it is. The runner calls it at absolute deadlines, the run
in virtual time from its schedule.
"""

import dataclasses
import math

import numpy as np

from dexsim.task_spec import TurnSpec
from dexsim_real.control.controller import Controller, Tick
from dexsim_real.control.limits import SafetyConfig
from dexsim_real.control.safety import HandSample, Safety
from dexsim_real.core.errors import HandError
from dexsim_real.sensors.camera import ObjectEstimate, ObjectSensors
from dexsim_real.sensors.imu import IDENTITY, conjugate, multiply

_PATIENCE = 60.0  # s to wait until the camera sees the object
_SMOOTH = 0.1  # s, of the object's angular velocity


class TurnGoals:
    """Tracks the goals of the rotation task by the rules of the task.

    The simulation uses the object's true angular velocity and position. Here the angular velocity is estimated from
    the orientation (filtered over 0.1 s), and only the measured coordinate of the position counts. `reference` [3] m is
    the nominal position of the object.
    """

    def __init__(self, turn: TurnSpec, reference: np.ndarray):
        self._turn, self._reference = turn, np.asarray(reference)
        self._axis = turn.unit_axis
        self.successes, self.times = 0, list[float]()
        self._last: tuple[float, np.ndarray] | None = None
        self._spin = 0.0
        self.quat = self._goal()

    def update(self, time: float, estimate: ObjectEstimate) -> np.ndarray:
        """Goal orientation [4] for an orientation at a time in s; the next one as soon as the last was reached."""
        goal, quat = self._turn, estimate.quat
        if self._last is not None and time > self._last[0]:
            step = time - self._last[0]
            turn = multiply(quat, conjugate(self._last[1]))
            rate = 2 * math.atan2(float(turn[1:] @ self._axis), float(turn[0])) / step
            rate = (rate + math.pi / step) % (2 * math.pi / step) - math.pi / step
            self._spin += step / (step + _SMOOTH) * (rate - self._spin)
        self._last = time, quat
        away = 2 * math.acos(min(1.0, abs(float(quat @ self.quat))))
        distance = np.linalg.norm(estimate.position - self._reference)
        calm = goal.spin <= 0 or abs(self._spin) <= goal.spin
        if away < goal.angle and distance < goal.distance and calm:
            self.successes += 1
            self.times.append(time)
            self.quat = self._goal()
        return self.quat

    def _goal(self) -> np.ndarray:
        angle = (self.successes + 1) * self._turn.step % (2 * math.pi)
        return np.concatenate([[math.cos(angle / 2)], math.sin(angle / 2) * self._axis])


def limits_for(config: SafetyConfig, controller: Controller) -> SafetyConfig:
    """Limits that leave a policy the time between two of its ticks."""
    return dataclasses.replace(config, watchdog=max(config.watchdog, 2.5 * controller.period))


@dataclasses.dataclass(eq=False)
class PolicyLoop:
    """Sets the joint targets of a run."""

    controller: Controller  # of the policy, warmed
    safety: Safety
    objects: ObjectSensors
    _: dataclasses.KW_ONLY
    command: float  # grip command in [0, 1]
    approach_seconds: float  # to move to the start posture; 0 stays at the measured pose
    place_seconds: float  # in the start posture
    motors_off: bool = False  # compute everything for a hand that is moved by somebody

    def __post_init__(self) -> None:
        spec = self.controller.spec
        self.goals: TurnGoals | None = None
        if spec.turn and self.objects.imu:
            self.goals = TurnGoals(spec.turn, np.asarray(spec.reference))
        self.ticks, self.finger_force = 0, np.zeros(self.controller.hand.num_fingers)  # number; N, sum over the ticks
        self.sample: HandSample  # that the newest tick saw
        self._begin: float | None = None  # s, of the approach
        self._anchor = 0

    def approach(self, now: float) -> bool:
        """Set the target of this time on the way to the start posture; False once the hand and the object are there.

        Raises HandError: the camera does not see the object, or fails.
        """
        if self._begin is None:
            # Where commands continue, not the last reading, which may be wrong.
            self._begin, self._start = now, self.safety.commanded
        ready = self._begin + self.approach_seconds + self.place_seconds
        if now >= ready and self.objects.ready():
            return False
        if now > ready + _PATIENCE:
            options = "--optics.hsv-low, --optics.hsv-high, --optics.min-area"
            raise HandError(f"the camera does not see the object; check the light, {options}")
        posture = self.controller.spec.posture if self.approach_seconds > 0 else None
        goal = self._start if posture is None else np.asarray(posture, np.float32)
        share = min((now - self._begin) / self.approach_seconds, 1.0) if self.approach_seconds > 0 else 1.0
        self.safety.set_target(smooth(self._start, goal, share), now)
        return True

    def begin(self) -> None:
        """Start the policy's episode."""
        self._anchor = self.safety.anchor
        self.controller.start(self.safety.commanded)

    def tick(self, now: float) -> Tick | None:
        """One action of the policy; None without a measurement that is young enough."""
        safety, sample = self.safety, self.safety.sample
        assert sample is not None, "the motors came on at a measured pose"
        if now - sample.time > safety.config.stale:
            return None
        if self._anchor != safety.anchor:
            self._anchor = safety.anchor
            self.controller.resume(safety.commanded)
        if self.motors_off:
            self.controller.target = sample.measured.joint_position  # Somebody may have moved the hand.
        estimate, when = self.objects.read(now)
        goal = self.goals.update(when, estimate) if self.goals else IDENTITY
        tick = self.controller.tick(sample.measured, estimate, goal, self.command)
        safety.set_target(tick.target, now, self.objects.lost(now, safety.config.stale_object))
        self.ticks += 1
        self.finger_force += sample.measured.finger_force
        self.sample = sample
        return tick


def smooth(start: np.ndarray, goal: np.ndarray, share: float) -> np.ndarray:
    """Joint angles [J] rad at this share of a motion that begins and ends at rest (smoothstep)."""
    return (start + np.float32(share * share * (3 - 2 * share)) * (goal - start)).astype(np.float32)
