"""The object's sensors: height from masks; IMU frames, alignment, jumps and port; when a policy may begin."""

import dataclasses
import math
import os
import socket
import sys
import time
import tty
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import example, given, strategies as st
from scipy.spatial.transform import Rotation

from dexsim.task_spec import TaskSpec
from dexsim_real.core.errors import HandError
from dexsim_real.run import gravity_of
from dexsim_real.sensors import camera as masks_of, imu
from dexsim_real.sensors.camera import CameraConfig, HeightSensor, ObjectSensors, camera_axes, height_of
from dexsim_real.sensors.imu import IDENTITY

REFERENCE = np.array([0.055, -0.005, 0.09])  # m
DOWN = (0.0, 0.0, -9.81)  # m/s^2


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
    return HeightSensor(masks, CameraConfig(), TaskSpec(name="", fields=(), reference=tuple(REFERENCE)))


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
    when, position, velocity = sensor.newest
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


def test_masks_of_another_program_arrive_whole_or_not_at_all(tmp_path):
    """A picture, then one that is cut off, or what is no mask stream."""
    mask = np.random.default_rng(0).random((7, 9)) < 0.5
    wrong = b"MOSK" + masks_of.encode_mask(2.0, mask)[4:], masks_of._STREAM.pack(b"MASK", 65535, 65535, 2.0)
    server = socket.socket(socket.AF_UNIX)
    server.bind(str(tmp_path / "masks"))
    server.listen()
    for last in (masks_of.encode_mask(2.0, mask)[:-1], masks_of.encode_mask(2.0, mask)[:9], *wrong):
        read = masks_of.open_masks(f"unix:{tmp_path}/masks", CameraConfig())
        link, _ = server.accept()
        link.sendall(masks_of.encode_mask(1.5, mask) + last)
        link.close()
        when, found = read()
        assert when == 1.5
        np.testing.assert_array_equal(found, mask)
        if last in wrong:
            with pytest.raises(HandError, match="invalid mask frame"):
                read()
        else:
            assert read() is None
    server.close()
    with pytest.raises(HandError, match="no program sends masks here"):
        masks_of.open_masks(f"unix:{tmp_path}/nobody", CameraConfig())


def test_a_camera_is_opened_by_its_number_or_file_and_segmented_by_a_function(monkeypatch):
    opened, pictures = [], [(True, np.ones((2, 2, 3))), (False, None)]

    def capture(spec):
        opened.append(spec)
        return SimpleNamespace(isOpened=lambda: spec != 9, read=lambda: pictures.pop(0))

    monkeypatch.setitem(sys.modules, "cv2", SimpleNamespace(VideoCapture=capture))
    before = time.monotonic()
    read = masks_of.open_masks("numpy:sum", CameraConfig())
    when, mask = read()
    assert before <= when <= time.monotonic() and mask == 12 and read() is None
    for spec in ("2", "/film:1.mp4", "rtsp://camera"):
        masks_of.open_masks(spec, CameraConfig())
    assert opened == [0, 2, "/film:1.mp4", "rtsp://camera"]
    with pytest.raises(HandError, match="9: the camera cannot be opened"):
        masks_of.open_masks("9", CameraConfig())


@pytest.mark.parametrize("when", [1.7e9 * 10, math.nan])
def test_a_picture_of_another_clock_does_not_stay_young(when):
    pictures = iter([(when, picture(REFERENCE, CameraConfig())), None])
    sensor = tracking(lambda: next(pictures))
    assert until(lambda: sensor.newest[0] > 0) and sensor.newest[0] <= time.monotonic()
    sensor.close()


DATASHEET = bytes.fromhex("AA AA DE 01 00 92 FF 25 08 8D FE EC FF D1 03 00 00 00 E7")


def quat_of(yaw, pitch=0.0, roll=0.0):
    """Yaw, then pitch, then roll, each about the part's own axis; degrees."""
    return np.roll(Rotation.from_euler("ZYX", [yaw, pitch, roll], degrees=True).as_quat(), 1)


def apart(a, b):
    """Angle between two orientations, rad."""
    a, b = (Rotation.from_quat(np.roll(q, -1)) for q in (a, b))
    return (a.inv() * b).magnitude()


