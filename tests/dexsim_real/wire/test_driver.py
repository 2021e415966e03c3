"""Drivers of other hands: what their states become, what such a hand cannot do; Dynamixel motors on an emulated bus."""

import contextlib
import dataclasses

import dynamixel_bus
import jax
import numpy as np
import pytest
from dynamixel_bus import DynamixelBus, status
from random_readings import random_readings
from scripted_driver import DriverBench, ScriptedDriver
from untrained import untrained

from dexsim.observation import FIELDS, ObservationConfig, observe
from dexsim_real.control.controller import NEEDS, Controller
from dexsim_real.control.safety import Reaction
from dexsim_real.core.errors import HandError
from dexsim_real.sensors.hand import HandSensing, HardwareConfig
from dexsim_real.wire.driver import WITHOUT, DriverPort, JointTargets
from dexsim_real.wire.dynamixel import DynamixelHand, crc16, packet
from dexsim_real.wire.frames import Mode
from dexsim_real.wire.link import LinkConfig


def off(hand):
    return HandSensing(hand, HardwareConfig()).command(np.zeros(hand.num_joints), Mode.PASSIVE)


def opened(hand, driver):
    port = DriverPort(driver, hand, LinkConfig(backoff=(0.001, 0.002)))
    port.connect()
    return port


def test_a_state_arrives_in_si_units_and_a_command_leaves_in_them(leap):
    driver, rng = ScriptedDriver(leap), np.random.default_rng(0)
    state = {
        "position": rng.uniform(-0.3, 1.0, 16),
        "current": rng.uniform(-1, 1, 16),
        "temperature": rng.integers(20, 90, 16).astype(float),
        "taxel_force": rng.uniform(0.2, 2.0, (4, 48)),
        "errors": np.array([*range(13), 0x10000, 0x20000001, -1]),
    }
    driver.set(**state)
    config = HardwareConfig(joint_sign=(-1.0,) * 16, joint_offset=(0.2,), kp=(600,), kd=(200,), torque_max=350)
    sensing, port = HandSensing(leap, config), opened(leap, driver)
    target = rng.uniform(-0.2, 0.5, 16)
    reply = port.exchange(sensing.command(target, Mode.POSITION, stiffness=0.5))
    measured = sensing.measure(reply.state)
    np.testing.assert_allclose(measured.joint_position, 0.2 - state["position"], atol=1e-6)
    np.testing.assert_allclose(measured.current, np.abs(state["current"]), rtol=1e-6)
    np.testing.assert_allclose(measured.joint_torque, -state["current"], rtol=1e-6)  # The default scale: 1 A is 1.
    np.testing.assert_array_equal(measured.temperature, [*state["temperature"], 0, 0, 0, 0, 0])
    np.testing.assert_allclose(measured.taxel_force, state["taxel_force"], rtol=1e-6)
    # A status word of 32 bits, whose lower sixteen would read as no error.
    np.testing.assert_array_equal(measured.errors, [[0, bits, 0] for bits in (*range(13), *[0xFFFF] * 3)])
    assert np.all(measured.mode == Mode.POSITION)
    (sent,) = driver.sent
    np.testing.assert_allclose(sent.position, 0.2 - target, atol=1e-6)
    assert sent.on and np.all(sent.kp == 300) and np.all(sent.kd == 200) and sent.current == pytest.approx(0.35)
    np.testing.assert_array_equal(sensing.decode(reply.state.tobytes()), reply.state)
    with pytest.raises(HandError, match="HardwareConfig.kp: 3 values for 16 joints"):
        HandSensing(leap, HardwareConfig(kp=(1, 2, 3)))


@pytest.mark.parametrize(
    ("values", "says"),
    [
        ({"position": np.zeros(15)}, r"position has the shape \[15\], expected \[16\]"),
        ({"taxel_force": None}, r"taxel_force has the shape \[\], expected \[4, 48\]"),
        ({"temperature": np.where(np.arange(16) == 3, np.nan, 30.0)}, "temperature is not finite"),
    ],
)
def test_a_state_that_does_not_keep_the_promise_is_refused(leap, values, says):
    """A current that is said to be measured and is not would silently be no over-current."""
    driver = ScriptedDriver(leap)
    driver.set(**values)
    with pytest.raises(HandError, match=f"the driver's {says}"):
        opened(leap, driver).exchange(off(leap))


