"""The simulation's side of a calibration: joint torques of a fingertip that presses.

In statics the torque that a joint must hold is the lever arm times the force, J^T f, and J comes from
the kinematics that simulation and hardware share. So no physics runs here, and the lines have no
friction and no noise: what the hand's currents are aligned with is the truth of the model.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np

from dexsim.hand.description import Hand
from dexsim.hand.kinematics import forward_kinematics, taxel_normals, taxel_positions

MIN_LEVER = 0.005
"""m; joints with a shorter lever arm hardly feel the press and are left out."""


def lever_arms(hand: Hand, joint_position: np.ndarray, finger: int, taxel: int) -> np.ndarray:
    """Torque [J] Nm per newton that the joints, at [J] rad, must give to press along a taxel's outward normal."""
    at = jnp.asarray(joint_position, jnp.float32)
    return np.asarray(_lever_arms(hand, at, jnp.int32(finger), jnp.int32(taxel)), float)


@functools.partial(jax.jit, static_argnames="hand")
def _lever_arms(hand: Hand, at: jax.Array, finger: jax.Array, taxel: jax.Array) -> jax.Array:
    def place(position: jax.Array) -> jax.Array:
        return taxel_positions(hand, forward_kinematics(hand, position))[finger, taxel]

    normal = taxel_normals(hand, forward_kinematics(hand, at))[finger, taxel]
    return jnp.sum(jax.jacfwd(place)(at) * normal[:, None], 0)
