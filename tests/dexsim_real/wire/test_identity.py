"""Whose hand it is: read at start, compared with model and calibration, and again after a reconnection."""

import dataclasses
import time

import numpy as np
import pytest
from pty_hand import QUICK, PtyHand

pytest.importorskip("serial")

from dexsim_real.control.limits import SafetyConfig
from dexsim_real.control.safety import Safety
from dexsim_real.core.errors import HandError
from dexsim_real.loop import LoopThread
from dexsim_real.sensors.hand import HandSensing, HardwareConfig
from dexsim_real.twin.virtual import ideal_calibration
from dexsim_real.wire.frames import Mode
from dexsim_real.wire.identity import Identity, check_identity, read_identity
from dexsim_real.wire.serial_hand import SerialHand

OURS = Identity("2R32A001", "right")


@pytest.mark.parametrize(
    ("serial", "side", "found"),
    [
        (b"2R32A001" + bytes(24), b"right" + bytes(27), OURS),
        (b"2R32A001", None, OURS),
        (b"2R32A001", b"L\0", Identity("2R32A001", "left")),
        (b"2L32A001", b"\1\0", Identity("2L32A001", "left")),
        (b"A001", b"\1" + bytes(31), Identity("A001", "code 1")),
        (None, b"R", Identity("", "right")),
        (b"\xff" * 32, None, Identity()),
        (None, None, Identity()),
    ],
)
def test_what_a_hand_tells(serial, side, found):
    assert read_identity(serial, side) == found


def calibration(hand, serial="2R32A001", handedness="right"):
    return dataclasses.replace(ideal_calibration(hand), serial=serial, handedness=handedness)


@pytest.mark.parametrize(
    ("identity", "known", "says"),
    [
        (
            Identity("2R32B002", "right"),
            ("2R32A001", "right"),
            "this is hand 2R32B002, the calibration is of hand 2R32A001",
        ),
        (None, ("2R32A001", "right"), "does not tell its serial number, and the calibration is of hand 2R32A001"),
        (Identity("2L32A001", "left"), None, "this is a left hand .* the model a right one"),
        ("2R32A001", None, "the driver's `identity` is '2R32A001'; expected an `Identity`"),
        (Identity("2L32A001", "Left"), None, "has handedness 'Left'; expected 'left', 'right' or ''"),
        (Identity(1001, "right"), ("1001", "right"), "has serial_number 1001; expected text"),
        (Identity("A001", None), None, "has handedness None; expected text"),
        (Identity("A001", "code 1"), ("A001", "right"), "this hand is code 1, the calibration is of a right one"),
    ],
)
def test_another_hand_is_refused_in_one_line(hand, identity, known, says):
    with pytest.raises(HandError, match=says) as found:
        check_identity(identity, hand, calibration(hand, *known) if known else None)
    assert "\n" not in str(found.value)


def test_the_hand_of_the_calibration_passes_and_what_is_unknown_is_told(hand):
    assert check_identity(OURS, hand, calibration(hand)) == []
    assert check_identity(OURS, hand, None) == []
    (note,) = check_identity(OURS, hand, calibration(hand, "", ""))
    assert "names no serial number" in note
    for known in (None, calibration(hand, "", "")):
        (note,) = check_identity(None, hand, known)
        assert "does not tell its serial number" in note
    assert "code 1" in check_identity(Identity("A001", "code 1"), hand, None)[0]


def test_the_driver_asks_at_start():
    with PtyHand(registers={20: b"right", 21: b"2R32A001"}) as peer:
        port = SerialHand(peer.port, QUICK)
        assert "right, serial number 2R32A001" in port.connect() and port.identity == OURS
        port.close()
    with PtyHand(registers={}) as peer:
        port = SerialHand(peer.port, QUICK)
        assert "serial number unknown" in port.connect() and port.identity == Identity()
        port.close()


@pytest.mark.parametrize("same", [True, False])
def test_after_a_reconnection_only_the_same_hand_is_driven(hand, same):
    """Cable out while the motors are on; what comes back may be another hand, which must stay off."""
    peer = PtyHand(registers={20: b"right", 21: b"2R32A001"})
    peer.state["joint"]["position"] = np.array([0.1] * 3 + [0.0] + [0.1] * 8)
    peer.open()
    port, safety = SerialHand(peer.port, QUICK), Safety(hand, SafetyConfig())
    servo = LoopThread(port, HandSensing(hand, HardwareConfig()), safety, 83.0)
    port.connect()
    for _ in range(10):  # A pose needs as many.
        servo.cycle()
    safety.engage()
    servo.cycle()
    assert np.all(peer.commands[-1]["mode"] == Mode.POSITION)
    peer.close()
    servo.cycle()
    peer.commands.clear()
    peer.registers[21] = b"2R32A001" if same else b"2R32B002"
    peer.open()
    until = time.monotonic() + 3
    while time.monotonic() < until and not (safety.latched or any(np.any(c["mode"]) for c in peer.commands)):
        servo.cycle()
    driven = any(np.any(command["mode"] != Mode.PASSIVE) for command in peer.commands)
    port.close()
    peer.close()
    assert driven == same and len(peer.commands) > 1
    if not same:
        assert (
            "another hand is on" in safety.latched and "2R32B002, not right, serial number 2R32A001" in safety.latched
        )
