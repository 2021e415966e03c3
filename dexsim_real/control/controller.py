"""A policy on hardware: from measurements to an action and joint targets, in the order of the simulation.

A tick corresponds to one `Env.step`: the readings contain the action that led to them, the same `observe` computes the
observation, and the same `move_target` applies the policy's action to the joint targets.
"""

import dataclasses
import os
from collections.abc import Sequence
from typing import Any

import jax
import numpy as np

from dexsim.control import move_target, observed_action
from dexsim.hand.description import Hand
from dexsim.observation import FIELDS, LayoutEntry, ObservationConfig, Readings, layout, observe, select_fields
from dexsim.task_spec import correct_readings
from dexsim_ppo.policy import Policy
from dexsim_real.core.errors import HandError
from dexsim_real.sensors.camera import ObjectEstimate
from dexsim_real.sensors.hand import HandMeasurement
from dexsim_real.sensors.imu import IDENTITY

NEEDS = {
    "joint_torque": ("currents",),
    "contact_force": ("taxels",),
    "contact_centre": ("taxels",),
    "finger_force": ("taxels", "currents"),
}
"""What a hand must measure, besides its angles, for an observation field."""


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
    """The policy between readings and joint targets.

    Raises HandError: the policy observes what its task does not give or no sensor can measure, or gives another number
    of actions than the hand has joints.
    """

    def __init__(self, policy: Policy, hand: Hand):
        self.policy, self.hand = policy, hand
        if policy.spec is None:
            raise HandError(f"the policy of the task {policy.task!r} carries no task specification")
        self.spec = policy.spec.mirror_for(hand)
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
        wanted = {f"observes {name!r}": NEEDS.get(name, ()) for name in names}
        if self.spec.force_loop:
            wanted["corrects its command by the measured force"] = NEEDS["finger_force"]
        for what, needs in wanted.items():
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
        if self.spec.force_loop:
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
