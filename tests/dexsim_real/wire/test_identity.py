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
from dexsim_real.wire.link import Identity, check_identity, read_identity
from dexsim_real.wire.serial_hand import SerialHand

OURS = Identity("2R32A001", "right")


@pytest.mark.parametrize(
    ("serial", "side", "identity"),
    [
        (b"2R32A001" + bytes(24), b"right" + bytes(27), OURS),
        (b"2R32A001", b"L\0", Identity("2R32A001", "left")),
        (b"2L32A001", b"\1\0", Identity("2L32A001", "left")),
        (b"\xff" * 32, b"", Identity()),
    ],
)
def test_what_a_hand_tells(serial, side, identity):
    assert read_identity(serial, side) == identity


def calibration(hand, serial="2R32A001", handedness="right"):
    return dataclasses.replace(ideal_calibration(hand), serial=serial, handedness=handedness)


def test_another_hand_is_refused_in_one_line_and_what_is_unknown_is_told(hand):
    ours, unknown = calibration(hand), calibration(hand, "", "")
    for identity, known, says in (
        (Identity("2R32B002", "right"), ours, "this is hand 2R32B002, the calibration is of hand 2R32A001"),
        (Identity(), ours, "does not tell its serial number, the calibration is of hand 2R32A001"),
        (Identity("2L32A001", "left"), None, "this is a left hand .* the model a right one"),
    ):
        with pytest.raises(HandError, match=f"{says}[^\n]*$"):
            check_identity(identity, hand, known)
    assert check_identity(OURS, hand, ours) == check_identity(OURS, hand, None) == []
    assert "names no serial number" in check_identity(OURS, hand, unknown)[0]
    for known in (None, unknown):
        (note,) = check_identity(Identity(), hand, known)
        assert "does not tell its serial number" in note
    assert "code 1" in check_identity(Identity("A001", "code 1"), hand, None)[0]


@pytest.mark.parametrize(
    ("back", "says"),
    [(b"2R32A001", ""), (b"2R32B002", "2R32B002, not right, serial number 2R32A001"), (None, "unknown")],
)
def test_after_a_reconnection_only_the_same_hand_is_driven(hand, back, says):
    """Cable out while the motors are on; what comes back may be another hand, or not tell. Both end the run."""
    peer = PtyHand(registers={20: b"right", 21: b"2R32A001"})
    peer.state["joint"]["position"] = np.array([0.1] * 3 + [0.0] + [0.1] * 8)
    peer.open()
    port, safety = SerialHand(peer.port, QUICK), Safety(hand, SafetyConfig())
    loop = LoopThread(port, HandSensing(hand, HardwareConfig()), safety, 83.0)
    port.connect()
    for _ in range(10):  # A pose needs as many.
        loop.cycle()
    safety.engage()
    loop.cycle()
    assert np.all(peer.commands[-1]["mode"] == Mode.POSITION)
    peer.close()
    loop.cycle()
    peer.commands.clear()
    peer.registers = {20: b"right", 21: back} if back else {}
    peer.open()
    until = time.monotonic() + 20
    while time.monotonic() < until and not (safety.latched or any(np.any(c["mode"]) for c in peer.commands)):
        loop.cycle()
    driven = any(np.any(command["mode"] != Mode.PASSIVE) for command in peer.commands)
    port.close()
    peer.close()
    assert driven == (not says) and len(peer.commands) > 1
    assert not says or ("another hand is on" in safety.latched and says in safety.latched)
