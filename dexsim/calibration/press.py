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


def lever_arms(hand: Hand, joint_position: np.ndarray, finger: int, taxel: int | np.ndarray) -> np.ndarray:
    """Torque [J] Nm per newton that the joints, at [J] rad, must give to press along the outward normal of a taxel, or
    along the mean normal of taxels with these shares [N] of the force."""
    share = np.eye(hand.num_taxels)[taxel] if isinstance(taxel, int) else taxel
    normal, jacobian = contact_jacobian(hand, joint_position, finger, share)
    return normal @ jacobian


def fingertip_strength(hand: Hand, joint_position: np.ndarray) -> np.ndarray:
    """Largest force [F] N of each fingertip along its taxels' mean normal that leaves every joint within its stall
    torque: a static press in one posture, without gravity and friction."""
    share = np.full(hand.num_taxels, 1.0 / hand.num_taxels)
    arms = np.abs([lever_arms(hand, joint_position, finger, share) for finger in range(hand.num_fingers)])
    return (hand.torque_limit / np.maximum(arms, 1e-6)).min(-1)


def contact_jacobian(
    hand: Hand, joint_position: np.ndarray, finger: int, share: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Mean outward normal [3] of taxels with these shares [N] of a force, and the Jacobian [3, J] m of their mean
    place, at [J] rad."""
    arguments = (jnp.asarray(part, jnp.float32) for part in (joint_position, share))
    normal, jacobian = _contact_jacobian(hand, jnp.int32(finger), *arguments)
    return np.asarray(normal, float), np.asarray(jacobian, float)


@functools.partial(jax.jit, static_argnames="hand")
def _contact_jacobian(hand: Hand, finger: jax.Array, at: jax.Array, share: jax.Array) -> tuple[jax.Array, jax.Array]:
    normal = share @ taxel_normals(hand, forward_kinematics(hand, at))[finger]
    jacobian = jax.jacfwd(lambda q: share @ taxel_positions(hand, forward_kinematics(hand, q))[finger])(at)
    return normal / jnp.maximum(jnp.linalg.norm(normal), 1e-6), jacobian
