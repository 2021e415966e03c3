"""The simulation's side of a calibration: joint torques of a fingertip that presses.

In statics the torque that a joint must hold is the lever arm times the force, J^T f, and J comes from
the kinematics that simulation and hardware share. So no physics runs here, and the lines have no
friction and no noise: what the hand's currents are aligned with is the truth of the model.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np

from dexsim.calibration.joint import JointPress
from dexsim.core.errors import CalibrationError
from dexsim.hand.kinematics import Hand, forward_kinematics, taxel_normals, taxel_positions

MIN_LEVER = 0.005
"""m; joints with a shorter lever arm hardly feel the press and are left out."""


def lever_arms(hand: Hand, joint_position: np.ndarray, finger: int, taxel: int) -> np.ndarray:
    """Torque [J] Nm per newton that the joints must give to press outward at a taxel.

    Args:
      joint_position: [J] rad.
      finger, taxel: where; the force is along the taxel's outward normal.
    """
    at = jnp.asarray(joint_position, jnp.float32)
    return np.asarray(_lever_arms(hand, at, jnp.int32(finger), jnp.int32(taxel)), float)


@functools.partial(jax.jit, static_argnames="hand")
def _lever_arms(hand: Hand, at: jax.Array, finger: jax.Array, taxel: jax.Array) -> jax.Array:
    def place(position: jax.Array) -> jax.Array:
        return taxel_positions(hand, forward_kinematics(hand, position))[finger, taxel]

    normal = taxel_normals(hand, forward_kinematics(hand, at))[finger, taxel]
    return jnp.sum(jax.jacfwd(place)(at) * normal[:, None], 0)


def simulated_press(
    hand: Hand, joint_position: np.ndarray, finger: str, force: np.ndarray, taxel: int | None = None
) -> dict[str, JointPress]:
    """Recordings, by joint name, of the joints that feel a press of one fingertip.

    Args:
      joint_position: [J] rad, the posture of the recording on the hand.
      finger: name.
      force: [T] N, up and down, at least 20 samples either way.
      taxel: where; the middle of the array by default.

    Raises:
      CalibrationError: no such finger.
    """
    if finger not in hand.finger_names:
        raise CalibrationError(f"no finger {finger!r}: choose from {', '.join(hand.finger_names)}")
    columns, rows = hand.taxel_grid
    taxel = columns // 2 * rows + rows // 2 if taxel is None else taxel
    arms = lever_arms(hand, joint_position, hand.finger_names.index(finger), taxel)
    return {
        name: JointPress(np.asarray(force, float), np.asarray(force, float) * arm)
        for name, arm in zip(hand.joint_names, arms, strict=True)
        if abs(arm) >= MIN_LEVER
    }
