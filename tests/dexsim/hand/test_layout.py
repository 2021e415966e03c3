"""Lattices on surfaces against their geometry; the layout file as the hand reads it; refusals."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial import cKDTree
from shapes import solid

from dexsim.core.errors import AssetError
from dexsim.geometry import sdf
from dexsim.hand import layout


@pytest.mark.parametrize("kind", ["rect", "hex"])
def test_neighbours_are_a_pitch_apart(kind):
    points = layout.lattice(9, 8, pitch=0.002, kind=kind)
    flat = np.stack([points.u, points.v], -1)
    gap = cKDTree(flat).query(flat, k=7)[0][:, 1:]
    np.testing.assert_allclose(gap[:, 0], 0.002, rtol=1e-9)
    neighbours = np.sum(np.isclose(gap, 0.002), 1)
    assert neighbours.max() == (6 if kind == "hex" else 4)
    np.testing.assert_allclose(flat.mean(0), 0, atol=1e-12)
    # A cell's area: the hexagon of that pitch, or the square.
    assert points.cell == pytest.approx(0.002**2 * (np.sqrt(3) / 2 if kind == "hex" else 1))


@pytest.mark.parametrize(
    ("kind", "sizes", "shape"),
    [
        ("plane", {}, None),
        ("cylinder", {"radius": 0.008}, solid("cylinder", 0.008, 0.1)),
        ("capsule", {"radius": 0.008, "half_length": 0.006}, solid("capsule", 0.008, 0.006)),
        ("sphere", {"radius": 0.012}, solid("sphere", 0.012)),
    ],
)
def test_patches_lie_on_their_surface(kind, sizes, shape):
    patch = layout.on_surface(kind, layout.lattice(7, 9, pitch=0.002), **sizes)
    np.testing.assert_allclose(np.linalg.norm(patch.normal, axis=1), 1, rtol=1e-12)
    if shape is None:
        np.testing.assert_array_equal(patch.position[:, 2], 0)
        return
    above = patch.position + 1e-5 * patch.normal
    distance, normal = sdf.distance_and_normal(jnp.asarray(above, jnp.float32), shape)
    np.testing.assert_allclose(distance, 1e-5, atol=1e-8)
    np.testing.assert_allclose(normal, patch.normal, atol=1e-5)
    # Rows keep their pitch in arc length everywhere, columns on the straight part.
    grid = patch.position.reshape(7, 9, 3)
    middle = grid[3]
    radius = sizes["radius"]
    chord = np.linalg.norm(np.diff(middle, axis=0), axis=1)
    assert np.all((chord > 2 * radius * np.sin(0.001 / radius) - 1e-9) & (chord < 0.002 + 1e-9))
    across = np.linalg.norm(np.diff(grid[:, 4], axis=0), axis=1)
    np.testing.assert_allclose(across, 2 * radius * np.sin(0.001 / radius), rtol=1e-9)


def test_taxels_inside_the_link_are_refused(hand):
    layout.check_hand(hand)
    finger = solid("capsule", 0.008, 0.006)
    patch = layout.on_surface("capsule", layout.lattice(5, 6, pitch=0.002), radius=0.008, half_length=0.006)
    layout.check_outside(patch, finger)
    sunk = layout.placed(patch, position=(-0.002, 0, 0))
    words = r"^tip: taxel column \d, row \d lies 2(\.0)? mm inside its link \(\d+ of 30\)$"
    with pytest.raises(AssetError, match=words):
        layout.check_outside(sunk, finger, name="tip")
