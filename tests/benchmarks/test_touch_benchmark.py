"""The accuracy tables of `benchmarks/touch.py`, in their quick form, hold their bounds."""

import importlib.util
import sys

import numpy as np
import pytest
from paths import ROOT

FOLDER = ROOT / "benchmarks"


@pytest.fixture(scope="module")
def accuracy():
    spec = importlib.util.spec_from_file_location("touch_accuracy", FOLDER / "touch_accuracy.py")
    module = importlib.util.module_from_spec(spec)
    sys.modules["touch_accuracy"] = module
    spec.loader.exec_module(module)
    return module


def test_sphere_and_cylinder_against_winkler(accuracy):
    rows = accuracy.forces(quick=True)
    assert len(rows) == 4 and all(row["ok"] for row in rows)


def test_flat_punch_and_known_load(accuracy):
    rows = [accuracy._punch(), *accuracy._loads()]
    assert all(row["ok"] for row in rows), rows


def test_random_grasps_press_what_they_say(accuracy):
    """Every fingertip has one taxel 0 to 1.5 mm deep whose normal faces the surface's."""
    shape = accuracy.turned_solid("sphere")
    pose, skin = accuracy.random_grasps(shape, 50), accuracy.shipped_skin()
    turn, place = np.asarray(pose.tip_rotation), np.asarray(pose.body_position)
    taxels = np.einsum("gfij,fnj->gfni", turn, skin.taxel_position) + place[:, :, None]
    normals = np.einsum("gfij,fnj->gfni", turn, skin.taxel_normal)
    radius = np.linalg.norm(taxels, axis=-1)
    facing = -np.sum(normals * taxels / radius[..., None], -1)
    depth = accuracy.SHAPES["sphere"][0] - radius
    fits = (depth > -2e-5) & (depth < 0.00152) & (facing > 1 - 1e-4)
    assert np.all(fits.any(-1))
    np.testing.assert_allclose(np.linalg.det(turn), 1, atol=1e-5)
