"""Skin beyond the taxels: its surface against closed forms, and the share that no taxel reads."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from episodes import tip_stiffness
from scipy.spatial.transform import Rotation

from dexsim.geometry import sdf
from dexsim.hand.kinematics import forward_kinematics
from dexsim.objects.config import SLOTS, ObjectConfig
from dexsim.objects.params import ObjectParams
from dexsim.physics.config import PhysicsConfig
from dexsim.physics.physics import Physics
from dexsim.touch.feel import feel_links
from dexsim.touch.skin import Skin, skin_stress
from dexsim.touch.surface import whole_surface

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


@pytest.fixture(scope="module")
def stiffness(hand):
    """How stiff the index finger is, of nominal, where a face parallel to its pad's axis dents it by `depth` m."""
    skin = Skin(untaxelled=True, law="linear")
    physics = Physics(hand, SLOTS, ObjectConfig().largest, PhysicsConfig(), gravity=(9.81, 0.0, 0.0), backend="c")
    follow, side = jax.jit(lambda object, qpos: tip_stiffness(physics, skin, object, qpos)), 0.05
    box = ObjectParams(
        shape_index=jnp.int32(1),
        size=jnp.zeros((3, 3)).at[0].set(side),
        position=jnp.zeros((3, 3)),
        active=jnp.array([True, False, False]),
        mass=jnp.float32(0.1),
        inertia=jnp.full(3, 1e-4),
        com=jnp.zeros(3),
        friction=jnp.float32(0.9),
        contact=jnp.array([1700.0, 2.0]),
    )
    joints = jnp.asarray((hand.joint_lower + hand.joint_upper) / 2)
    pose = forward_kinematics(hand, joints)
    link, turn = (np.asarray(x[1], float) for x in (pose.body_position[hand.tip_body], pose.tip_rotation))
    radius, _, centre, axis = pad(hand, 1)

    def measure(angle, depth):
        front, across = facing(hand, 1)
        way = np.cos(angle) * front + np.sin(angle) * across
        place = link + turn @ (centre + way * (radius + skin.margin - depth + side))
        frame = np.stack([turn @ way, turn @ axis, turn @ np.cross(way, axis)], 1)
        quat = np.roll(Rotation.from_matrix(frame).as_quat(), 1)
        return float(follow(box, jnp.concatenate([joints, *(jnp.asarray(x, jnp.float32) for x in (place, quat))]))[1])

    return measure


@pytest.mark.parametrize("depth", [0.001, 0.002])
def test_fingertips_are_as_stiff_as_all_of_their_skin(hand, stiffness, depth):
    """On the pad, beside it and on its back, where there are no taxels: the integral over the capsule's surface.

    Three spheres are dented alike; see `contact.follow_skin` for the blend. The lattice stands up to some tenths of a
    millimetre out of the capsule, so that the pad's sides are stiffer.
    """
    radius, half, _, _ = pad(hand, 1)
    skin, nominal, blend = Skin(), 850.0, 0.0005  # N/m of a sphere
    pressed = under_a_face(radius, half, depth, 6 * skin.c10, skin.thickness)
    wanted = (pressed + nominal * blend) / (nominal * (3 * depth + blend))
    assert wanted > 0.35  # well above the least that a fingertip may have, which is that without skin
    found = [stiffness(angle, depth) for angle in np.linspace(0, 2 * np.pi, 16, endpoint=False)]
    np.testing.assert_allclose(found, wanted, rtol=0.4)
    np.testing.assert_allclose(found[6:11], wanted, rtol=0.1)


def press(hand, surface, finger, point, normal, total=5.0, depth=0.001):
    """What a finger's taxels read in all, and all its points, when a ball of 10 mm presses at `point` of its link."""
    pose = forward_kinematics(hand, jnp.asarray((hand.joint_lower + hand.joint_upper) / 2))
    # The rubber reaches `margin` out of the lattice.
    local = np.asarray(point) + np.asarray(normal) * (0.010 + SKIN.margin - depth)
    place = pose.body_position[hand.tip_body[finger]] + pose.tip_rotation[finger] @ local
    ball = sdf.Shape(("sphere",), jnp.array([[0.010, 0, 0]]), jnp.zeros((1, 3)), jnp.eye(3)[None], jnp.ones(1, bool))
    touch = feel_links(hand, pose, ball, place, jnp.eye(3), jnp.full(hand.num_fingers, total), SKIN, surface)
    return float(touch.force[finger, : hand.num_taxels].sum()), float(touch.force[finger].sum())


def test_in_the_middle_of_the_pad_taxels_bear_everything(hand, surface):
    for finger in range(hand.num_fingers):
        middle = np.argmin(np.linalg.norm(hand.taxel_position[finger] - hand.taxel_position[finger].mean(0), axis=1))
        at = hand.taxel_position[finger, middle], hand.taxel_normal[finger, middle]
        assert press(hand, surface, finger, *at)[0] == pytest.approx(5.0, rel=1e-4)
