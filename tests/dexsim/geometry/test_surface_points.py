"""Nearest oriented points against a k-d tree; points lie on their surface; the three methods behind one signature."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from scipy.spatial import cKDTree
from shapes import bounds, solid

from dexsim.geometry import mesh, sdf, surface_points

FEW = 300
nearest = jax.jit(surface_points.nearest)


def probes(shape, count=2000, room=0.004, seed=0):
    low, high = bounds(shape)
    return np.random.default_rng(seed).uniform(low - room, high + room, (count, 3)).astype(np.float32)


def test_the_search_finds_the_nearest():
    """Against a k-d tree, on a box with a capsule jutting out and a primitive that is switched off; 300 points do not
    fill the last block."""
    shape = sdf.Shape(
        ("box", "capsule", "sphere"),
        jnp.array([[0.02, 0.02, 0.02], [0.01, 0.015, 0], [0.05, 0, 0]]),
        jnp.array([[0, 0, 0], [0, 0, 0.03], [0.2, 0, 0]]),
        jnp.tile(jnp.eye(3), (3, 1, 1)),
        jnp.array([True, True, False]),
    )
    surface = jax.jit(surface_points.from_shape, static_argnums=1)(shape, FEW)
    points = probes(shape)
    real = np.asarray(surface.position)
    gap, wanted = cKDTree(real.astype(float)).query(points.astype(float), k=2)
    found = np.asarray(nearest(points, surface))
    ours = np.linalg.norm(points - real[found], axis=1)
    np.testing.assert_allclose(ours, gap[:, 0], atol=1e-6)
    sure = gap[:, 1] - gap[:, 0] > 1e-6
    np.testing.assert_array_equal(found[sure], wanted[sure, 0])


def test_sizes_may_be_traced_and_differ_between_environments():
    points = jnp.asarray(probes(solid("sphere", 0.03), 200))

    def felt(radius):
        return surface_points.signed_distance(points, surface_points.from_shape(solid("sphere", radius), FEW))

    radii = jnp.array([0.02, 0.03])
    together = jax.jit(jax.vmap(felt))(radii)
    for row, radius in zip(together, radii, strict=True):
        np.testing.assert_allclose(row, np.linalg.norm(points, axis=1) - radius, atol=2e-3)
    slope = jax.jit(jax.grad(lambda r: felt(r).mean()))(0.03)
    assert float(slope) == pytest.approx(-1, abs=0.02)


def test_points_of_a_mesh():
    ball = mesh.load_mesh(trimesh.creation.icosphere(subdivisions=4, radius=0.03))
    surface = surface_points.from_mesh(ball, FEW)
    gap = cKDTree(np.asarray(surface.position)).query(np.asarray(surface.position), k=2)[0][:, 1]
    assert gap.min() > 0.5 * gap.max()  # far from each other
    points = probes(solid("sphere", 0.03))
    value = jax.jit(surface_points.signed_distance)(points, surface)
    truth = np.linalg.norm(points, axis=1) - 0.03
    near = np.abs(truth) < 0.003
    assert np.abs(value - truth)[near].mean() < 2e-4
