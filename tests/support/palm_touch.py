"""What taxels feel that are given in the palm's frame, as of a hand whose links are all at the palm."""

from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np

from dexsim.hand.kinematics import HandPose
from dexsim.touch.taxel_force import compute_touch


def feel(taxels, area, geometry, position, rotation, finger_force, skin, pad_thickness_delta=0.0):
    """`compute_touch` for taxels [F, N, 3] m of `area` [F, N] m^2."""
    fingers = len(taxels)
    place, turn = jnp.zeros((fingers, 3)), jnp.tile(jnp.eye(3), (fingers, 1, 1))
    hand = SimpleNamespace(tip_body=np.arange(fingers), taxel_position=taxels, taxel_area=area)
    pose = HandPose(place, turn, place, turn)
    return compute_touch(hand, pose, geometry, position, rotation, finger_force, skin, pad_thickness_delta)
