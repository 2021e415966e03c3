"""From the hand's counts to readings: signs, scales, zeroing, IMU and camera, against closed forms."""

import math
import socket
import threading
import time

import jax
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dexsim.geometry import rotations
from dexsim.observation import GRASP, ROTATE, ROTATE_CRITIC
from dexsim.tasks.rotate.config import RotateConfig
from dexsim.tasks.rotate.task import goal_quat
from dexsim_real.control.controller import IDENTITY
from dexsim_real.control.goals import TurnGoals
from dexsim_real.core.errors import HandError
from dexsim_real.sensors import imu
from dexsim_real.sensors.camera import (
    CameraConfig,
    HeightSensor,
    camera_axes,
    colour_mask,
    encode_mask,
    height_of,
    open_masks,
)
from dexsim_real.sensors.hand import HandSensing, HardwareConfig, VelocityFilter
from dexsim_real.sensors.readings import ObjectEstimate, sources_of
from dexsim_real.wire import frames
from dexsim_real.wire.frames import Mode


def state(**joint):
    block = frames.empty_state()
    for name, value in joint.items():
        block["joint"][name] = value
    return block


# --- the hand ------------------------------------------------------------------------------------


def test_angles_have_sign_and_offset_both_ways(hand):
    sign = np.where(np.arange(12) == 3, -1.0, 1.0)
    offset = np.linspace(-0.1, 0.1, 12)
    sensing = HandSensing(hand, HardwareConfig(joint_sign=tuple(sign), joint_offset=tuple(offset)))
    raw = np.linspace(-0.5, 1.5, 12).astype(np.float32)
    measured = sensing.measure(state(position=raw))
    np.testing.assert_allclose(measured.joint_position, raw * sign + offset, atol=1e-6)
    sent = sensing.command(measured.joint_position, Mode.POSITION)
    np.testing.assert_allclose(sent["position"], raw, atol=1e-6)
    assert measured.joint_position.dtype == np.float32


def test_a_relaxed_command_carries_no_gain(hand):
    block = HandSensing(hand, HardwareConfig()).command(np.zeros(12), Mode.PASSIVE)
    for name in ("kp", "ki", "kd", "torque_max", "mode"):
        assert not block[name].any()
    on = HandSensing(hand, HardwareConfig(torque_max=250)).command(np.zeros(12), Mode.POSITION)
    assert set(on["torque_max"].tolist()) == {250} and set(on["kp"].tolist()) == {100}


def test_taxels_are_tared_and_scaled(hand):
    sensing = HandSensing(hand, HardwareConfig(force_per_count=0.1, taxel_floor=1.0))
    rest = state()
    rest["tip"]["taxel"]["z"] = np.arange(120) % 7
    other = rest.copy()
    other["tip"]["taxel"]["z"] += 2
    sensing.set_tare([rest, other])  # Mean: 1 above rest.
    pressed = rest.copy()
    pressed["tip"]["taxel"]["z"][2, 17] += 31
    pressed["tip"]["taxel"]["x"][2, 17] = -100  # Does not count with "z".
    force = sensing.measure(pressed).taxel_force
    wanted = np.zeros((5, 120))
    wanted[2, 17] = 3.0
    np.testing.assert_allclose(force, wanted, atol=1e-6)
    np.testing.assert_allclose(sensing.measure(pressed).finger_force, wanted.sum(1), atol=1e-6)
    norm = HandSensing(hand, HardwareConfig(taxel_axes="norm"))
    block = state()
    block["tip"]["taxel"][4, 119] = (-3, 4, 12)
    assert norm.measure(block).taxel_force[4, 119] == pytest.approx(1.3)


def test_zeroing_is_refused_under_load(hand):
    sensing = HandSensing(hand, HardwareConfig())
    loaded = state()
    loaded["tip"]["taxel"]["z"][1, 5] = 90
    with pytest.raises(HandError, match="index read up to 90 counts"):
        sensing.set_tare([loaded] * 5)
    assert not sensing.tare.any()


