"""What a host must know of a task to run its policies on a hand: no physics, no randomisation, no reward.

`Env.spec` makes it from the task, a policy's file carries it, and the bridge reads it from there, so that a policy
of any task runs on a computer that has neither MJX nor the task's code.
"""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from dexsim.control import Control, correct_command
from dexsim.core.config import Config, setting
from dexsim.errors import ConfigError
from dexsim.hand.description import Hand
from dexsim.hand.mirror import mirror_point
from dexsim.observation import ObservationConfig, Readings
from dexsim.touch.reduce import estimate_force

VELOCITY_WEIGHT = 0.5  # of the newest difference in the estimate of the object's velocity


@dataclasses.dataclass(frozen=True, kw_only=True)
class TurnSpec(Config):
    """Goals that follow one another about an axis, as in the rotation task."""

    axis: tuple[float, float, float] = setting((1.0, 0.0, 0.0), unit="1", low=-1.0, high=1.0)
    """Axis of rotation in the palm frame, of any length; (1, 0, 0) is the palm's normal."""
    axes: tuple[tuple[float, float, float], ...] = setting((), unit="1", low=-1.0, high=1.0)
    """Axes that can be commanded, one for an episode, of cubes; a training episode draws one. Empty: `axis` alone."""
    step: float = setting(np.pi / 2, unit="rad", low=-np.pi, high=np.pi)
    """Angle from one goal to the next; negative for turning the other way."""
    angle: float = setting(0.3, unit="rad", low=0.01, high=1.5)
    """Largest angle to a goal at which it is reached."""
    distance: float = setting(0.05, unit="m", low=0.001, high=0.5)
    """Largest distance from the reference at which a goal is reached."""
    spin: float = setting(0.0, unit="rad/s", low=0.0, high=1000.0)
    """Largest spin about the axis at which a goal is reached; 0 for any."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if any(np.linalg.norm(axis) < 1e-6 for axis in (self.axis, *self.axes)):
            raise ConfigError("TurnSpec: (0, 0, 0) among its axes: give a direction")
        if abs(self.step) < 0.1:
            raise ConfigError(f"TurnSpec.step = {self.step:g} rad: must be at least 0.1 rad to either side")

    def about(self, axis: tuple[float, ...]) -> "TurnSpec":
        """The turn about one of `axes`. Raises ConfigError: another axis."""
        if axis not in self.axes:
            raise ConfigError(f"axis {axis}: the policy can be told {self.axes or 'no axis'}")
        return dataclasses.replace(self, axis=axis)

    def mirror(self) -> "TurnSpec":
        """The turn in a mirror: the mirrored axis, the other way round."""
        axes = tuple(mirror_point(axis) for axis in self.axes)
        return dataclasses.replace(self, axis=mirror_point(self.axis), axes=axes, step=-self.step)

    @property
    def unit_axis(self) -> np.ndarray:
        """The axis [3], of length one."""
        return np.asarray(self.axis, float) / np.linalg.norm(self.axis)


@dataclasses.dataclass(frozen=True, kw_only=True)
class TaskSpec(Config):
    """One task, as a host sees it. SI units, palm frame; in a policy's file that of a right hand.

    Attributes:
      name: of the task.
      fields: of the actor's observation, before `observation` leaves out or adds any; see `dexsim.observation`.
      gravity: [3] m/s^2: how the hand is mounted.
      reference: [3] m, where the object belongs; what stands in for coordinates that nothing measures.
      posture: [J] rad, joint angles that an episode starts from; empty: from wherever the hand is.
      control: from action to joint targets.
      observation: what the policy sees.
      object_axes: [3] bool, which coordinates of the object are measured.
      turn: goals that follow one another; None for a task without.
      finger_force: [2] N, force of a touching finger at the commands 0 and 1; None for a task without a force command.
    """

    name: str
    fields: tuple[str, ...]
    gravity: tuple[float, float, float] = setting((9.81, 0.0, 0.0), unit="m/s^2", low=-20.0, high=20.0)
    reference: tuple[float, float, float] = setting((0.0, 0.0, 0.0), unit="m", low=-1.0, high=1.0)
    posture: tuple[float, ...] = setting((), unit="rad", low=-7.0, high=7.0)
    control: Control = setting(Control())
    observation: ObservationConfig = setting(ObservationConfig())
    object_axes: tuple[bool, bool, bool] = (True, False, False)
    turn: TurnSpec | None = None
    finger_force: tuple[float, float] | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.control.force.gain and self.finger_force is None:
            raise ConfigError(f"task {self.name!r}: Control.force needs a force command: set Control.force.gain to 0")

    @classmethod
    def of(cls, task: Any) -> "TaskSpec":
        """The specification of a `dexsim.Task`."""
        config = task.config
        return cls(
            name=task.name,
            fields=tuple(task.fields["actor"]),
            gravity=task.gravity,
            reference=task.reference,
            posture=tuple(map(float, task.posture)),
            control=config.control,
            observation=config.observation,
            object_axes=config.sensing.object_axes,
            turn=task.turn,
            finger_force=task.finger_force,
        )

    def mirror_for(self, hand: Hand) -> "TaskSpec":
        """From the frame of a right hand to that of this one, or back: the mirror image if it is a left one."""
        if hand.side == "right":
            return self
        turn = self.turn and self.turn.mirror()
        gravity, reference = mirror_point(self.gravity), mirror_point(self.reference)
        return dataclasses.replace(self, gravity=gravity, reference=reference, turn=turn)

    def check_hand(self, hand: Hand) -> None:
        """Raises ConfigError: the start posture is of another hand."""
        if self.posture and len(self.posture) != hand.num_joints:
            raise ConfigError(f"task {self.name!r}: {len(self.posture)} posture angles, the hand has {hand.num_joints}")


def correct_readings(
    spec: TaskSpec, hand: Hand, period: float, readings: Readings, correction: jax.Array | None
) -> tuple[Readings, jax.Array]:
    """Readings whose command, the user's before, is what the force loop of `spec` shows the policy, and the correction
    [] in it. `period` is the control tick in s, `correction` that of the tick before; None at an episode's start."""
    assert spec.finger_force is not None, "checked when the specification was made"
    force = estimate_force(spec.observation.torque_share, hand, readings.taxel_force, readings.joint_torque)
    before = jnp.zeros(()) if correction is None else correction
    after = correct_command(spec.control.force, spec.finger_force, period, readings.command, before, force)
    return dataclasses.replace(readings, command=readings.command + after), after
