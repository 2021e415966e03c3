"""Touch against closed forms: Mooney-Rivlin, flat punch; reduction; gradients. With any object and law: link frames
against the palm frame, methods of distance, materials."""

import functools
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from shapes import bake, solid

from dexsim.errors import ConfigError
from dexsim.geometry import grid, rotations, sdf, surface_points
from dexsim.geometry.mesh import load_mesh
from dexsim.hand.kinematics import HandPose, forward_kinematics, taxel_positions
from dexsim.touch import skin as touch_skin
from dexsim.touch.reduce import reduce_touch, reduce_touch_links
from dexsim.touch.skin import MATERIALS, Skin, skin_of
from dexsim.touch.taxel_force import compute_touch, project_on_normals

EYE = np.eye(3, dtype=np.float32)
skin_stress = jax.jit(touch_skin.skin_stress, static_argnames="skin")


@functools.partial(jax.jit, static_argnames="skin")
def feel(taxels, area, geometry, position, rotation, finger_force, skin, pad_thickness_delta=0.0):
    """`compute_touch` for taxels [F, N, 3] m of `area` [F, N] m^2 in the palm's frame, as of links all at the palm."""
    fingers = len(taxels)
    place, turn = jnp.zeros((fingers, 3)), jnp.tile(jnp.eye(3), (fingers, 1, 1))
    hand = SimpleNamespace(tip_body=np.arange(fingers), taxel_position=taxels, taxel_area=area)
    pose = HandPose(place, turn, place, turn)
    return compute_touch(hand, pose, geometry, position, rotation, finger_force, skin, pad_thickness_delta)


def flat_lattice():
    """Taxels [1, N, 3], 10 x 12 of them 2 mm apart in the plane z = 0, and their areas [1, N]."""
    x, y = np.meshgrid(0.002 * (np.arange(10) - 4.5), 0.002 * (np.arange(12) - 5.5), indexing="ij")
    points = np.stack([x, y, 0 * x], -1).reshape(1, -1, 3)
    return points.astype(np.float32), np.full(points.shape[:2], 0.002**2, np.float32)


# True compression stress over 6 (C10 + C01) eps, at stretch 1 - eps.
STRETCH = (0.95, 0.9, 0.8, 0.7, 0.6, 0.5)
RATIO = {"c10": (1.054, 1.115, 1.271, 1.490, 1.815, 2.333), "c01": (1.109, 1.239, 1.589, 2.128, 3.025, 4.667)}


@pytest.mark.parametrize("name", RATIO)
def test_stress_over_hooke(name):
    strain = 1 - np.array(STRETCH, np.float32)
    stress = skin_stress(strain, Skin(**({"c10": 0.0, "c01": 0.0} | {name: 2e4})))
    np.testing.assert_allclose(stress / (6 * 2e4 * strain), RATIO[name], atol=1e-3)
    hooke = skin_stress(strain, Skin(law="linear", **({"c10": 0.0, "c01": 0.0} | {name: 2e4})))
    np.testing.assert_allclose(hooke, 6 * 2e4 * strain, rtol=1e-6)


def test_flat_punch():
    """A box pressed 0.5 mm into a flat lattice: equal force on covered taxels, none elsewhere."""
    taxels, area = flat_lattice()  # at odd multiples of a millimetre
    depth, skin = 0.0005, Skin(margin=0.0, thickness=0.002, c10=3e4)
    half = np.float32([0.006, 0.004, 0.010])
    touch = feel(taxels, area, solid("box", *half), np.float32([0, 0, half[2] - depth]), EYE, np.float32([7.5]), skin)
    covered = np.all(np.abs(taxels[0, :, :2]) < half[:2], axis=1)
    assert covered.sum() == 6 * 4
    np.testing.assert_allclose(touch.depth[0], np.where(covered, depth, 0), atol=1e-8)
    stretch = 1 - depth / 0.002
    pressure = 2 * (stretch**-2 - stretch) * 3e4
    np.testing.assert_allclose(touch.skin_force[0], np.where(covered, pressure * 0.002**2, 0), rtol=1e-4)
    np.testing.assert_allclose(touch.force[0], np.where(covered, 7.5 / 24, 0), rtol=1e-4)
    force, centre = reduce_touch(touch.force, taxels)
    assert float(force[0]) == pytest.approx(7.5, rel=1e-5)
    np.testing.assert_allclose(centre[0], 0, atol=1e-6)


