"""The emulated IMU and camera, read by the bridge's own IMU reader and camera."""

import math
import time

import numpy as np
import pytest

pytest.importorskip("serial")
from twin_pair import Running

from dexsim_real.core.errors import HandError
from dexsim_real.sensors.camera import CameraConfig, HeightSensor, height_of, open_masks
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


def test_the_bridges_camera_sees_the_object(tmp_path):
    begin = time.monotonic()
    with Running(tmp_path, task="grasp", seed=3) as running:
        masks = open_masks(f"unix:{running.twin.sensor.path}", OPTICS)
        sensor = HeightSensor(masks, OPTICS, np.array([0.06, 0.0, 0.071]), (True, False, False), 0.3)
        while sensor.newest is None or running.twin.sensor.sent < 10:
            time.sleep(0.01)
        when, position, _ = sensor.read()
        assert position[0] == pytest.approx(0.047, abs=0.002) and when <= time.monotonic()
        sensor.close()
        assert running.twin.sensor.sent <= 2 + 1.1 * wire.CAMERA_RATE * (time.monotonic() - begin)
    with pytest.raises(HandError, match="no program sends masks"):
        open_masks(f"unix:{running.twin.sensor.path}", OPTICS)