def test_current_without_and_with_a_calibration(hand, tmp_path):
    counts = np.linspace(-900, 900, 12).astype(np.int16)
    plain = HandSensing(hand, HardwareConfig(current_sign=-1.0, current_scale=1500.0))
    np.testing.assert_allclose(plain.measure(state(current=counts)).joint_torque, counts / -1500.0, atol=1e-6)
    np.testing.assert_allclose(plain.measure(state(current=counts)).current, np.abs(counts) / 1000.0, atol=1e-6)

    from dexsim.calibration.maps import Calibration, Side, load_calibration, save_calibration

    def side(gain, offset):
        pair = np.ones((2, 12))
        return Side(
            pair * gain,
            pair,
            pair,
            pair * offset,
            pair,
            pair,
            pair,
            pair,
            pair,
            pair,
            pair,
            np.ones(12),
            np.ones(12),
            np.ones(12),
        )

    # current = -0.05 F - 0.02 A and torque = 0.04 F Nm, so torque = -0.8 (current + 0.02).
    calibration = Calibration(
        side(-0.05, -0.02),
        side(0.04, 0.0),
        hand.torque_limit,
        np.full(5, 0.2),
        hand=hand.name,
        joint_names=hand.joint_names,
        finger_names=hand.finger_names,
    )
    save_calibration(tmp_path / "hand.toml", calibration)
    sensing = HandSensing(hand, HardwareConfig(), load_calibration(tmp_path / "hand.toml", hand))
    block = state(current=counts)
    block["tip"]["taxel"]["z"][0, 0] = 10
    measured = sensing.measure(block)
    np.testing.assert_allclose(measured.joint_torque, -0.8 * (counts / 1000 + 0.02) / hand.torque_limit, atol=2e-6)
    assert measured.taxel_force[0, 0] == pytest.approx(2.0)


def test_temperatures_are_of_the_joint_boards_and_tips(hand):
    block = state(temperature=(41 << 8) | 56)
    block["tip"]["temperature"] = 33
    heat = HandSensing(hand, HardwareConfig()).measure(block).temperature
    np.testing.assert_array_equal(heat, [56] * 12 + [33] * 5)


def test_velocity_reported_or_from_differences(hand):
    reported = HandSensing(hand, HardwareConfig(reported_velocity=True, joint_sign=(-1.0,) + (1.0,) * 11))
    np.testing.assert_allclose(reported.velocity(state(velocity=1500)), [-1.5] + [1.5] * 11)
    assert HandSensing(hand, HardwareConfig()).velocity(state()) is None
    # A first-order filter: after n steps of h at a constant rate, 1 - (T / (T + h))^n of it is seen.
    follow = VelocityFilter(0.02)
    for n in range(6):
        velocity = follow.update(0.01 * n, np.full(12, 0.03 * n, np.float32))
    np.testing.assert_allclose(velocity, 3.0 * (1 - (2 / 3) ** 5), rtol=1e-4)
    np.testing.assert_array_equal(follow.update(0.05, np.zeros(12, np.float32)), velocity)  # No time has passed.


def test_configurations_that_cannot_be():
    with pytest.raises(HandError, match="11 values for 12 joints"):
        HardwareConfig(joint_sign=(1.0,) * 11)
    with pytest.raises(HandError, match="must be 1 or -1"):
        HardwareConfig(joint_sign=(0.5,) * 12)


def test_who_measures_what():
    assert sources_of(GRASP) == {"hand", "camera", "user"}
    assert sources_of(ROTATE) == {"hand", "imu", "policy"}
    with pytest.raises(HandError, match="no sensor measures"):
        sources_of(ROTATE_CRITIC)


# --- IMU -----------------------------------------------------------------------------------------

DATASHEET = bytes.fromhex("AA AA DE 01 00 92 FF 25 08 8D FE EC FF D1 03 00 00 00 E7")


def quat_of(yaw, pitch, roll):
    """Yaw, then pitch, then roll, each about the part's own axis; degrees."""
    quat = IDENTITY
    for axis, angle in (((0, 0, 1), yaw), ((0, 1, 0), pitch), ((1, 0, 0), roll)):
        half = math.radians(angle) / 2
        turn = np.array([math.cos(half), *(math.sin(half) * np.array(axis))])
        quat = np.asarray(rotations.quat_multiply(quat, turn))
    return quat


def apart(a, b):
    """Angle between two orientations, rad, by their matrices."""
    a, b = (np.asarray(rotations.quat_to_matrix(np.asarray(q, np.float32))) for q in (a, b))
    return math.acos(np.clip((np.trace(a.T @ b) - 1) / 2, -1, 1))