@pytest.mark.parametrize(
    ("cover", "depth"), [(0.0, [0.0006, 0, 0.0013]), (-0.005, [0, 0, 0.0003]), (0.001, [0.0016, 0.0009, 0.0023])]
)
def test_rubber_of_another_thickness_feels_from_elsewhere(cover, depth):
    """The margin is the rubber's thickness beyond the lattice, which is never below zero."""
    taxels = np.float32([[[0, 0, 0.0004], [0.001, 0, 0.0011], [0.002, 0, -0.0003]]])
    box, place = solid("box", 0.02, 0.02, 0.01), np.float32([0, 0, -0.01])
    area, total = np.full((1, 3), 4e-6, np.float32), np.ones(1, np.float32)
    touch = feel(taxels, area, box, place, EYE, total, Skin(margin=0.001), cover)
    np.testing.assert_allclose(touch.depth[0], depth, atol=1e-8)


@pytest.mark.parametrize(
    "direction, pressed", [((0, 0, -1), 5.0), ((0.6, 0, -0.8), 4.0), ((0, 0, 1), 0.0), ((0, 1, 0), 0.0)]
)
def test_taxels_of_one_axis_feel_only_what_presses(direction, pressed):
    """A punch on a flat lattice whose force is askew: the part along the lattice's normal is shared."""
    taxels, area = flat_lattice()
    box, place = solid("box", 0.006, 0.004, 0.010), np.float32([0, 0, 0.0095])
    touch = feel(taxels, area, box, place, EYE, np.float32([5.0]), Skin(margin=0.0))
    normals = np.broadcast_to(np.float32([0, 0, 1]), taxels.shape)
    only = project_on_normals(touch, normals, 5 * np.float32([direction]))
    assert float(only.force.sum()) == pytest.approx(pressed, abs=1e-5)
    np.testing.assert_allclose(only.force, touch.force * pressed / 5, atol=1e-6)
    np.testing.assert_array_equal(only.skin_force, touch.skin_force)


JOINTS = np.float32([1.45, 0.08, 0.12, 0.0, 0.55, 0.4, 0.55, 0.4, 0.55, 0.4, 0.55, 0.4])
BALL, BRICK = solid("sphere", 0.03), solid("box", 0.02, 0.03, 0.025)
# Index, middle and ring finger are pressed up to 2.3 mm into a ball of 30 mm there.
PLACE, TOTAL = np.float32([0.0324, 0.0062, 0.1457]), np.float32([4.0, 1.0, 2.5, 0.5, 3.0])
TURN = np.asarray(rotations.axis_angle_to_matrix(jnp.array([0.48, 0.6, 0.64]), jnp.float32(0.7)))


@pytest.fixture(scope="module")
def links(hand):
    """`(geometry, skin, place) -> Touch, finger force, centre` of the half closed hand, and its taxels."""
    pose = jax.jit(lambda q: forward_kinematics(hand, q))(JOINTS)

    def feel(geometry, skin, place=PLACE):
        touch = compute_touch(hand, pose, geometry, place, TURN, TOTAL, skin)
        return touch, *reduce_touch_links(touch.force, hand, pose)

    return jax.jit(feel, static_argnames="skin"), pose, taxel_positions(hand, pose)


