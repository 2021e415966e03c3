"""Skin beyond the taxels: its surface against closed forms, and the share that no taxel reads."""

import jax.numpy as jnp
import numpy as np
import pytest
from shapes import solid

from dexsim.hand.kinematics import forward_kinematics
from dexsim.touch.skin import Skin, skin_stress
from dexsim.touch.surface import whole_surface
from dexsim.touch.taxel_force import compute_touch

REACH = 0.003
SKIN = Skin()


@pytest.fixture(scope="module")
def surface(hand):
    return whole_surface(hand, REACH)


def pad(hand, finger):
    """The one capsule of an outer finger that touches: radius, half length, centre, axis."""
    (part,) = [g for g in hand.geoms if g.body == hand.tip_body[finger] and g.touches]
    return float(part.size[0]), float(part.size[1]), part.position, part.rotation[:, 2]


def facing(hand, finger):
    """Where an outer finger's taxels look, across its pad's axis, and the direction across both."""
    axis = pad(hand, finger)[3]
    front = hand.taxel_normal[finger].mean(0)
    front = front - axis * (front @ axis)
    front /= np.linalg.norm(front)
    return front, np.cross(axis, front)


def test_areas_add_up_to_the_fingertips(hand):
    """Taxels and the rest of a capsule, without a reach: neither gaps nor overlaps."""
    tiled = whole_surface(hand)
    for finger in range(1, hand.num_fingers):
        radius, half, _, _ = pad(hand, finger)
        assert tiled.area[finger].sum() == pytest.approx(4 * np.pi * radius * (radius + half), rel=0.02)


def under_a_face(radius, half, depth, modulus, thickness):
    """Force N of an elastic foundation on a capsule that a face parallel to its axis dents by `depth` m.

    The integral of modulus / thickness times depth over the cylinder between its contact's edges, and over both caps.
    """
    edge = np.arccos(1 - depth / radius)
    side = 2 * half * radius * 2 * (radius * np.sin(edge) - (radius - depth) * edge)
    return modulus / thickness * (side + np.pi * radius * depth**2)


def test_the_points_press_like_the_skin(hand):
    """A capsule's whole surface in 100 points against the integral, at every angle: no bias, errors of some 5 %."""
    surface, linear = whole_surface(hand, -1.0), Skin(law="linear", margin=0.0)
    radius, half, centre, _ = pad(hand, 1)
    front, side = facing(hand, 1)
    points, area = (x[1, hand.num_taxels :] for x in (surface.position, surface.area))
    for depth in (0.001, 0.0015):
        wanted, found = under_a_face(radius, half, depth, 6 * linear.c10, linear.thickness), []
        for angle in np.linspace(0, 2 * np.pi, 60, endpoint=False):
            way = np.cos(angle) * front + np.sin(angle) * side
            dent = np.maximum(depth - radius + (points - centre) @ way, 0.0)
            found.append(np.sum(skin_stress(dent / linear.thickness, linear) * area) / wanted)
        assert np.mean(found) == pytest.approx(1.0, abs=0.03)
        assert np.std(found) < 0.1, found


def press(hand, surface, finger, point, normal, total=5.0, depth=0.001):
    """What a finger's taxels read in all, and all its points, when a ball of 10 mm presses at `point` of its link."""
    pose = forward_kinematics(hand, jnp.asarray((hand.joint_lower + hand.joint_upper) / 2))
    # The rubber reaches `margin` out of the lattice.
    local = np.asarray(point) + np.asarray(normal) * (0.010 + SKIN.margin - depth)
    place = pose.body_position[hand.tip_body[finger]] + pose.tip_rotation[finger] @ local
    touch = compute_touch(
        hand, pose, solid("sphere", 0.010), place, jnp.eye(3), jnp.full(hand.num_fingers, total), SKIN, surface
    )
    return float(touch.force[finger, : hand.num_taxels].sum()), float(touch.force[finger].sum())


def test_in_the_middle_of_the_pad_taxels_bear_everything(hand, surface):
    for finger in range(hand.num_fingers):
        middle = np.argmin(np.linalg.norm(hand.taxel_position[finger] - hand.taxel_position[finger].mean(0), axis=1))
        at = hand.taxel_position[finger, middle], hand.taxel_normal[finger, middle]
        assert press(hand, surface, finger, *at)[0] == pytest.approx(5.0, rel=1e-4)
