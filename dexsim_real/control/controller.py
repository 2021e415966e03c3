"""A policy on hardware: from measurements to an action and joint targets, in the order of the simulation.

A tick of the `Controller` corresponds to one `Env.step`: the readings contain the action that led to them, the same
`observe` computes the observation, and the same `move_target` applies the policy's action to the joint targets.

`PolicyLoop` leads from the pose at which the motors came on to the start posture, then tick after tick. It has no clock
and no thread: a run calls it at absolute deadlines, a run in virtual time from its schedule.
"""

import dataclasses
import math
import os
from collections.abc import Sequence
from typing import Any

import jax
import numpy as np

from dexsim.control import move_target, observed_action
from dexsim.hand.description import Hand
from dexsim.observation import FIELDS, LayoutEntry, ObservationConfig, Readings, layout, observe, select_fields
from dexsim.task_spec import TurnSpec, correct_readings
from dexsim_ppo.policy import Policy
from dexsim_real.control.limits import SafetyConfig
from dexsim_real.control.safety import HandSample, Safety
from dexsim_real.core.errors import HandError
from dexsim_real.sensors.camera import ObjectEstimate, ObjectSensors
from dexsim_real.sensors.hand import HandMeasurement
from dexsim_real.sensors.imu import IDENTITY, conjugate, multiply

NEEDS = {
    "joint_torque": ("currents",),
    "contact_force": ("taxels",),
    "contact_centre": ("taxels",),
    "finger_force": ("taxels", "currents"),
}
"""What a hand must measure, besides its angles, for an observation field."""
_PATIENCE = 60.0  # s to wait until the camera sees the object
_SMOOTH = 0.1  # s, of the object's angular velocity


@dataclasses.dataclass(frozen=True)
class Tick:
    """One control tick; NumPy float32."""

    readings: Readings
    observation: np.ndarray
    action: np.ndarray  # [J], zero if the policy's was not finite
    target: np.ndarray  # [J] rad, NaN if the policy's action was not finite


def prepare_jax() -> None:
    """Run JAX on the CPU and in the calling thread: waking other threads costs milliseconds on a busy machine.

    Call it before anything is computed. A replay needs the same setting to reproduce a run to the last bit.
    """
    flags = os.environ.get("XLA_FLAGS", "")
    if "--xla_cpu_multi_thread_eigen" not in flags:
        os.environ["XLA_FLAGS"] = f"{flags} --xla_cpu_multi_thread_eigen=false".strip()
    jax.config.update("jax_platforms", "cpu")
    jax.config.update("jax_cpu_enable_async_dispatch", False)


def make_observe(hand: Hand, names: tuple[str, ...], config: ObservationConfig) -> Any:
    """The jit-compiled `observe` of a task, from `Readings` to the observation."""
    return jax.jit(lambda readings: observe(hand, readings, names, config))


def sources_of(names: Sequence[str]) -> set[str]:
    """The sensors ("hand", "camera", "imu", ...) for these observation fields. HandError: none measures one of them."""
    for name in names:
        if name not in FIELDS or FIELDS[name].source == "simulator":
            raise HandError(f"the policy observes {name!r:.80}, which no sensor measures on hardware")
    return {FIELDS[name].source for name in names}


