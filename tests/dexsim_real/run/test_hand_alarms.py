"""Runs with a hand that raises an alarm, or is another one: they end with the motors off and its line."""

import dataclasses

import pytest

pytest.importorskip("serial")
from following_hand import FollowingHand, arguments, summary

from dexsim.calibration.maps import save_calibration
from dexsim_real.core.errors import HandError
from dexsim_real.run import __main__ as run
from dexsim_real.twin.virtual import ideal_calibration
from dexsim_real.wire.frames import Command, Frame

pytestmark = pytest.mark.usefixtures("jax_as_it_is")

HOT = Frame(0x80, 0xFE, Command.ERROR, (1501028).to_bytes(4, "little")).encode()


def calibrated(peer, folder, hand, serial):
    path = folder / "hand.toml"
    save_calibration(path, dataclasses.replace(ideal_calibration(hand), serial=serial, handedness="right"))
    words = arguments(peer, folder, "--seconds", "0.3", "--calibration", str(path))
    return [word for word in words if word != "--uncalibrated"]


def test_a_calibration_of_another_hand_is_refused_before_anything_moves(hand, tmp_path):
    with FollowingHand() as peer:
        with pytest.raises(HandError, match="this is hand 2R32SCRIPTED, the calibration is of hand 2R32OTHER"):
            run.main(calibrated(peer, tmp_path, hand, "2R32OTHER"))
        assert not peer.on().any()
        (tmp_path / "run.log").unlink()
        assert run.main(calibrated(peer, tmp_path, hand, "2R32SCRIPTED")) == 0
        assert peer.on().any()


def error_bit(index, state):
    if index > 80:
        state["joint"]["joint_error"][8] = 4


def test_an_alarm_ends_the_run_with_its_line_and_the_motors_off(tmp_path):
    with FollowingHand(error_bit) as peer:
        assert run.main(arguments(peer, tmp_path, "--seconds", "20")) == 1
        on = peer.on()
    assert on.any() and not on[-1]
    assert summary(tmp_path)["end"] == "stopped: error bits 0x0004 of the joint board, joint ring_joint1 (ring)"


@pytest.mark.parametrize("first", [0, 10])
def test_over_temperature_is_not_taken_for_a_bad_cable(tmp_path, first):
    """From the start, and while the taxels are tared."""
    with FollowingHand(lambda index, state: HOT if index >= first else None) as peer:
        with pytest.raises(HandError, match=r"over-temperature \(1501028\)") as found:
            run.main(arguments(peer, tmp_path, "--link.handshake", "0.1"))
        assert "cable" not in str(found.value) and not peer.on().any()