def test_taxels_add_up_to_the_fingers_force_in_the_proportions_of_the_skins_law(links):
    touch, _, _ = links[0](BALL, Skin())
    pressed = np.asarray(touch.skin_force.sum(1, keepdims=True))
    felt = pressed[:, 0] > 0
    assert felt.sum() >= 2 and not felt.all()
    np.testing.assert_allclose(touch.force.sum(1), np.where(felt, TOTAL, 0), rtol=1e-5, atol=0)
    shares = np.asarray(touch.skin_force)[felt] / pressed[felt]
    np.testing.assert_allclose(touch.force[felt], shares * TOTAL[felt, None], rtol=1e-4, atol=1e-9)


def test_a_finger_that_touches_nothing_reads_zero_and_so_is_its_slope(links):
    away = jnp.array([0.5, 0.0, 0.0])
    for value in jax.tree.leaves(links[0](BALL, Skin(), away)):
        np.testing.assert_array_equal(value, 0)
    slope = jax.jit(jax.grad(lambda place: links[0](BALL, Skin(), place)[2].sum()))(away)
    np.testing.assert_array_equal(slope, 0)


@pytest.mark.parametrize("weighting", ["force", "none"])
def test_link_frames_and_palm_frame_agree(hand, links, weighting):
    """Depths and contact centres against taxels that are placed one by one in the palm's frame."""
    feel, pose, taxels = links
    touch, _, _ = feel(BRICK, Skin(margin=0.001))
    distance = sdf.signed_distance(sdf.to_local(taxels, PLACE, TURN), BRICK)
    np.testing.assert_allclose(touch.depth, np.maximum(0.001 - distance, 0), atol=1e-7)
    force, centre = reduce_touch_links(touch.force, hand, pose, weighting)
    weight = np.asarray(touch.force if weighting == "force" else touch.force > 0)
    touching = weight.any(1)
    assert 2 <= touching.sum() < 5
    np.testing.assert_allclose(force, touch.force.sum(1), rtol=1e-6)
    place = np.einsum("fn,fnx->fx", weight, taxels)[touching] / weight.sum(1)[touching, None]
    np.testing.assert_allclose(np.asarray(centre)[touching], place, atol=1e-6)


@pytest.mark.parametrize("method", ["grid", "surface_points"])
def test_every_method_feels_the_same_grasp(hand, links, method):
    feel, *_ = links
    skin = Skin(margin=0.001)
    exact, force, centre = feel(BALL, skin)
    other = bake(BALL, nodes=48) if method == "grid" else surface_points.from_shape(BALL, 2048)
    ours, other_force, other_centre = feel(other, skin)
    bound = {"grid": 1.5e-5, "surface_points": 8e-5}[method]
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


@pytest.mark.parametrize("most", [0.2, 0.5, 0.8])
def test_a_skin_that_softens_within_its_compression_is_refused(most):
    """A negative C01 of just what its stress still grows with, and of just more than that; by differences."""
    stretch = np.linspace(1 - most, 1, 2000)
    growth = lambda c01: np.diff(2 * (stretch**-2 - stretch) * (1e4 + c01 / stretch))  # noqa: E731
    limit = max(c01 for c01 in np.arange(-9990.0, 0.0, 10.0) if np.any(growth(c01) >= 0))
    Skin(c10=1e4, c01=limit + 60, max_compression=most)
    with pytest.raises(ConfigError, match="no positive stiffness at the max_compression of"):
        Skin(c10=1e4, c01=limit - 60, max_compression=most)


@pytest.mark.parametrize("name", MATERIALS)
def test_named_materials_stiffen(name):
    skin = skin_of(name, max_compression=0.9, thickness=0.002)
    assert skin.thickness == 0.002
    assert np.all(np.diff(skin_stress(np.linspace(0, 0.9, 50, dtype=np.float32), skin)) > 0)
    with pytest.raises(ConfigError, match="material 'jelly': choose from ecoflex_00_30"):
        skin_of("jelly")
