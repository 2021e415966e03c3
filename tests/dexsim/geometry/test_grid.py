"""Meshes against closed forms; baked grids against SciPy's interpolation; what is refused, and why."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from scipy.interpolate import RegularGridInterpolator
from shapes import bake, solid

from dexsim.errors import AssetError
from dexsim.geometry import grid, mesh
from dexsim.geometry.distance import distance_and_normal as measure

BOX = np.array([0.025, 0.02, 0.03])
COARSE = 24  # nodes
signed_distance = jax.jit(grid.signed_distance)
distance_and_normal = jax.jit(measure)


@pytest.fixture(autouse=True)
def own_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("DEXSIM_CACHE", str(tmp_path / "cache"))


def turned(part):
    part.invert()
    return part


def bad_meshes():
    box = trimesh.creation.box(2 * BOX)
    vertices, faces = np.array(box.vertices), np.array(box.faces)
    mixed = faces.copy()
    mixed[4] = mixed[4][::-1]
    touching = trimesh.util.concatenate([box, box.copy().apply_translation(2 * BOX * [1, 1, 0])])
    return {
        "open": (vertices, faces[:-1]),
        "non-manifold: 1 edges have more than two": touching,
        "encloses -.* inward": turned(box.copy()),
        "both ways": (vertices, mixed),
        "scale=0.001": (1000 * vertices, faces),
        "6e-05 m across": (1e-3 * vertices, faces),
        "nowhere.stl": "nowhere.stl",
    }


@pytest.mark.parametrize("word", bad_meshes())
def test_a_bad_mesh_is_an_error(word):
    with pytest.raises(AssetError, match=word):
        mesh.load_mesh(bad_meshes()[word])


@pytest.mark.parametrize("repair", ["shell", "hull"])
def test_an_open_ball_is_closed_near_its_surface(repair, capsys):
    """A ball of 30 mm with a hole of a few millimetres, against the sphere."""
    ball = trimesh.creation.icosphere(subdivisions=3, radius=0.03)
    closed = mesh.load_mesh((ball.vertices, ball.faces[:-4]), repair=repair)
    away = np.abs(np.linalg.norm(closed.vertices, axis=1) - 0.03)
    assert away.max() < 1.5e-3  # a cell is 1.25 mm, the shell's surface at a quarter of it
    said = capsys.readouterr().err
    assert "the surface is open" in said and f"its {repair} is" in said
    mesh.check_sign(closed, count=50)  # of thousands of triangles


def test_a_mesh_that_cuts_through_itself_cannot_be_signed():
    ball = trimesh.creation.icosphere(subdivisions=2, radius=0.02)
    overlapping = trimesh.util.concatenate([ball, ball.copy().apply_translation((0.02, 0, 0))])
    with pytest.raises(AssetError, match="cannot be signed"):
        mesh.check_sign(mesh.load_mesh(overlapping))


def test_a_hollow_ball_is_signed_right():
    """A cavity: an inner surface with its normals toward the hollow."""
    outer, inner = (trimesh.creation.icosphere(subdivisions=3, radius=r) for r in (0.03, 0.02))
    hollow = mesh.load_mesh(trimesh.util.concatenate([outer, turned(inner)]))
    mesh.check_sign(hollow)
    value = mesh.signed_distance(hollow, np.array([[0.0, 0, 0], [0.025, 0, 0], [0.035, 0, 0]]))
    np.testing.assert_allclose(value, [0.02, -0.005, 0.005], atol=3e-4)


def test_values_are_scipys_interpolation():
    """Nodes at random, in every cell, on its faces and beyond the grid, at three sizes. Powers of two, so that
    arithmetic in float32 errs by little."""
    n, rng = 10, np.random.default_rng(8)
    slope = np.einsum("kijl,k->ijl", np.indices((n, n, n)), [1.0, -0.5, 0.75])
    cube = (slope + rng.uniform(-0.3, 0.3, slope.shape)).astype("float16").astype(np.float32)  # mm
    corners = [np.roll(cube.reshape(-1), -((x * n + y) * n + z)) for x, y, z in np.ndindex(2, 2, 2)]
    origin, step = -np.array([4.0, 2, 6]) / 512, np.array([1.0, 0.5, 2]) / 512
    baked = grid.Grid(
        values=jnp.asarray(np.stack(corners, -1).reshape(n, n * n, 8)),
        origin=jnp.asarray(origin, jnp.float32),
        spacing=jnp.asarray(step, jnp.float32),
        scale=jnp.ones(()),
    )
    reference = RegularGridInterpolator([np.arange(n)] * 3, 1e-3 * np.float64(cube))
    at = np.concatenate([np.indices((n, n, n)).reshape(3, -1).T, rng.integers(-96, 32 * (n + 3), (3000, 3)) / 32])
    inside = np.clip(at, 0, n - 1)
    wanted = reference(inside) + np.linalg.norm((at - inside) * step, axis=1)
    for scale in (1.0, 2.0, 0.5):
        own, here = dataclasses.replace(baked, scale=jnp.float32(scale)), np.float32(scale * (origin + at * step))
        value, normal = distance_and_normal(here, own)
        np.testing.assert_allclose(value, scale * wanted, rtol=1e-6, atol=1e-9)
        np.testing.assert_allclose(np.linalg.norm(normal, axis=1), 1, rtol=1e-5)


def test_a_mesh_is_baked_once(monkeypatch, tmp_path):
    box = mesh.load_mesh(trimesh.creation.box(2 * BOX))
    first = grid.bake(box, nodes=COARSE)
    points = np.random.default_rng(7).uniform(-0.03, 0.03, (500, 3)).astype(np.float32)
    baked = bake(solid("box", *BOX), nodes=COARSE)
    np.testing.assert_allclose(signed_distance(points, first), signed_distance(points, baked), atol=1e-6)
    (kept,) = (tmp_path / "cache" / "sdf").glob("*.npz")

    def refuse(*_):
        raise AssertionError("baked again")

    with monkeypatch.context() as patch:
        patch.setattr(mesh, "signed_distance", refuse)
        np.testing.assert_array_equal(grid.bake(box, nodes=COARSE).values, first.values)
        with pytest.raises(AssertionError, match="baked again"):
            grid.bake(box, nodes=16)
    kept.write_bytes(kept.read_bytes()[:1000])  # damaged: baked again without a word
    np.testing.assert_array_equal(grid.bake(box, nodes=COARSE).values, first.values)
    monkeypatch.setenv("DEXSIM_CACHE", "/proc/nowhere")  # not writable: no error
    np.testing.assert_array_equal(grid.bake(box, nodes=COARSE).values, first.values)
