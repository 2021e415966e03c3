"""Meshes as objects: the boxes that follow them, mass properties, errors, sizes drawn."""

import jax
import numpy as np
import pytest
import trimesh

import dexsim
from dexsim.core.compilation import jit
from dexsim.errors import AssetError
from dexsim.geometry.mesh import load_mesh
from dexsim.objects.config import KINDS, ObjectConfig
from dexsim.objects.mesh import load
from dexsim.objects.params import sample_object
from dexsim.tasks.grasp.config import GraspConfig


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("meshes")
    trimesh.creation.box((50, 36, 64)).export(path / "cuboid.ply")  # millimetres
    return path


def test_a_cuboid_gives_back_a_cuboid(folder):
    mesh_object = load(str(folder / "cuboid.ply"), unit=0.001, parts=ObjectConfig().mesh_parts)
    assert len(mesh_object.boxes.size) == 1 and max(mesh_object.boxes.deviation) < 1e-6
    np.testing.assert_allclose(mesh_object.boxes.size, [[0.025, 0.018, 0.032]], rtol=1e-4)
    np.testing.assert_allclose(mesh_object.boxes.position, 0, atol=1e-6)
    np.testing.assert_allclose(np.abs(mesh_object.boxes.quat), [[1, 0, 0, 0]], atol=1e-4)
    square = np.array([0.05, 0.036, 0.064]) ** 2
    np.testing.assert_allclose(mesh_object.inertia, (square.sum() - square) / 12, rtol=1e-6)


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
