"""What a host must know of a task to run its policies on a hand: no physics, no randomisation, no reward.

`Env.spec` makes it from the task, a policy's file carries it, and the bridge reads it from there, so that a policy
of any task runs on a computer that has neither MJX nor the task's code.
"""

import dataclasses
from collections.abc import Iterable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from dexsim.control import Control, closing, move_target, reflex_target
from dexsim.core.config import setting, validate
from dexsim.core.errors import ConfigError
from dexsim.force_loop import correct_command, target_force
from dexsim.grip_reflex import move_reflex
from dexsim.hand.kinematics import Hand
from dexsim.observation import ObservationConfig, Readings
from dexsim.touch.estimate import estimate_force


@dataclasses.dataclass(frozen=True, kw_only=True)
class TurnSpec:
    """Goals that follow one another about an axis, as in the rotation task."""

    axis: tuple[float, float, float] = setting((1.0, 0.0, 0.0), unit="1", low=-1.0, high=1.0)
    """Axis of rotation in the palm frame; any length."""
    step: float = setting(np.pi / 2, unit="rad", low=-np.pi, high=np.pi)
    """Angle from one goal to the next, with the sense of rotation."""
    angle: float = setting(0.3, unit="rad", low=0.01, high=1.5)
    """A goal is reached within this angle ..."""
    distance: float = setting(0.05, unit="m", low=0.001, high=0.5)
    """... this far from the reference ..."""
    spin: float = setting(0.0, unit="rad/s", low=0.0, high=1000.0)
    """... at no more than this spin about the axis; 0 for any."""

    def __post_init__(self) -> None:
        validate(self)
        if np.linalg.norm(self.axis) < 1e-6:
            raise ConfigError("TurnSpec.axis is (0, 0, 0): give a direction")

    @property
    def unit_axis(self) -> np.ndarray:
        """The axis [3], of length one."""
        return np.asarray(self.axis, float) / np.linalg.norm(self.axis)


@dataclasses.dataclass(frozen=True, kw_only=True)
class TaskSpec:
    """One task, as a host sees it. SI units, palm frame."""

    name: str
    """The task's name."""
    fields: tuple[str, ...]
    """Fields of the actor's observation, before `observation` leaves out or adds any; see `dexsim.observation`."""
    gravity: tuple[float, float, float] = setting((9.81, 0.0, 0.0), unit="m/s^2", low=-20.0, high=20.0)
    """Gravity: how the hand is mounted."""
    reference: tuple[float, float, float] = setting((0.0, 0.0, 0.0), unit="m", low=-1.0, high=1.0)
    """Where the object belongs; what stands in for coordinates that nothing measures."""
    posture: tuple[float, ...] = setting((), unit="rad", low=-7.0, high=7.0)
    """Joint angles [J] that an episode starts from; empty: from wherever the hand is."""
    control: Control = setting(Control())
    """From action to joint targets."""
    observation: ObservationConfig = setting(ObservationConfig())
    """What the policy sees."""
    object_axes: tuple[bool, bool, bool] = (True, False, False)
    """Which coordinates of the object are measured."""
    velocity_filter: float = setting(0.5, unit="1", low=0.01, high=1.0)
    """Weight of the newest difference in the estimate of the object's velocity."""
    turn: TurnSpec | None = None
    """Goals that follow one another; None for a task without."""
    finger_force: tuple[float, float] | None = None
    """Force in N of a touching finger at the commands 0 and 1; None for a task without a force command."""

    def __post_init__(self) -> None:
        validate(self)
        for loop in ("force", "reflex"):
            if getattr(self.control, loop).gain and self.finger_force is None:
                raise ConfigError(f"task {self.name!r}: Control.{loop} needs a force command, which the task has not")

    @property
    def force_loop(self) -> bool:
        """Whether the command is corrected by the estimated force."""
        return self.control.force.gain > 0

    @property
    def grip_reflex(self) -> bool:
        """Whether the fingers' joint targets are corrected by their estimated forces."""
        return self.control.reflex.gain > 0

    @classmethod
    def of(cls, task: Any) -> "TaskSpec":
        """The specification of a `dexsim.env.task.Task`."""
        config = task.config
        return cls(
            name=task.name,
            fields=tuple(task.fields["actor"]),
            gravity=_triple(task.gravity),
            reference=_triple(task.reference),
            posture=tuple(map(float, getattr(config, "posture", ()))),
            control=config.control,
            observation=config.observation,
            object_axes=config.sensing.object_axes,
            velocity_filter=config.sensing.velocity_filter,
            turn=getattr(config, "turn", None),
            finger_force=getattr(config, "finger_force", None),
        )

    def check_hand(self, hand: Hand) -> None:
        """Raises ConfigError: the start posture is of another hand."""
        if self.posture and len(self.posture) != hand.num_joints:
            raise ConfigError(f"task {self.name!r}: {len(self.posture)} posture angles, the hand has {hand.num_joints}")


def correct_readings(
    spec: TaskSpec, hand: Hand, period: float, readings: Readings, correction: jax.Array | None
) -> tuple[Readings, jax.Array]:
    """Readings whose command is what the force loop shows the policy, and the correction in it.

    Args:
      spec: of a task with a force loop.
      hand: the hand.
      period: s, control tick.
      readings: one tick, with the user's command.
      correction: [] of the tick before; None at the start of an episode.
    """
    assert spec.finger_force is not None, "checked when the specification was made"
    force = estimate_force(spec.observation.force, hand, readings.taxel_force, readings.joint_torque)
    before = jnp.zeros(()) if correction is None else correction
    after = correct_command(spec.control.force, spec.finger_force, period, readings.command, before, force)
    return dataclasses.replace(readings, command=readings.command + after), after


def next_target(
    spec: TaskSpec,
    hand: Hand,
    period: float,
    readings: Readings,
    target: jax.Array,
    reflex: jax.Array | None,
    action: jax.Array,
    measured: jax.Array,
) -> tuple[jax.Array, jax.Array | None]:
    """The next joint targets [J] rad, and the angles [F] rad in them that are the grip reflex's.

    Args:
      spec: of the task.
      hand: the hand.
      period: s, control tick.
      readings: what the action answers to.
      target: [J] rad, joint targets so far.
      reflex: [F] rad, of the tick before; None without a reflex.
      action: [J] in [-1, 1].
      measured: [J] rad, joint angles now.
    """
    control = spec.control
    if reflex is None:
        return move_target(control, hand, target, action, measured), None
    assert spec.finger_force is not None, "checked when the specification was made"
    force = estimate_force(spec.observation.force, hand, readings.taxel_force, readings.joint_torque)
    wanted = target_force(readings.command, spec.finger_force)
    chosen = move_target(control, hand, target - reflex_target(hand, reflex), action, measured)
    angle = reflex_target(hand, move_reflex(control.reflex, period, reflex, wanted, force))
    # Within the policy's own limits; what they cut off does not wind up.
    pressed = move_target(control, hand, chosen + angle, jnp.zeros_like(action), measured)
    return pressed, (pressed - chosen)[hand.root_joint] * closing(hand)


def _triple(values: Iterable[float]) -> tuple[float, float, float]:
    x, y, z = map(float, values)
    return x, y, z