def test_the_datasheets_example_message():
    # Yaw 0.01, pitch -1.10, roll 20.85 degrees.
    assert apart(imu.decode(DATASHEET), quat_of(0.01, -1.10, 20.85)) < 1e-3
    bad = bytearray(DATASHEET)
    bad[7] ^= 1
    assert imu.decode(bytes(bad)) is None and imu.decode(DATASHEET[:-1]) is None


@given(st.floats(-180, 180), st.floats(-89, 89), st.floats(-180, 180), st.integers(0, 300))
def test_orientations_survive_the_wire(yaw, pitch, roll, index):
    quat = quat_of(yaw, pitch, roll)
    assert apart(imu.decode(imu.encode(index, quat)), quat) < 2e-3


@settings(max_examples=50)
@given(
    st.lists(st.one_of(st.binary(max_size=30), st.just(b"\xaa"), st.just(DATASHEET[:9])), max_size=20),
    st.integers(1, 40),
)
def test_the_imu_parser_recovers_from_noise(parts, size):
    stream = b"".join(parts) + 4 * DATASHEET
    parser, found = imu.RvcParser(), []
    for at in range(0, len(stream), size):
        found += parser.feed(stream[at : at + size])
        assert len(parser._buffer) <= imu.SIZE + size
    # One in 256 false heads passes the checksum, and then takes the next frame's beginning with it.
    assert len(found) >= 3 and all(apart(quat, imu.decode(DATASHEET)) < 1e-6 for quat in found[-3:])
    if not parts:
        assert len(found) == 4 and parser.damaged == 0


@given(st.floats(-3, 3), st.floats(-0.4, 0.4), st.floats(-3, 3))
def test_alignment_takes_heading_from_the_known_pose_and_tilt_from_gravity(heading, tilt, later):
    """The part's world is the palm's, turned so that z is up and by an unknown heading."""
    up = np.array([math.cos(tilt), 0.0, math.sin(tilt)])
    # palm_from_world: takes z to up, after a turn about z by the heading.
    axis = np.cross([0, 0, 1.0], up)
    axis /= np.linalg.norm(axis)
    half = math.acos(up[2]) / 2
    world = imu.multiply(
        np.array([math.cos(half), *(math.sin(half) * axis)]),
        np.array([math.cos(heading / 2), 0, 0, math.sin(heading / 2)]),
    )
    truth = np.array([1.0, 0, 0, 0])
    found = imu.align(imu.multiply(imu.conjugate(world), truth), truth, up)
    turned = np.array([math.cos(later / 2), *(math.sin(later / 2) * up)])
    sensed = imu.multiply(imu.conjugate(world), turned)
    assert apart(imu.multiply(found, sensed), turned) < 1e-3


def test_the_imu_thread_reads_a_port():
    pytest.importorskip("serial")
    import os
    import tty

    master, slave = os.openpty()
    tty.setraw(slave)
    part = imu.Imu(os.ttyname(slave), np.array([1.0, 0, 0]))  # The part's z points up, along the palm's x.
    with pytest.raises(HandError, match="UART-RVC"):
        part.wait(0.05)
    os.write(master, imu.encode(0, quat_of(40, 0, 0)))
    part.wait()
    part.calibrate(IDENTITY)
    assert apart(part.read()[1], IDENTITY) < 2e-3
    os.write(master, b"\x00\xaa" + imu.encode(1, quat_of(70, 0, 0)))
    until = time.monotonic() + 2
    while apart(part.read()[1], IDENTITY) < 0.1 and time.monotonic() < until:
        time.sleep(0.01)
    # 30 degrees about the part's vertical are 30 degrees about the palm's.
    half = math.radians(15)
    assert apart(part.read()[1], [math.cos(half), math.sin(half), 0, 0]) < 2e-3
    part.close()
    os.close(master)
    os.close(slave)


# --- goals ---------------------------------------------------------------------------------------


def seen(angle, axis=(1.0, 0, 0), place=(0.048, 0.0, 0.085)):
    quat = np.array([math.cos(angle / 2), *(math.sin(angle / 2) * np.array(axis))])
    return ObjectEstimate(np.array(place), np.zeros(3), quat)


