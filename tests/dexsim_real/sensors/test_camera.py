"""The object's height from masks, and the sources of masks."""

import math
import time

import numpy as np
import pytest
from hypothesis import given, strategies as st

from dexsim_real.sensors.camera import (
    CameraConfig,
    HeightSensor,
    camera_axes,
    height_of,
)

REFERENCE = np.array([0.055, -0.005, 0.09])  # m


def picture(point, config, radius=9, shape=(480, 640)):
    """A disc at a point's projection."""
    right, down, forward = camera_axes(config)
    at = np.asarray(point) - np.asarray(config.position)
    column, row = config.centre + np.array(config.focal) * [at @ right, at @ down] / (at @ forward)
    rows, columns = np.mgrid[: shape[0], : shape[1]]
    return (rows - row) ** 2 + (columns - column) ** 2 <= radius**2


@given(st.floats(0.0, 0.12), st.floats(-0.3, 0.3), st.floats(-0.2, 0.2), st.sampled_from([(600, 800), (800, 600)]))
def test_height_from_a_mask(height, yaw, pitch, focal):
    config = CameraConfig(
        focal=focal,
        position=(0.05 + 0.4 * math.sin(pitch), 0.5, 0.1 + 0.3 * math.sin(yaw)),
        forward=(-math.sin(pitch), -1.0, -math.sin(yaw) * 0.6),
        down=(1.0, 0.2, 0.1),
    )
    # Half a pixel at half a metre and 600 px is 0.4 mm.
    mask = picture([height, *REFERENCE[1:]], config)
    assert height_of(mask, config, REFERENCE, 0) == pytest.approx(height, abs=6e-4)


def tracking(masks):
    return HeightSensor(masks, CameraConfig(), REFERENCE, (True, False, False), 0.5)


def until(condition):
    end = time.monotonic() + 20
    while not condition() and time.monotonic() < end:
        time.sleep(0.005)
    return condition()


def test_velocity_is_filtered_as_in_the_simulation():
    config, sensor = CameraConfig(), tracking(lambda: None)
    for k in range(8):
        sensor.update(0.03 * k, picture(REFERENCE + [0.004 * k, 0, 0], config))
        sensor.update(0.03 * k + 0.01, np.zeros((480, 640), bool))  # Out of sight for a moment.
        sensor.update(0.03 * k - 0.02, picture(REFERENCE, config))  # Late, and says nothing new.
    when, position, velocity = sensor.read()
    assert when == pytest.approx(0.21)
    np.testing.assert_allclose(position, REFERENCE + [0.028, 0, 0], atol=6e-4)
    assert velocity[0] == pytest.approx(0.004 / 0.03 * (1 - 0.5**7), rel=0.15) and not velocity[1:].any()
    sensor.close()


def test_a_camera_that_ends_or_fails_says_so():
    def broken():
        raise RuntimeError("the lens\nfell off")

    for masks, says in ((lambda: None, "sends no more pictures"), (broken, "the camera failed: the lens fell off")):
        sensor = tracking(masks)
        assert until(lambda sensor=sensor: sensor.failure) and says in sensor.failure
        sensor.close()


@pytest.mark.parametrize("when", [1.7e9 * 10, math.nan])
def test_a_picture_of_another_clock_does_not_stay_young(when):
    pictures = iter([(when, picture(REFERENCE, CameraConfig())), None])
    sensor = tracking(lambda: next(pictures))
    assert until(lambda: sensor.has_measurement) and sensor.read()[0] <= time.monotonic()
    sensor.close()
