"""From taxels to a force and a contact centre per finger: the same code for simulated and measured taxels.

Taxels miss what the skin beside them bears: they are a lower bound. A root joint's torque has it all, with the joint's
friction in it, and how much force it is depends on where the finger touches.

Shapes: F fingers, N taxels a finger. Units: m, N.
"""

import jax
import jax.numpy as jnp

from dexsim.geometry import rotations
from dexsim.hand.description import Hand
from dexsim.hand.kinematics import HandPose

_TOUCHING = 0.1  # N on a finger's taxels, above which it touches: one count of the hand


def reduce_touch(force: jax.Array, taxels: jax.Array, weighting: str = "force") -> tuple[jax.Array, jax.Array]:
    """Total force F_i [F] and contact centre mu_i [F, 3] of each finger; zero for a finger that touches nothing.

    Args:
      force: [F, N] N (with weighting "depth": the penetration, the paper's simplification).
      taxels: [F, N, 3] m.
      weighting: "force" (or "depth"): mu_i = sum f_ij p_ij / F_i; "none": mean of active taxels.
    """
    weight = (force > 0).astype(force.dtype) if weighting == "none" else force
    total = jnp.sum(weight, 1)
    centre = jnp.sum(weight[..., None] * taxels, 1) / jnp.where(total > 0, total, 1.0)[:, None]
    return jnp.sum(force, 1), centre


def reduce_touch_links(
    force: jax.Array, hand: Hand, pose: HandPose, weighting: str = "force"
) -> tuple[jax.Array, jax.Array]:
    """`reduce_touch` in the links' frames: the mean first, then one transform a finger."""
    total, mean = reduce_touch(force, jnp.asarray(hand.taxel_position), weighting)
    centre = pose.body_position[hand.tip_body] + rotations.rotate(pose.tip_rotation, mean)
    return total, jnp.where(total[:, None] > 0, centre, 0.0)


def estimate_force(torque_share: float, hand: Hand, taxel_force: jax.Array, joint_torque: jax.Array) -> jax.Array:
    """Estimated force [F] N of each finger: the sum of its `taxel_force` [F, N] N and `torque_share` of what its
    `joint_torque` [J], over the torque limits, tells beyond it by the hand's `force_per_torque`; 0 without touch.
    """
    taxels = jnp.sum(taxel_force, 1)
    gain = hand.force_per_torque * hand.torque_limit[hand.root_joint]
    beyond = jnp.maximum(gain * jnp.abs(joint_torque[hand.root_joint]) - taxels, 0.0)
    return jnp.where(taxels > _TOUCHING, taxels + torque_share * beyond, 0.0)
