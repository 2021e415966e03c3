"""What of a finger's force presses into its skin: a sphere on the index fingertip, pushed askew."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dexsim.env.touch import TouchModel
from dexsim.hand.kinematics import forward_kinematics, taxel_normals
from dexsim.objects.params import sample_object
from dexsim.tasks.grasp.config import GraspConfig
from dexsim.touch.skin import Skin

FINGER = 1
RADIUS = 0.03  # m


@pytest.fixture(scope="module")
def contact(hand):
    """Pose, ball, its place 1 mm into the skin's reach over a taxel, and that taxel's outward normal [3]."""
    pose = jax.jit(lambda joints: forward_kinematics(hand, joints))((hand.joint_lower + hand.joint_upper) / 2)
    ball = sample_object(jax.random.key(0), GraspConfig().objects, jnp.int32(0))
    ball = dataclasses.replace(ball, size=ball.size.at[1, 0].set(RADIUS))
    taxel = 5 * 12 + 6  # in the middle of the pad
    turn = pose.tip_rotation[FINGER]
    at = pose.body_position[hand.tip_body][FINGER] + turn @ hand.taxel_position[FINGER, taxel]
    outward = taxel_normals(hand, pose)[FINGER, taxel]
    return pose, ball, at + (RADIUS + 0.002) * outward, np.asarray(outward)


@pytest.mark.slow
@pytest.mark.parametrize("total", ["pressing", "solver"])
@pytest.mark.parametrize("untaxelled", [False, True])
@pytest.mark.parametrize("along, across", [(3.0, 0.0), (3.0, 1.5), (-2.0, 1.0)])
def test_it_is_the_part_along_the_skins_normal(hand, contact, total, untaxelled, along, across):
    """Whatever the taxels are given: the whole force ("solver") or what presses; with or without skin beyond them."""
    pose, ball, place, outward = contact
    tangent = np.cross(outward, [0.0, 0.0, 1.0])
    force = np.zeros((5, 3), np.float32)
    force[FINGER] = -along * outward + across * tangent / np.linalg.norm(tangent)
    force[3] = 2.0  # touches with no skin: nobody knows how
    model = TouchModel(GraspConfig(skin=Skin(total=total, untaxelled=untaxelled)), hand)
    felt = jax.jit(model.feel)(pose, ball, place, jnp.array([1.0, 0, 0, 0]), jnp.asarray(force))
    wanted = np.zeros(5)
    wanted[FINGER] = max(along, 0.0)
    np.testing.assert_allclose(felt.normal_force, wanted, atol=0.25)  # the pad is round: its normals differ
    read = float(felt.touch.force[FINGER].sum())
    if not untaxelled:
        whole = {"solver": np.hypot(along, across), "pressing": felt.normal_force[FINGER]}[total]
        assert read == pytest.approx(float(whole), rel=1e-4)