@pytest.mark.parametrize("direction", [1, -1])
def test_goals_move_on_as_in_the_task(direction):
    config = RotateConfig(direction=direction)
    goals = TurnGoals(config.turn, config.reference)
    rate, period, turns = 0.8 * direction, 0.03, 0
    for k in range(600):
        wanted = np.asarray(goal_quat(turns, np.asarray(config.axis), direction * config.goal_step))
        np.testing.assert_allclose(goals.quat, wanted, atol=1e-5)
        angle = rate * period * k
        goals.update(period * k, seen(angle))
        # A goal is reached 0.3 rad before it.
        turns = max(turns, math.floor((abs(angle) + config.goal_angle - 1e-9) / config.goal_step))
        assert goals.successes == turns
    assert turns >= 8 and len(goals.times) == turns


def test_a_goal_passed_at_speed_or_far_away_does_not_count():
    config = RotateConfig(goal_spin=2.0)
    fast, far = TurnGoals(config.turn, config.reference), TurnGoals(config.turn, config.reference)
    for k in range(40):
        fast.update(0.03 * k, seen(6.0 * 0.03 * k))
        far.update(0.03 * k, seen(1.0 * 0.03 * k, place=(0.2, 0, 0.085)))
    assert fast.successes == far.successes == 0


# --- camera --------------------------------------------------------------------------------------


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
@given(st.floats(0.0, 0.12), st.floats(-0.3, 0.3), st.floats(-0.2, 0.2))
def test_height_from_a_mask(height, yaw, pitch):
    config = CameraConfig(
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


def test_masks_that_say_nothing():
    config = CameraConfig()
    reference = np.array([0.055, 0, 0.09])
    assert height_of(np.zeros((480, 640), bool), config, reference, 0) is None
    along = CameraConfig(position=(0.5, 0.0, 0.09), forward=(-1.0, 0, 0), down=(0, 0, -1.0))
    assert height_of(picture((0.05, 0, 0.09), along), along, reference, 0) is None
    with pytest.raises(HandError, match="parallel"):
        CameraConfig(forward=(1.0, 0, 0), down=(1.0, 0, 0))
    with pytest.raises(HandError, match="measures one"):
        HeightSensor(lambda: None, config, reference, (True, True, False), 0.5)


def test_velocity_is_filtered_as_in_the_simulation():
    config, reference = CameraConfig(), np.array([0.055, -0.005, 0.09])
    sensor = HeightSensor(lambda: None, config, reference, (True, False, False), 0.5)
    with pytest.raises(HandError, match="has not seen"):
        sensor.read()
    for k in range(8):
        sensor.see(0.03 * k, picture(reference + [0.004 * k, 0, 0], config))
        sensor.see(0.03 * k + 0.01, np.zeros((480, 640), bool))  # Out of sight for a moment.
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
    until = time.monotonic() + 2
    while (not sensor.seen or sensor.read()[0] < 5.0) and time.monotonic() < until:
        time.sleep(0.01)
    when, position, _ = sensor.read()
    assert when == 5.0 and position[0] == pytest.approx(0.055 + 0.04, abs=6e-4)
    sensor.close()
    with pytest.raises(HandError, match="no program sends masks"):
        open_masks(f"unix:{tmp_path}/none", config)


def test_the_colour_threshold():
    cv2 = pytest.importorskip("cv2")
    config = CameraConfig()
    shown = picture((0.06, 0, 0.09), config, radius=30)
    image = np.full((480, 640, 3), 60, np.uint8)
    image[shown] = cv2.cvtColor(np.uint8([[[60, 200, 180]]]), cv2.COLOR_HSV2BGR)[0, 0]
    image[5, 5] = image[shown][0]  # A speck.
    mask = colour_mask(image, config)
    assert not mask[5, 5] and (mask ^ shown).sum() < 0.05 * shown.sum()
    with pytest.raises(HandError, match="cannot be opened"):
        open_masks("/nowhere/film.mp4", config)


def test_quaternions_agree_with_the_library():
    rng = np.random.default_rng(0)
    a, b = rng.normal(size=(2, 4))
    a, b = a / np.linalg.norm(a), b / np.linalg.norm(b)
    np.testing.assert_allclose(imu.multiply(a, b), jax.jit(rotations.quat_multiply)(a, b), atol=1e-6)
