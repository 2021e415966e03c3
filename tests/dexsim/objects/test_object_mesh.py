"""Meshes as objects: the boxes that follow them, mass properties, errors, and environments with them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh

import dexsim
from dexsim.core.compilation import jit
from dexsim.core.errors import AssetError
from dexsim.geometry import distance, sdf
from dexsim.geometry.mesh import load_mesh
from dexsim.objects.config import KINDS, ObjectConfig
from dexsim.objects.mesh import load, principal_axes
from dexsim.objects.params import sample_object
from dexsim.tasks.grasp.config import GraspConfig

WORLDS = 4


def ell():
    """An L of 60 x 50 x 30 mm whose bars are 20 mm wide."""
    outline = 0.01 * np.array([[0, 0], [6, 0], [6, 2], [2, 2], [2, 5], [0, 5]])
    vertices = np.concatenate([np.c_[outline, np.full(6, z)] for z in (0, 0.03)])
    caps = np.array([[0, 1, 2], [0, 2, 3], [0, 3, 4], [0, 4, 5]])
    after = [(k + 1) % 6 for k in range(6)]
    walls = [face for k in range(6) for face in ([k, after[k], after[k] + 6], [k, after[k] + 6, k + 6])]
    return trimesh.Trimesh(vertices, np.concatenate([caps[:, ::-1], caps + 6, walls]), process=False)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("meshes")
    trimesh.creation.box((50, 36, 64)).export(path / "cuboid.ply")  # millimetres
    ell().export(path / "ell.obj")
    return path


def test_a_cuboid_gives_back_a_cuboid(folder):
    mesh_object = load(str(folder / "cuboid.ply"), unit=0.001, parts=ObjectConfig().mesh_parts)
    assert len(mesh_object.boxes.size) == 1 and max(mesh_object.boxes.deviation) < 1e-6
    np.testing.assert_allclose(mesh_object.boxes.size, [[0.025, 0.018, 0.032]], rtol=1e-4)
    np.testing.assert_allclose(mesh_object.boxes.position, 0, atol=1e-6)
    np.testing.assert_allclose(np.abs(mesh_object.boxes.quat), [[1, 0, 0, 0]], atol=1e-4)
    square = np.array([0.05, 0.036, 0.064]) ** 2
    np.testing.assert_allclose(mesh_object.inertia, (square.sum() - square) / 12, rtol=1e-6)


@pytest.mark.slow
def test_an_l_is_two_bars(folder):
    """In the object's frame, which lies askew to them."""
    mesh_object, solid = load(str(folder / "ell.obj"), unit=1.0, parts=6), ell()
    axes = principal_axes(solid.moment_inertia / solid.mass)
    assert len(mesh_object.boxes.size) == 2 and 0.3 < np.arccos(axes[0, 0]) < 0.8
    corners = (np.asarray(solid.vertices) - solid.center_mass) @ axes
    on_surface = np.abs(sdf.signed_distance(jnp.float32(corners), mesh_object.boxes.shape()))
    assert on_surface.max() < 3e-4 and max(mesh_object.boxes.deviation) < 3e-4


def test_loose_vertices_are_no_part_of_a_mesh():
    cube = trimesh.creation.box((0.05, 0.05, 0.05))
    mesh = load_mesh((np.vstack([cube.vertices, [[5.0, 5.0, 5.0]]]), cube.faces))
    np.testing.assert_allclose(np.ptp(mesh.vertices, axis=0), 0.05)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("ring.stl", "1 boxes do not follow its surface, .* mm at worst, of 120 mm; allow more"),
        ("large.stl", r"at scale 1, .* pass scale=0.001 for a file in millimetres .ObjectConfig.mesh_unit"),
        ("hollow.stl", "a mesh of 60 mm has no inside at a resolution of .* its walls are too thin for boxes"),
    ],
)
def test_a_mesh_that_will_not_do(hand, tmp_path, name, message):
    trimesh.creation.torus(0.05, 0.01, major_sections=24, minor_sections=8).export(tmp_path / "ring.stl")
    trimesh.creation.box((50, 50, 50)).export(tmp_path / "large.stl")
    cavity = trimesh.creation.box((0.059, 0.059, 0.059))
    cavity.invert()
    trimesh.util.concatenate([trimesh.creation.box((0.06, 0.06, 0.06)), cavity]).export(tmp_path / "hollow.stl")
    with pytest.raises(AssetError, match=message):
        dexsim.make("grasp", GraspConfig(objects=ObjectConfig(mesh=str(tmp_path / name), mesh_parts=1)), hand=hand)


def test_sizes_masses_and_inertia_drawn_are_of_the_solid(folder):
    config = ObjectConfig(
        mesh=str(folder / "cuboid.ply"), mesh_unit=0.001, mesh_size=(0.8, 1.2), inertia_scale=(1.0, 1.0)
    )
    draw = jit(jax.vmap(lambda key: sample_object(key, config)), once=True)
    drawn = draw(jax.random.split(jax.random.key(0), 200))
    sides = 2 * np.asarray(drawn.size[:, 0])
    factor = sides[:, 0] / 0.05
    np.testing.assert_allclose(sides, factor[:, None] * [0.05, 0.036, 0.064], rtol=1e-4)
    assert 0.8 <= factor.min() < 0.85 and 1.15 < factor.max() <= 1.2 + 1e-6
    solid = np.asarray(drawn.mass)[:, None] / 12 * (np.sum(sides**2, 1, keepdims=True) - sides**2)
    np.testing.assert_allclose(drawn.inertia, solid, rtol=1e-4)
    assert np.all(drawn.shape_index == KINDS.index("mesh")) and np.ptp(drawn.mass) > 0.1


@pytest.mark.slow
@pytest.mark.parametrize("method", ["closed_form", "grid", "surface_points"])
def test_taxels_feel_the_mesh_at_the_size_of_the_episode(folder, method):
    objects = ObjectConfig(mesh=str(folder / "cuboid.ply"), mesh_unit=0.001, mesh_size=(0.9, 1.1))
    env = dexsim.make("grasp", GraspConfig(objects=objects, pool_size=16, touch_method=method), backend="c")
    targets = jax.tree.map(lambda leaf: jnp.asarray(leaf)[:WORLDS], env.pool.object)
    assert len(np.unique(env.pool.object.size[:, 0, 0])) == 16
    points = jnp.asarray(np.random.default_rng(0).uniform(-0.035, 0.035, (500, 3)), jnp.float32)
    felt = jax.jit(jax.vmap(lambda target: distance.signed_distance(points, env.touch_geometry(target))))(targets)
    exact = jax.vmap(lambda target: sdf.box(points, target.size[0]))(targets)
    near = np.abs(exact) < 0.003
    # Surface points: beyond an edge the offset from a face's plane falls short of the distance.
    mean, worst = {"closed_form": (1e-6, 1e-6), "grid": (3e-5, 3e-4), "surface_points": (3e-4, 5e-3)}[method]
    error = np.abs(felt - exact)[near]
    assert error.mean() < mean and error.max() < worst
