"""From an action to joint targets, and the force loop around a policy that takes a force command: what the fingers
lack is added to the command. The same code in simulation and on the hand.

The loop integrates the difference between the commanded force and the estimated one (`commanded_force`). The policy
sees the corrected command.
"""

import dataclasses
from typing import TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from dexsim.core.config import Config, setting
from dexsim.hand.description import Hand

Array = TypeVar("Array", jax.Array, np.ndarray)

# Of the command that a policy trained on [0, 1] is shown. Below 0 it lets go of weak grips.
_LOW, _HIGH = 0.0, 1.5
_SLEW = 1.0  # 1/s, largest rate of the correction


@dataclasses.dataclass(frozen=True, kw_only=True)
class ForceLoop(Config):
    """Settings of the loop."""

    gain: float = setting(0.0, unit="1/s", low=0.0, high=20.0)
    """Rate at which the command is corrected, per error; 0 turns the loop off."""
    limit: float = setting(0.6, unit="1", low=0.0, high=2.0)
    """Largest correction of the command."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Control(Config):
    """How an action in [-1, 1] moves the joint targets."""

    step: float = setting(0.2, unit="rad", low=0.001, high=1.0)
    """Largest change of a target in one tick: the target moves by action * step."""
    reach: float = setting(0.5, unit="rad", low=0.01, high=4.0)
    """Largest distance of a target from the measured angle: bounds windup and grip torque."""
    last_action_encoding: str = setting("action", choices=("action", "target"))
    """What an observation's last action is: the action itself, or the joint targets that it led to,
    as a place in each joint's range. A policy of steps that does not see its targets cannot know how
    hard it presses."""
    force: ForceLoop = setting(ForceLoop())
    """Correction of the force command by the estimated force, for tasks that have one."""


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
    if control.last_action_encoding == "action":
        return action
    middle = (hand.joint_upper + hand.joint_lower) / 2
    return (target - middle) / ((hand.joint_upper - hand.joint_lower) / 2)


def target_force(command: Array, span: tuple[float, float]) -> Array:
    """Force [...] N that each touching finger but the thumb should press with, `span` at the commands 0 and 1."""
    return span[0] + command * (span[1] - span[0])


def commanded_force(force: jax.Array, touching: jax.Array) -> jax.Array:
    """The force [] N that a command speaks of: the mean over the touching fingers, 0 where none touches.

    Args:
      force: [F] N. The first finger, the thumb, balances the others and does not count.
      touching: [F] bool.
    """
    total = jnp.sum(jnp.where(touching, force, 0.0)[1:])
    return total / jnp.maximum(jnp.sum(touching[1:].astype(jnp.float32)), 1.0)


def correct_command(
    loop: ForceLoop,
    span: tuple[float, float],
    period: float,
    command: jax.Array,
    correction: jax.Array,
    force: jax.Array,
) -> jax.Array:
    """The next correction [] of the command.

    Args:
      span: N, a finger's target at the commands 0 and 1.
      period: s, control tick.
      command: [] in [0, 1].
      correction: [] so far; it stays while fewer than two fingers beside the first touch.
      force: [F] N estimated, zero where nothing touches.
    """
    if span[0] == span[1]:  # No command speaks of another force.
        return correction
    touching = force > 0
    measured = commanded_force(force, touching)
    error = command - (measured - span[0]) / (span[1] - span[0])
    change = jnp.clip(loop.gain * error, -_SLEW, _SLEW) * period
    moved = jnp.where(jnp.sum(touching[1:]) >= 2, correction + change, correction)
    # No windup: the sum stays in what a policy is shown.
    return jnp.clip(moved, jnp.maximum(-loop.limit, _LOW - command), jnp.minimum(loop.limit, _HIGH - command))
