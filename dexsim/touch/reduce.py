"""From taxels to a force and a contact centre per finger: the same code for simulated and measured taxels.

Shapes: F fingers, N taxels a finger. Units: m, N.
"""

import jax
import jax.numpy as jnp

from dexsim.geometry import rotations
from dexsim.hand.description import Hand
from dexsim.hand.kinematics import HandPose


def reduce_touch(force: jax.Array, taxels: jax.Array, weighting: str = "force") -> tuple[jax.Array, jax.Array]:
    """Total force F_i [F] and contact centre mu_i [F, 3] of each finger; zero for a finger that touches nothing.

    Args:
      force: [F, N] N (with weighting "depth": the penetration, the paper's simplification).
      taxels: [F, N, 3] m.
      weighting: "force" (or "depth"): mu_i = sum f_ij p_ij / F_i; "none": mean of active taxels.
    """
    weight = (force > 0).astype(force.dtype) if weighting == "none" else force
    total = jnp.sum(weight, -1)
    centre = jnp.sum(weight[..., None] * taxels, -2) / jnp.where(total > 0, total, 1.0)[:, None]
    return jnp.sum(force, -1), centre


def reduce_touch_links(
    force: jax.Array, hand: Hand, pose: HandPose, weighting: str = "force"
) -> tuple[jax.Array, jax.Array]:
    """`reduce_touch` in the links' frames: the mean first, then one transform a finger."""
    total, mean = reduce_touch(force, jnp.asarray(hand.taxel_position), weighting)
    centre = pose.body_position[hand.tip_body] + rotations.rotate(pose.tip_rotation, mean)
    return total, jnp.where(total[:, None] > 0, centre, 0.0)
