"""The silhouettes of the emulated camera, and heights from them."""

import math

import numpy as np
import pytest

pytest.importorskip("serial")

from dexsim_real.sensors.camera import CameraConfig, height_of
from dexsim_real.twin import wire
from dexsim_real.twin.plant.shapes import Primitive

OPTICS = CameraConfig()


def test_the_silhouette_of_a_sphere_and_of_a_box():
    place = np.array([0.05, 0.0, 0.09])
    depth = OPTICS.position[1] - place[1]
    ball = wire.outline(Primitive("sphere", (0.03,))) + place
    mask = wire.silhouette([ball], OPTICS)
    # Outline of a sphere seen by a pinhole: a cone of half angle asin(r / d), nearly a circle.
    radius = 600 * math.tan(math.asin(0.03 / math.dist(OPTICS.position, place)))
    assert mask.sum() == pytest.approx(math.pi * radius**2, rel=0.03)
    cube = wire.outline(Primitive("box", (0.025, 0.025, 0.025))) + place
    mask = wire.silhouette([cube], OPTICS)
    side = 600 * 0.05 / (depth - 0.025)  # The near face hides the rest, seen nearly head on.
    assert mask.sum() == pytest.approx(side**2, rel=0.06)
    assert height_of(mask, OPTICS, place, 0) == pytest.approx(0.05, abs=0.001)
    # Half outside of the picture, behind the camera, and on edge.
    assert 0 < wire.silhouette([cube + [0.2, 0, 0]], OPTICS).sum() < mask.sum()
    assert not wire.silhouette([cube + [0, 0.6, 0]], OPTICS).any()
    flat = cube * [1, 1, 0] + [0, 0, OPTICS.position[2]]
    assert wire.silhouette([flat], OPTICS).sum() < 100
