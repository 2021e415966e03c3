"""The object's height from masks, and the sources of masks."""

import math
import socket
import threading
import time

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dexsim_real.core.errors import HandError
from dexsim_real.sensors.camera import (
    CameraConfig,
    HeightSensor,
    camera_axes,
    encode_mask,
    height_of,
    open_masks,
)


def project(point, config):
    right, down, forward = camera_axes(config)
    at = np.asarray(point) - np.asarray(config.position)
    depth = at @ forward
    return config.centre[0] + config.focal[0] * (at @ right) / depth, config.centre[1] + config.focal[1] * (
        at @ down
    ) / depth


def picture(point, config, radius=9, shape=(480, 640)):
    column, row = project(point, config)
    rows, columns = np.mgrid[: shape[0], : shape[1]]
    return (rows - row) ** 2 + (columns - column) ** 2 <= radius**2


@settings(max_examples=25)
@given(
    st.floats(0.0, 0.12),
    st.floats(-0.3, 0.3),
    st.floats(-0.2, 0.2),
    st.sampled_from([(600, 600), (600, 800), (800, 600)]),
)
def test_height_from_a_mask(height, yaw, pitch, focal):
    config = CameraConfig(
        focal=focal,
        position=(0.05 + 0.4 * math.sin(pitch), 0.5, 0.1 + 0.3 * math.sin(yaw)),
        forward=(-math.sin(pitch), -1.0, -math.sin(yaw) * 0.6),
        down=(1.0, 0.2, 0.1),
    )
    reference = np.array([0.055, -0.005, 0.09])
    truth = reference.copy()
    truth[0] = height
    mask = picture(truth, config)
    # Half a pixel at half a metre and 600 px is 0.4 mm.
    assert height_of(mask, config, reference, 0) == pytest.approx(height, abs=6e-4)


def test_velocity_is_filtered_as_in_the_simulation():
    config, reference = CameraConfig(), np.array([0.055, -0.005, 0.09])
    sensor = HeightSensor(lambda: None, config, reference, (True, False, False), 0.5)
    for k in range(8):
        sensor.update(0.03 * k, picture(reference + [0.004 * k, 0, 0], config))
        sensor.update(0.03 * k + 0.01, np.zeros((480, 640), bool))  # Out of sight for a moment.
        sensor.update(0.03 * k - 0.02, picture(reference, config))  # Late, and says nothing new.
    when, position, velocity = sensor.read()
    assert when == pytest.approx(0.21)
    np.testing.assert_allclose(position, reference + [0.028, 0, 0], atol=6e-4)
    assert velocity[0] == pytest.approx(0.004 / 0.03 * (1 - 0.5**7), rel=0.15) and not velocity[1:].any()
    sensor.close()


def test_a_stream_of_masks_from_another_program(tmp_path):
    path, config, reference = str(tmp_path / "masks"), CameraConfig(), np.array([0.055, -0.005, 0.09])
    server = socket.socket(socket.AF_UNIX)
    server.bind(path)
    server.listen()

    def serve():
        link, _ = server.accept()
        for k in range(5):
            link.sendall(encode_mask(1.0 + k, picture(reference + [0.01 * k, 0, 0], config, shape=(481, 643))))
        link.close()

    thread = threading.Thread(target=serve)
    thread.start()
    sensor = HeightSensor(open_masks(f"unix:{path}", config), config, reference, (True, False, False), 0.5)
    thread.join()
    until = time.monotonic() + 20
    while (not sensor.has_measurement or sensor.read()[0] < 5.0) and time.monotonic() < until:
        time.sleep(0.01)
    when, position, _ = sensor.read()
    assert when == 5.0 and position[0] == pytest.approx(0.055 + 0.04, abs=6e-4)
    sensor.close()
    with pytest.raises(HandError, match="no program sends masks"):
        open_masks(f"unix:{tmp_path}/none", config)


def until(condition):
    end = time.monotonic() + 20
    while not condition() and time.monotonic() < end:
        time.sleep(0.005)
    return condition()


def test_a_camera_that_ends_or_fails_says_so():
    config, reference = CameraConfig(), np.array([0.055, -0.005, 0.09])

    def broken():
        raise RuntimeError("the lens\nfell off")

    for masks, says in ((lambda: None, "sends no more pictures"), (broken, "the camera failed: the lens fell off")):
        sensor = HeightSensor(masks, config, reference, (True, False, False), 0.5)
        assert until(lambda sensor=sensor: sensor.failure) and says in sensor.failure
        sensor.close()


@pytest.mark.parametrize("when", [1.7e9 * 10, math.nan])
def test_a_picture_of_another_clock_does_not_stay_young(when):
    config, reference = CameraConfig(), np.array([0.055, -0.005, 0.09])
    pictures = iter([(when, picture(reference, config)), None])
    sensor = HeightSensor(lambda: next(pictures), config, reference, (True, False, False), 0.5)
    assert until(lambda: sensor.has_measurement) and sensor.read()[0] <= time.monotonic()
    sensor.close()
