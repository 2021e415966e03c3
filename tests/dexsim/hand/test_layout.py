"""Lattices on surfaces against their geometry; refusals."""

import jax
import numpy as np
import pytest
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from shapes import solid

from dexsim.errors import ConfigError
from dexsim.geometry.distance import distance_and_normal
from dexsim.hand.layout import lay_taxels
from dexsim.hand.load import load_hand


@pytest.mark.parametrize("kind", ["rect", "hex"])
def test_neighbours_are_a_pitch_apart(kind):
    """On a straight part, unrolled."""
    taxels = lay_taxels((9, 8), pitch=0.002, kind=kind, radius=0.01, half_length=0.1)
    flat = np.stack([0.01 * np.arctan2(taxels[:, 1], taxels[:, 0]), taxels[:, 2]], 1)
    gap = cKDTree(flat).query(flat, k=7)[0][:, 1:]
    np.testing.assert_allclose(gap[:, 0], 0.002, rtol=1e-9)
    neighbours = np.sum(np.isclose(gap, 0.002), 1)
    assert neighbours.max() == (6 if kind == "hex" else 4)
    np.testing.assert_allclose(flat.mean(0), 0, atol=1e-12)
    np.testing.assert_allclose(taxels[:, 6], 0.002**2 * (np.sqrt(3) / 2 if kind == "hex" else 1))  # hexagon or square


@pytest.mark.parametrize("straight", [0.006, 0.0])
def test_taxels_lie_on_their_surface_wherever_it_is(straight):
    sizes = {"radius": 0.012, "half_length": straight}
    taxels = lay_taxels((7, 9), pitch=0.002, **sizes)
    position, normal = taxels[:, :3], taxels[:, 3:6]
    np.testing.assert_allclose(np.linalg.norm(normal, axis=1), 1, rtol=1e-12)
    above = position + 1e-5 * normal
    distance, away = jax.jit(distance_and_normal)(np.float32(above), solid("capsule", 0.012, straight))
    np.testing.assert_allclose(distance, 1e-5, atol=1e-8)
    np.testing.assert_allclose(away, normal, atol=1e-5)
    # Rows keep their pitch in arc length everywhere, columns in the middle.
    place = position.reshape(7, 9, 3)
    chord = np.linalg.norm(np.diff(place[3], axis=0), axis=1)
    assert np.all((chord > 2 * 0.012 * np.sin(0.001 / 0.012) - 1e-9) & (chord < 0.002 + 1e-9))
    across = np.linalg.norm(np.diff(place[:, 4], axis=0), axis=1)
    np.testing.assert_allclose(across, 2 * 0.012 * np.sin(0.001 / 0.012), rtol=1e-9)
    turn = Rotation.from_euler("xyz", [0.4, -0.9, 2.1]).as_matrix()
    moved = lay_taxels((7, 9), pitch=0.002, **sizes, position=(0.1, 0, 0), rotation=turn)
    np.testing.assert_allclose((moved[:, :3] - [0.1, 0, 0]) @ turn, position, atol=1e-12)
    np.testing.assert_allclose(moved[:, 3:6] @ turn, normal, atol=1e-12)
    for grid, says in (((90, 3), "laps itself"), ((3, 90), "beyond the pole")):
        with pytest.raises(ConfigError, match=says):
            lay_taxels(grid, pitch=0.002, **sizes)


def test_taxels_of_a_pad_are_on_it_and_face_as_told():
    hand = load_hand("leap_like")
    assert hand.taxel_position.shape == (4, 48, 3)
    for finger, facing in enumerate([(0, 0, 1), (1, 0, 0), (1, 0, 0), (1, 0, 0)]):
        pad = next(g for g in hand.geoms if g.name == f"{hand.finger_names[finger]}_pad")
        local = (hand.taxel_position[finger] - pad.position) @ pad.rotation
        axis = np.clip(local[:, 2], -pad.size[1], pad.size[1])
        out = local - axis[:, None] * [0, 0, 1]
        np.testing.assert_allclose(np.linalg.norm(out, axis=1), pad.size[0], atol=1e-6)
        np.testing.assert_allclose(hand.taxel_normal[finger] @ pad.rotation, out / pad.size[0], atol=1e-4)
        middle = hand.taxel_normal[finger].mean(0)
        assert middle @ facing / np.linalg.norm(middle) > 0.999
        # 6 x 8 cells of 3.5 mm, of which those over the round end are smaller.
        assert 0.95 < hand.taxel_area[finger].sum() / (48 * 0.0035**2) <= 1 + 1e-6
