"""From an action to joint targets: the same code in simulation and on the hand."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np

from dexsim.core.config import Config, setting
from dexsim.force_loop import ForceLoop
from dexsim.hand.description import Hand
from dexsim.hand.kinematics import forward_kinematics, taxel_normals


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


@functools.cache
def closing(hand: Hand) -> np.ndarray:
    """Signs [F] of the root joints' rotation that closes the fingers: it moves a fingertip where its skin faces."""
    rest = np.clip(np.zeros(hand.num_joints), hand.joint_lower, hand.joint_upper)

    @jax.jit
    def directions(posture: jax.Array) -> tuple[jax.Array, jax.Array]:
        moves = jax.jacfwd(lambda joints: forward_kinematics(hand, joints).tip_position)(posture)
        return moves, taxel_normals(hand, forward_kinematics(hand, posture))

    with jax.ensure_compile_time_eval():
        moves, normals = map(np.asarray, directions(jnp.asarray(hand.grasp_posture or rest, jnp.float32)))
    moves, faces = moves[np.arange(hand.num_fingers), :, hand.root_joint], normals.mean(1)
    return np.where(np.sum(moves * faces, -1) < 0, -1.0, 1.0).astype(np.float32)


def observed_action(control: Control, hand: Hand, action: jax.Array, target: jax.Array) -> jax.Array:
    """The last action [J] in [-1, 1] as an observation shows it; `target` [J] rad is its outcome."""
    if control.last_action_encoding == "action":
        return action
    middle = (hand.joint_upper + hand.joint_lower) / 2
    return (target - middle) / ((hand.joint_upper - hand.joint_lower) / 2)