def test_the_datasheets_example_message():
    # Yaw 0.01, pitch -1.10, roll 20.85 degrees.
    assert apart(imu.decode(DATASHEET)[1], quat_of(0.01, -1.10, 20.85)) < 1e-3
    assert imu.encode(0xDE, quat_of(0.01, -1.10, 20.85), 9.80665e-3 * np.array([-371, -20, 977])) == DATASHEET
    bad = bytearray(DATASHEET)
    bad[7] ^= 1
    assert imu.decode(bytes(bad)) is None and imu.decode(DATASHEET[:-1]) is None
    # Their checksums fit.
    assert imu.decode(b"\xaa\xab" + DATASHEET[2:]) is None and imu.decode(DATASHEET[:-1] + b"\0\xe7") is None


@pytest.mark.parametrize(("angle", "most"), [(0, 18000), (1, 9000), (2, 18000)])
def test_an_angle_that_no_orientation_has_is_of_a_damaged_frame(angle, most):
    """In 0.01 degree, at either end."""
    for value, sound in ((most, True), (most + 1, False), (-most, True), (-most - 1, False)):
        body = imu._BODY.pack(0, *[value * (k == angle) for k in range(3)], 0, 0, 0, 0, 0, 0)
        assert (imu.decode(imu.HEAD + body + bytes([sum(body) & 0xFF])) is not None) == sound


def turns(most):
    return st.tuples(*[st.floats(-most, most)] * 3).map(lambda angles: Rotation.from_euler("zyx", angles))


@given(turns(3.0), turns(3.0), turns(0.1))
def test_one_known_pose_aligns_all_three_angles(world, first, turn):
    """Whatever the palm's lean and the IMU's heading: a turn is measured as it is in the palm frame, and so is gravity.
    `world` turns the IMU's world, whose z is up, into the palm frame."""
    reader, mount = imu.ImuReader(), Rotation.from_quat(np.roll(imu.UPRIGHT_X, -1))
    np.testing.assert_allclose(mount.apply([0.0, 0.0, 1.0]), [1.0, 0.0, 0.0], atol=1e-9)
    for index, pose in enumerate((first, turn * first)):
        reader.receive(0.01 * index, imu.encode(index, np.roll((world.inv() * pose * mount).as_quat(), 1)))
        if index == 0:
            reader.calibrate(np.roll(pose.as_quat(), 1))
    assert apart(reader.read()[1], np.roll((turn * first).as_quat(), 1)) < 4e-3
    np.testing.assert_allclose(reader.palm_gravity, world.apply([0.0, 0.0, -1.0]), atol=4e-3)


def test_an_imu_that_hangs_is_silent_and_a_jump_is_no_orientation():
    """In virtual time: a frame that repeats its index, one damaged sample, and a reference that is lost for good."""
    reader = imu.ImuReader()
    reader.receive(0.0, imu.encode(0, quat_of(0)))
    reader.calibrate(IDENTITY)
    objects = ObjectSensors(np.zeros(3), DOWN, None, reader)
    for tick in range(1, 101):
        turned = 0.01 * tick * 90  # degrees: 90 degrees in a second
        index, quat = tick, quat_of(turned)
        if tick == 30:
            quat = quat_of(turned + 170)
        if tick > 60:
            index, quat = 60, quat_of(54)
        reader.receive(0.01 * tick, imu.encode(index, quat))
        when, orientation = reader.read()
        expected = 0.9 * min(29 if tick == 30 else tick, 60)
        assert apart(orientation, quat_of(0)) == pytest.approx(math.radians(expected), abs=2e-3)
    assert when == pytest.approx(0.6) and objects.lost(1.0, 0.3) == "the IMU is silent"
    for tick in range(101, 201):
        reader.receive(0.01 * tick, imu.encode(tick, quat_of(54 + 120)))
        assert (objects.lost(0.01 * tick, 9.0) == "the orientation that the IMU sends has jumped") == (tick >= 105)
    assert apart(reader.read()[1], quat_of(0)) == pytest.approx(math.radians(54), abs=2e-3)
    reader.receive(2.01, imu.encode(201, quat_of(50)))
    assert not objects.lost(2.01, 0.3), "it has come back"


