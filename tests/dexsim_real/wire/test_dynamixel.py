"""The driver of Dynamixel hands against an emulated bus and the packets that the e-manual prints."""

import numpy as np
import pytest
from hypothesis import given, strategies as st

pytest.importorskip("serial")
import dynamixel_bus
from driver_bench import DriverBench
from dynamixel_bus import DynamixelBus, status

from dexsim import load_hand
from dexsim_real.core.errors import HandError
from dexsim_real.wire.driver import JointTargets
from dexsim_real.wire.dynamixel import DynamixelHand, crc16, make_parser, packet

IDS = [12, 13, 14, 15, 1, 0, 2, 3, 5, 4, 6, 7, 9, 8, 10, 11]
TICK = 2 * np.pi / 4096


@pytest.fixture
def bus():
    bus = DynamixelBus(IDS)
    yield bus
    bus.close()


@pytest.fixture
def driver(bus, monkeypatch):
    # A busy machine may take long to wake the emulated bus; only a test of silence waits for it.
    monkeypatch.setattr("dexsim_real.wire.dynamixel._MARGIN", 0.3)
    driver = DynamixelHand(bus.port, IDS)
    yield driver
    driver.close()


def targets(position=0.0, on=True, kp=600.0, current=0.3):
    full = np.full(16, kp)
    return JointTargets(np.full(16, position), on, full, 0 * full, full / 3, np.full(16, current))


def test_packets_are_those_of_the_manual():
    """Ping, read of 4 bytes at 132, sync read of two motors; and the standard check value of this CRC."""
    assert packet(1, 1, b"") == bytes.fromhex("ff ff fd 00 01 03 00 01 19 4e")
    assert packet(1, 2, bytes([0x84, 0, 4, 0])) == bytes.fromhex("ff ff fd 00 01 07 00 02 84 00 04 00 1d 15")
    read = bytes([0x84, 0, 4, 0, 1, 2])
    assert packet(0xFE, 0x82, read) == bytes.fromhex("ff ff fd 00 fe 09 00 82 84 00 04 00 01 02 ce fa")
    assert crc16(b"123456789") == dynamixel_bus.crc(b"123456789") == 0xFEE8


@given(
    st.lists(st.lists(st.sampled_from([0xFF, 0xFD, 0x00, 0x55, 7]), max_size=24).map(bytes), max_size=4),
    st.binary(max_size=9).map(lambda noise: noise.replace(b"\xff", b"")),
    st.integers(1, 9),
)
def test_answers_are_found_between_noise_in_pieces_of_any_size(contents, noise, size):
    """Contents full of halves of headers; the answers were stuffed by other code."""
    stream, parser, found = b"".join(noise + status(3, 0, data) for data in contents), make_parser(), []
    for at in range(0, len(stream), size):
        found += parser.feed(stream[at : at + size])
    assert [answer.data for answer in found] == contents


def test_motors_are_set_up_once_and_come_on_with_a_target(bus, driver):
    bus.table[5][64] = 1  # left on by another program
    assert "16 Dynamixel motors" in driver.connect()
    assert all(table[64] == 0 and table[9] == 0 and table[11] == 5 for table in bus.table.values())
    driver.send(targets(position=0.5, current=2.0))
    driver.read()
    order = [address for motor, address, _ in bus.writes if motor == 7][-4:]
    assert order == [80, 102, 116, 64], "gains, current and goal before the torque"
    assert bus.get(7, 84, 2) == 600 and bus.get(7, 80, 2) == 200
    assert bus.get(7, 102, 2) == 1750, "the motor's own limit: a higher goal would be refused in silence"
    assert bus.get(7, 116, 4) == 2048 + round(0.5 / TICK)
    bus.writes.clear()
    driver.send(targets(position=0.6, current=2.0))
    assert driver.read() is not None and {address for _, address, _ in bus.writes} == {116}
    before = len(bus.writes)
    driver.connect()
    assert not any(address in (9, 11) for _, address, _ in bus.writes[before:]), "settings wear out the memory"


def test_a_state_has_the_order_of_the_joints_and_si_units(bus, driver):
    driver.connect()
    for joint, motor in enumerate(IDS):
        bus.put(motor, 132, 4, 2048 + 100 * joint - 300)
        bus.put(motor, 126, 2, -1)  # FF FF, and with the FD of the velocity what must be stuffed
        bus.put(motor, 128, 4, 0xFD)
        bus.table[motor][146] = 30 + joint
    bus.echo = True
    state = driver.read()
    np.testing.assert_allclose(state.position, (100 * np.arange(16) - 300) * TICK)
    np.testing.assert_allclose(state.current, -0.001)
    np.testing.assert_array_equal(state.temperature, 30 + np.arange(16))
    assert not state.on.any() and not state.errors.any()


def test_no_state_without_the_whole_answer_of_every_motor(bus, driver, monkeypatch):
    driver.connect()
    driver.send(targets())
    assert driver.read() is not None
    monkeypatch.setattr("dexsim_real.wire.dynamixel._MARGIN", 0.05)
    for spoil in (
        lambda motor, data: data[:-1] + bytes([data[-1] ^ 1]) if motor == 4 else data,
        lambda motor, data: data[:-3] if motor == 4 else data,
        lambda motor, data: b"" if motor == 11 else data,
        lambda motor, data: status(motor, 4, b"") if motor == 0 else data,  # a data range error
    ):
        bus.spoil = spoil
        assert driver.read() is None
    bus.spoil = lambda motor, data: b"\xff\xff\xfd\x00\x01" + data if motor == 2 else data
    monkeypatch.setattr("dexsim_real.wire.dynamixel._MARGIN", 0.3)
    assert driver.read() is not None, "noise before an answer"
    bus.silent = {3, 8}
    driver.close()
    monkeypatch.setattr("dexsim_real.wire.dynamixel._MARGIN", 0.05)
    with pytest.raises(HandError, match="no answer of the motors 3, 8; check .* baud rate"):
        driver.connect()


@pytest.mark.parametrize("ids", [[1, 1, 2], [0, 253]])
def test_ids_that_no_bus_can_have_are_refused(ids):
    with pytest.raises(HandError, match="different numbers from 0 to 252"):
        DynamixelHand("/dev/null", ids)


def test_the_bridge_over_the_bus_reaches_a_target_and_stops_at_a_motor_that_shuts_down(bus, driver):
    hand = load_hand("leap_like")
    bench = DriverBench(hand, driver, kp=(600,), kd=(200,), current_sign=1.0)
    safety, goal = bench.safety, np.clip(0.4, hand.joint_lower, hand.joint_upper) - 0.05
    bench.engage()
    bench.run(0.1, goal)
    assert 0 < bus.get(12, 84, 2) < 600, "stiffness grows"
    bench.run(1.8, goal)
    assert bus.get(12, 84, 2) == 600
    np.testing.assert_allclose(safety.sample.measured.joint_position, goal, atol=0.04)
    bus.table[6][70] = 0x20  # overload: the motor shuts down, and its answers have the alert bit
    bus.table[6][64] = 0
    bench.run(0.5, goal)
    assert "error bits 0x0020" in safety.latched and "joint middle_pip" in safety.latched
    assert not any(table[64] for table in bus.table.values())
    bench.loop.close()
    assert not bench.loop.driven