def test_a_line_that_fails_is_connected_again_with_the_motors_off(leap):
    driver, now = ScriptedDriver(leap), [0.0]
    port = opened(leap, driver)
    port._clock = lambda: now[0]
    on = HandSensing(leap, HardwareConfig()).command(np.zeros(16), Mode.POSITION)
    assert port.exchange(on).generation == 1
    driver.failing = True
    for time, attempts in ((0.0, 1), (0.0009, 1), (0.0011, 2), (0.003, 2), (0.0032, 3), (0.005, 3), (0.0053, 4)):
        now[0] = time  # Waits of 1 ms, then of 2 ms.
        assert port.exchange(on) is None and driver.calls.count("connect") == attempts
    assert port.counts.lost == 1
    now[0], driver.failing = 1.0, False
    driver.sent.clear()
    driver.read, read = lambda: None, driver.read
    while len(driver.sent) < 5:  # It is back, and does not answer yet.
        assert port.exchange(on) is None
    driver.read = read
    while (reply := port.exchange(on)) is None:
        pass
    assert not any(targets.on for targets in driver.sent)
    assert reply.generation == 2 and port.counts.reconnects == 1
    assert port.exchange(on).generation == 2 and driver.sent[-1].on


def test_motors_count_as_off_only_when_the_hand_says_so(leap):
    driver = ScriptedDriver(leap)
    port = opened(leap, driver)
    deaf = lambda targets: driver.set(on=np.arange(16) == 3)  # noqa: E731
    driver.send, heard = deaf, driver.send
    assert not port.turn_off(off(leap), 0.02) and "told to go off" in port.refusal.text
    driver.send = heard
    assert port.turn_off(off(leap), 0.02)


TOUCH = ("joint_torque", "contact_force", "contact_centre")


@pytest.mark.parametrize(
    ("measures", "observation", "says"),
    [
        (["currents"], {}, "observes 'contact_force', and the hand has no taxels"),
        ([], {"leave_out": TOUCH}, "corrects its command by the measured"),
        ([], {"leave_out": TOUCH, "force_loop": False}, ""),
    ],
)
def test_a_policy_that_observes_what_the_hand_cannot_measure_is_refused(leap, measures, observation, says):
    controller, missing = Controller(untrained(leap, **observation), leap), set(WITHOUT) - set(measures)
    with pytest.raises(HandError, match=says) if says else contextlib.nullcontext():
        controller.check_measured(missing)


def test_the_fields_that_depend_on_touch_and_current_are_those_of_the_table(hand):
    """By what `observe` does with other forces and torques, so that no new field can be forgotten."""
    given, other = random_readings(hand, 0), random_readings(hand, 1)
    others = {"currents": {"joint_torque": other.joint_torque}, "taxels": {"taxel_force": other.taxel_force}}
    names = [name for name, field in FIELDS.items() if field.source != "simulator"]
    seen = jax.jit(lambda readings: {name: observe(hand, readings, (name,), ObservationConfig()) for name in names})
    before = seen(given)
    changed = {what: seen(dataclasses.replace(given, **values)) for what, values in others.items()}
    for name in names:
        depends = {what for what, after in changed.items() if not np.array_equal(before[name], after[name])}
        assert depends == set(NEEDS.get(name, ())), name


@pytest.mark.parametrize("measures", [tuple(WITHOUT), ()])
def test_without_currents_no_joint_counts_as_deaf_or_stalled(leap, measures):
    """A finger that stands far from its target: it draws nothing where that is measured, and may press otherwise."""
    driver = ScriptedDriver(leap, measures)
    bench, joints = DriverBench(leap, driver), np.arange(16)
    target = driver.state.position + 0.5 * (joints == 6)
    bench.engage()
    # The other joints move, so the angles are not frozen.
    sway = lambda: driver.set(position=driver.state.position + 1e-3 * (joints == 0) * (-1) ** len(driver.sent))  # noqa: E731
    bench.run(5.8, target, sway)
    safety = bench.safety
    assert bool(safety.latched) == bool(measures) and ("does not follow" in safety.latched) == bool(measures)
    assert measures or safety.last[0] <= Reaction.CLIP


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
    assert packet(1, 3, b"\xff\xff\xfd")[7:-2] == bytes.fromhex("03 ff ff fd fd"), "no header in a content"
    assert crc16(b"123456789") == dynamixel_bus.crc(b"123456789") == 0xFEE8


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


def test_the_bridge_over_the_bus_reaches_a_target_and_stops_at_a_motor_that_shuts_down(leap, bus, driver):
    bench = DriverBench(leap, driver, kp=(600,), kd=(200,), current_sign=1.0)
    safety, goal = bench.safety, np.clip(0.4, leap.joint_lower, leap.joint_upper) - 0.05
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