class Controller:
    """The policy between readings and joint targets. `axis` [3] is the one to turn about, for a policy that can be told
    (`TurnSpec.axes`), as a right hand does it; a left one does the mirror image.

    Raises ConfigError: the policy cannot turn about it. Raises HandError: the policy observes what its task does not
    give or no sensor can measure, or gives another number of actions than the hand has joints.
    """

    def __init__(self, policy: Policy, hand: Hand, axis: tuple[float, ...] = ()):
        self.policy, self.hand = policy, hand
        if policy.spec is None:
            raise HandError(f"the policy of the task {policy.task!r} carries no task specification")
        spec = policy.spec
        if axis:
            spec = dataclasses.replace(spec, turn=(spec.turn or TurnSpec()).about(axis))
        self.spec = spec.mirror_for(hand)
        self.spec.check_hand(hand)
        names, config = self.spec.fields, self.spec.observation
        self.sources = sources_of(select_fields(names, config))
        expected = tuple(LayoutEntry(f.name, f.size, f.scale) for f in policy.observation_layout)
        if layout(hand, names, config) != expected:
            raise HandError(f"the policy's observation does not fit this version's task {policy.task!r}")
        zeros = np.zeros(sum(entry.size for entry in expected), np.float32)
        if (shape := np.shape(policy.act(policy.initial_carry(), zeros)[1])) != (hand.num_joints,):
            raise HandError(f"expected a policy with actions [{hand.num_joints}], got {list(shape)}")
        self.period = 1.0 / policy.control_rate
        self._observe = make_observe(hand, names, config)
        self._move = jax.jit(lambda *arrays: move_target(self.spec.control, hand, *arrays))
        self._correct = jax.jit(
            lambda readings, correction: correct_readings(self.spec, hand, self.period, readings, correction)
        )
        self._recall = jax.jit(lambda *arrays: observed_action(self.spec.control, hand, *arrays))
        self.start(np.zeros(hand.num_joints, np.float32))

    def warm(self) -> None:
        """Compile everything, so that the first tick is as fast as the next ones."""
        hand = self.hand
        joints = np.zeros(hand.num_joints, np.float32)
        touch, rest = np.zeros((hand.num_fingers, hand.num_taxels), np.float32), np.zeros(1)
        idle = HandMeasurement(joints, joints, touch, joints, rest, rest, rest)
        for _ in range(3):
            self.tick(idle, ObjectEstimate(np.zeros(3), np.zeros(3), IDENTITY), IDENTITY, 0.0)
        self.start(joints)

    def check_measured(self, missing: Sequence[str]) -> None:
        """Raises HandError: the policy needs what the hand does not measure, names in `wire.driver.WITHOUT`."""
        names = select_fields(self.spec.fields, self.spec.observation)
        required = {f"observes {name!r}": NEEDS.get(name, ()) for name in names}
        if self.spec.control.force.gain:
            required["corrects its command by the measured force"] = NEEDS["finger_force"]
        for what, needs in required.items():
            if lacking := [need for need in needs if need in missing]:
                options = "--env.observation.leave-out, --env.control.force.gain 0"
                raise HandError(f"the policy {what}, and the hand has no {lacking[0]}; train without it ({options})")

    def start(self, target: np.ndarray) -> None:
        """Begin an episode with these joint targets [J] rad and no previous action."""
        self.target = np.asarray(target, np.float32)
        self.last_action = np.zeros(self.hand.num_joints, np.float32)
        self.correction = np.zeros((), np.float32)  # of the command, by the force loop
        self.actions = np.tile(self._recall(self.last_action, self.target), (3, 1))  # as observations show them
        self.carry = self.policy.initial_carry()

    def resume(self, position: np.ndarray) -> None:
        """Continue from this pose [J] rad after a hold, perhaps with the object put back: the past is forgotten."""
        self.target, self.carry = np.asarray(position, np.float32), self.policy.initial_carry()

    def tick(self, measured: HandMeasurement, estimate: ObjectEstimate, goal_quat: np.ndarray, command: float) -> Tick:
        """Readings, observation, action and joint targets; `goal_quat` [4] of the object, grip command in [0, 1]."""
        self.actions = np.stack([self._recall(self.last_action, self.target), *self.actions[:2]])
        values = {
            "joint_position": measured.joint_position,
            "joint_torque": measured.joint_torque,
            "taxel_force": measured.taxel_force,
            "object_position": estimate.position,
            "object_velocity": estimate.velocity,
            "object_quat": estimate.quat,
            "goal_quat": goal_quat,
            "command": command,
            "last_action": self.actions[0],
            "past_actions": self.actions[1:],
            "palm_gravity": estimate.palm_gravity,
        }
        arrays: dict[str, Any] = {name: np.asarray(value, np.float32) for name, value in values.items()}
        readings = Readings(**arrays)
        if self.spec.control.force.gain:
            readings, correction = jax.device_get(self._correct(readings, self.correction))
            self.correction = np.asarray(correction)
        observation = np.asarray(self._observe(readings))
        carry, mode = self.policy.act(self.carry, observation)
        action = np.clip(np.asarray(mode), -1.0, 1.0)
        if np.isfinite(action).all():
            self.carry = carry
            target = self.target = jax.device_get(self._move(self.target, action, measured.joint_position))
        else:  # As in simulation this counts as no action; `Safety` holds when a target is not finite.
            action, target = np.zeros_like(self.last_action), np.full_like(self.target, np.nan)
        self.last_action = action
        return Tick(readings, observation, action, target)


class TurnGoals:
    """Tracks the goals of the rotation task by the rules of the task.

    The simulation uses the object's true angular velocity and position. Here the angular velocity is estimated from
    the orientation (filtered over 0.1 s), and only the measured coordinate of the position counts. `reference` [3] m is
    the nominal position of the object.
    """

    def __init__(self, turn: TurnSpec, reference: Sequence[float]):
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
        self.goals = TurnGoals(spec.turn, spec.reference) if spec.turn and self.objects.imu else None
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
        target, posture = self._start, np.asarray(self.controller.spec.posture, np.float32)
        if self.approach_seconds > 0 and posture.size:
            target = smooth(self._start, posture, min((now - self._begin) / self.approach_seconds, 1.0))
        self.safety.set_target(target, now)
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
