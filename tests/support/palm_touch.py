"""What taxels feel that are given in the palm's frame, as of a hand whose links are all at the palm."""

from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np

from dexsim.hand.kinematics import HandPose
from dexsim.touch.feel import feel_links
from dexsim.touch.surface import Surface


def feel(taxels, area, geometry, position, rotation, finger_force, skin, pad_thickness_delta=0.0):
    """`feel_links` for taxels [F, N, 3] m of `area` [F, N] m^2."""
    fingers = len(taxels)
    place, turn = jnp.zeros((fingers, 3)), jnp.tile(jnp.eye(3), (fingers, 1, 1))
    hand, pose = SimpleNamespace(tip_body=np.arange(fingers)), HandPose(place, turn, place, turn)
    surface = Surface(taxels, taxels, area)
    return feel_links(hand, pose, geometry, position, rotation, finger_force, skin, surface, pad_thickness_delta)
