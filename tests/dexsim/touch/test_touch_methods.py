"""Touch with any object and law: link frames against the palm frame, materials, the skin's own total, three axes."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from shapes import bake, solid

from dexsim.core.errors import ConfigError
from dexsim.geometry import grid, rotations, sdf, surface_points
from dexsim.geometry.mesh import load_mesh
from dexsim.hand.kinematics import forward_kinematics, taxel_normals, taxel_positions
from dexsim.touch.reduce import reduce_touch, reduce_touch_links
from dexsim.touch.skin import MATERIALS, Skin, skin_of, skin_stress
from dexsim.touch.taxel_force import compute_touch

JOINTS = np.float32([1.45, 0.08, 0.12, 0.0, 0.55, 0.4, 0.55, 0.4, 0.55, 0.4, 0.55, 0.4])
BALL, BRICK = solid("sphere", 0.03), solid("box", 0.02, 0.03, 0.025)
# Index, middle and ring finger are pressed up to 2.3 mm into a ball of 30 mm there.
PLACE, TOTAL = np.float32([0.0324, 0.0062, 0.1457]), np.float32([4.0, 1.0, 2.5, 0.5, 3.0])
TURN = np.asarray(rotations.axis_angle_to_matrix(jnp.array([0.48, 0.6, 0.64]), jnp.float32(0.7)))


@pytest.fixture(scope="module")
def links(hand):
    """`(geometry, skin) -> Touch, finger force, centre` of the half closed hand, and its taxels and normals."""
    pose = jax.jit(lambda q: forward_kinematics(hand, q))(JOINTS)

    def feel(geometry, skin):
        touch = compute_touch(hand, pose, geometry, PLACE, TURN, TOTAL, skin)
        return touch, *reduce_touch_links(touch.force, hand, pose)

    return jax.jit(feel, static_argnames="skin"), pose, taxel_positions(hand, pose), taxel_normals(hand, pose)


@pytest.mark.parametrize("weighting", ["force", "none"])
def test_link_frames_and_palm_frame_agree(hand, links, weighting):
    """Depths and contact centres against taxels that are placed one by one in the palm's frame."""
    feel, pose, taxels, _ = links
    touch, _, _ = feel(BRICK, Skin(margin=0.001))
    distance = sdf.signed_distance(sdf.to_local(taxels, PLACE, TURN), BRICK)
    np.testing.assert_allclose(touch.depth, np.maximum(0.001 - distance, 0), atol=1e-7)
    force, centre = reduce_touch_links(touch.force, hand, pose, weighting)
    expected, place = reduce_touch(touch.force, taxels, weighting)
    touching = np.asarray(expected) > 0
    assert 2 <= touching.sum() < 5
    np.testing.assert_allclose(force, expected, rtol=1e-6)
    np.testing.assert_allclose(centre, place, atol=1e-6)


@pytest.mark.parametrize("method", ["grid", "surface_points"])
def test_every_method_feels_the_same_grasp(hand, links, method):
    feel, *_ = links
    skin = Skin(margin=0.001)
    exact, force, centre = feel(BALL, skin)
    other = bake(BALL, nodes=48) if method == "grid" else surface_points.from_shape(BALL, 2048)
    ours, other_force, other_centre = feel(other, skin)
    bound = {"grid": 2.5e-5, "surface_points": 8e-5}[method]
    np.testing.assert_allclose(ours.depth, exact.depth, atol=bound)
    np.testing.assert_allclose(other_force, force, rtol=1e-5)
    np.testing.assert_allclose(other_centre, centre, atol=1.5e-4)


def test_600_forces_differentiate_through_a_mesh(hand, links):
    """Load a mesh, place it, read the hand, and push it: against finite differences, in a few lines."""
    trimesh = pytest.importorskip("trimesh")
    _, pose, *_ = links
    ball = grid.bake(load_mesh(trimesh.creation.icosphere(subdivisions=3, radius=0.03)), nodes=24)
    skin = Skin(margin=0.001)

    @jax.jit
    def total(place):
        return compute_touch(hand, pose, ball, place, jnp.eye(3), jnp.zeros(5), skin).skin_force.sum()

    exact, step = np.asarray(jax.jit(jax.grad(total))(PLACE)), 2e-5
    numeric = np.array(
        [(total(PLACE + step * e) - total(PLACE - step * e)) / (2 * step) for e in np.eye(3, dtype=np.float32)]
    )
    assert np.abs(numeric).max() > 0.1 * float(total(PLACE)) / 0.001
    np.testing.assert_allclose(exact, numeric, rtol=0.03, atol=0.03 * np.abs(numeric).max())


# --- materials -----------------------------------------------------------------------------------


@pytest.mark.parametrize("name", MATERIALS)
def test_named_materials_stiffen(name):
    skin = skin_of(name, max_compression=0.9, thickness=0.002)
    assert skin.thickness == 0.002
    assert np.all(np.diff(skin_stress(np.linspace(0, 0.9, 50, dtype=np.float32), skin)) > 0)
    with pytest.raises(ConfigError, match="material 'jelly': choose from ecoflex_00_30"):
        skin_of("jelly")
