"""From an action to joint targets: the same code in simulation and on the hand."""

import dataclasses

import jax
import jax.numpy as jnp

from dexsim.core.config import setting, validate
from dexsim.force_loop import ForceLoop
from dexsim.hand.kinematics import Hand


@dataclasses.dataclass(frozen=True, kw_only=True)
class Control:
    """How an action in [-1, 1] moves the joint targets."""

    step: float = setting(0.2, unit="rad", low=0.001, high=1.0)
    """Largest change of a target in one tick: the target moves by action * step."""
    reach: float = setting(0.5, unit="rad", low=0.01, high=4.0)
    """Largest distance of a target from the measured angle: bounds windup and grip torque."""
    recall: str = setting("action", choices=("action", "target"))
    """What an observation's last action is: the action itself, or the joint targets that it led to,
    as a place in each joint's range. A policy of steps that does not see its targets cannot know how
    hard it presses."""
    force: ForceLoop = setting(ForceLoop())
    """Correction of the force command by the estimated force, for tasks that have one."""

    def __post_init__(self):
        validate(self)


def move_target(control: Control, hand: Hand, target: jax.Array, action: jax.Array, measured: jax.Array) -> jax.Array:
    """The next joint targets [J] rad.

    Args:
      target: [J] rad, the targets so far.
      action: [J] in [-1, 1].
      measured: [J] rad, joint angles now.
    """
    target = target + control.step * action
    target = jnp.clip(target, measured - control.reach, measured + control.reach)
    return jnp.clip(target, hand.joint_lower, hand.joint_upper)


def observed_action(control: Control, hand: Hand, action: jax.Array, target: jax.Array) -> jax.Array:
    """The last action [J] in [-1, 1] as an observation shows it; `target` [J] rad is its outcome."""
    if control.recall == "action":
        return action
    middle = (hand.joint_upper + hand.joint_lower) / 2
    return (target - middle) / ((hand.joint_upper - hand.joint_lower) / 2)
