"""From the hand's counts to SI units: signs, scales, tare, and what measures each field."""

import dataclasses

import numpy as np
import pytest

from dexsim.observation import GRASP, ROTATE, ROTATE_CRITIC
from dexsim_real.control.controller import sources_of
from dexsim_real.core.errors import HandError
from dexsim_real.sensors.hand import HandSensing, HardwareConfig, VelocityFilter
from dexsim_real.twin.virtual import ideal_calibration
from dexsim_real.wire import frames
from dexsim_real.wire.frames import Mode


def state(**joint):
    block = frames.empty_state()
    for name, value in joint.items():
        block["joint"][name] = value
    return block


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
    sensing = HandSensing(hand, HardwareConfig(force_per_count=0.1, taxel_floor=1.0, tare_sum=1000.0))
    rest = state()
    rest["tip"]["taxel"]["z"] = np.arange(120) % 7
    other = rest.copy()
    other["tip"]["taxel"]["z"] += 2
    sensing.set_tare([rest, other])  # Mean: 1 above rest.
    pressed = rest.copy()
    pressed["tip"]["taxel"]["z"][2, 17] += 31
    pressed["tip"]["taxel"]["x"][2, 17] = -100  # Does not count with "z".
    force = sensing.measure(pressed).taxel_force
    expected = np.zeros((5, 120))
    expected[2, 17] = 3.0
    np.testing.assert_allclose(force, expected, atol=1e-6)
    np.testing.assert_allclose(sensing.measure(pressed).finger_force, expected.sum(1), atol=1e-6)
    norm = HandSensing(hand, HardwareConfig(taxel_axes="norm"))
    block = state()
    block["tip"]["taxel"][4, 119] = (-3, 4, 12)
    assert norm.measure(block).taxel_force[4, 119] == pytest.approx(1.3)


def test_current_without_and_with_a_calibration(hand):
    counts = np.linspace(-900, 900, 12).astype(np.int16)
    plain = HandSensing(hand, HardwareConfig(current_sign=-1.0, current_scale=1500.0))
    np.testing.assert_allclose(plain.measure(state(current=counts)).joint_torque, counts / -1500.0, atol=1e-6)
    np.testing.assert_allclose(plain.measure(state(current=counts)).current, np.abs(counts) / 1000.0, atol=1e-6)

    # current = -0.05 F - 0.02 A and torque = 0.04 F Nm, so torque = -0.8 (current + 0.02).
    calibration, pair = ideal_calibration(hand), np.ones((2, 12))
    real = dataclasses.replace(calibration.real, gain=-0.05 * pair, offset=-0.02 * pair)
    sim = dataclasses.replace(calibration.sim, gain=0.04 * pair)
    calibration = dataclasses.replace(calibration, real=real, sim=sim, force_per_count=np.full(5, 0.2))
    sensing = HandSensing(hand, HardwareConfig(), calibration)
    block = state(current=counts)
    block["tip"]["taxel"]["z"][0, 0] = 10
    measured = sensing.measure(block)
    np.testing.assert_allclose(measured.joint_torque, -0.8 * (counts / 1000 + 0.02) / hand.torque_limit, atol=2e-6)
    assert measured.taxel_force[0, 0] == pytest.approx(2.0)


def test_temperatures_and_error_bits_are_of_the_right_boards(hand):
    """Error bits from bytes: in a joint's 24 they are at 12, 14 and 16, of palm, joint and tip."""
    block = state(temperature=(41 << 8) | 56)
    block["tip"]["temperature"] = 33
    data = bytearray(block.tobytes())
    for joint in range(12):
        for board in range(3):
            data[24 * joint + 12 + 2 * board] = 16 * board + joint + 1
    measured = HandSensing(hand, HardwareConfig()).measure(frames.decode_state(bytes(data)))
    np.testing.assert_array_equal(measured.temperature, [56] * 12 + [33] * 5 + [41])
    np.testing.assert_array_equal(measured.errors, np.arange(1, 13)[:, None] + 16 * np.arange(3))


def test_velocity_from_differences():
    # A first-order filter: after n steps of h at a constant rate, 1 - (T / (T + h))^n of it is seen.
    follow = VelocityFilter(12)
    for n in range(6):
        velocity = follow.update(0.01 * n, np.full(12, 0.03 * n, np.float32))
    np.testing.assert_allclose(velocity, 3.0 * (1 - (2 / 3) ** 5), rtol=1e-4)
    np.testing.assert_array_equal(follow.update(0.05, np.zeros(12, np.float32)), velocity)  # No time has passed.


def test_who_measures_what():
    assert sources_of(GRASP) == {"hand", "camera", "user"}
    assert sources_of(ROTATE) == {"hand", "imu", "policy"}
    with pytest.raises(HandError, match="no sensor measures"):
        sources_of(ROTATE_CRITIC)
