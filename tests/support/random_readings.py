"""One tick of readings in which every number is different."""

import numpy as np

from dexsim.hand.description import Hand
from dexsim.observation import Readings


def random_readings(hand: Hand, seed: int) -> Readings:
    """A tenth of the taxels are pressed; the fourth finger touches nothing."""
    rng = np.random.default_rng(seed)
    force = rng.uniform(0.1, 2, hand.taxel_area.shape) * (rng.random(hand.taxel_area.shape) < 0.1)
    force[3] = 0
    quats = rng.normal(size=(2, 4))
    quats /= np.linalg.norm(quats, axis=1, keepdims=True)
    values = dict(
        joint_position=rng.uniform(hand.joint_lower, hand.joint_upper),
        joint_torque=rng.uniform(-1, 1, hand.num_joints),
        taxel_force=force,
        object_position=rng.normal(size=3),
        object_velocity=rng.normal(size=3),
        object_quat=quats[0],
        goal_quat=quats[1],
        command=np.array(0.37),
        last_action=rng.uniform(-1, 1, hand.num_joints),
        past_actions=rng.uniform(-1, 1, (2, hand.num_joints)),
        palm_gravity=rng.normal(size=3) / 2,
    )
    return Readings(**{name: np.asarray(value, np.float32) for name, value in values.items()})