@pytest.mark.parametrize("angle", [20, 25, 180])
@pytest.mark.parametrize("burst", [False, True])
def test_an_orientation_that_jumps_and_stays_is_noticed_within_a_tenth_of_a_second(angle, burst):
    """An IMU that has lost its reference; less than 0.4 rad in 10 ms is a motion. Also where samples come together."""
    reader, objects = imu.ImuReader(), None
    noticed = None
    for tick in range(100):
        time = 0.01 * (tick // 4 * 4 + 3 if burst else tick)
        reader.receive(time, imu.encode(tick, quat_of(math.degrees(0.003 * tick) + angle * (tick >= 40))))
        if tick == 0:
            reader.calibrate(IDENTITY)
            objects = ObjectSensors(np.zeros(3), DOWN, None, reader)
        if noticed is None and objects.lost(0.01 * tick, 0.3):
            noticed = tick
    assert noticed == (44 if angle > 23 else None)


@example([15.0] * 30, 5, 1)
@given(st.lists(st.floats(-15.0, 15.0), min_size=20, max_size=60), st.sampled_from([0, 5, 17]), st.integers(1, 4))
def test_a_fast_object_and_lost_frames_are_no_jump(speeds, lost, together):
    """Up to 15 rad/s, up to 0.1 s without a frame, one by one or together; nor does the quaternion's sign jump."""
    reader, angle = imu.ImuReader(), 3.0
    for tick, speed in enumerate(speeds):
        angle += 0.01 * speed
        if not (lost and lost <= tick < lost + 9):
            time = 0.01 * (tick - tick % together)
            reader.receive(time, imu.encode(tick + 245, quat_of(math.degrees(angle))))  # The index begins anew at 256.
        if tick == 0:
            reader.calibrate(IDENTITY)
            before = reader.read()[1]
        assert not reader.jumped and reader.read()[1] @ before > 0.5
        before = reader.read()[1]


def test_before_it_is_aligned_an_imu_may_begin_with_a_wrong_orientation():
    reader = imu.ImuReader()
    for tick in range(10):
        reader.receive(0.01 * tick, imu.encode(tick, quat_of(100 * (tick > 0))))
    reader.calibrate(IDENTITY)
    assert not reader.jumped and reader.read()[0] == pytest.approx(0.09)


def test_the_imu_thread_reads_a_port():
    pytest.importorskip("serial")
    master, slave = os.openpty()
    tty.setraw(slave)
    part = imu.Imu(os.ttyname(slave))
    with pytest.raises(HandError, match="UART-RVC"):
        part.wait(0.05)
    os.write(master, imu.encode(0, quat_of(40)))
    part.wait()
    part.calibrate(IDENTITY)
    os.write(master, b"".join(b"\x00\xaa" + imu.encode(index, quat_of(40 + index)) for index in range(1, 31)))
    turned = math.radians(30)
    assert until(lambda: apart(part.read()[1], IDENTITY) == pytest.approx(turned, abs=2e-3))
    part.close()
    os.close(master)
    os.close(slave)


def test_a_policy_waits_for_the_first_picture_and_not_for_a_camera_that_has_ended():
    camera = SimpleNamespace(newest=(-math.inf,), failure="")
    objects, closed = ObjectSensors(np.zeros(3), DOWN, camera), []
    assert not objects.ready()
    camera.failure = "the camera sends no more pictures"
    with pytest.raises(HandError, match="no more pictures"):
        objects.ready()
    camera.newest = (0.0,)
    assert objects.ready() and ObjectSensors(np.zeros(3), DOWN).ready()
    camera.read, camera.close = lambda: camera.newest, lambda: closed.append("camera")
    assert objects.lost(0.29, 0.3) == "" and objects.lost(0.31, 0.3) == camera.failure
    camera.failure = ""
    assert objects.lost(0.31, 0.3) == "the object is out of sight"
    objects.close()
    assert closed == ["camera"]


def test_without_sensors_the_object_is_where_it_should_lie_and_the_palm_leans_as_it_should():
    estimate, when = ObjectSensors(REFERENCE, (0.0, 3.0, -4.0)).read(2.5)
    assert when == 2.5
    np.testing.assert_allclose(np.concatenate(estimate), [*REFERENCE, *[0] * 3, *IDENTITY, 0.0, 0.6, -0.8])


@pytest.mark.parametrize("side", ["right", "left"])
def test_a_measured_lean_gives_gravity_in_the_palm_frame(hand, side):
    """Against the heights of wrist, fingers, thumb and little finger in the world; a left hand has its thumb at -y."""
    thumb = 1.0 if side == "right" else -1.0
    for turn in Rotation.random(20, random_state=1):
        up = turn.inv().apply([0.0, 0.0, 1.0])  # palm frame: z toward the fingers
        lean = [math.asin(-up[2]), math.asin(thumb * up[1])]
        np.testing.assert_allclose(gravity_of(lean, dataclasses.replace(hand, side=side), -up), -up, atol=1e-9)
