"""The left hand on the bridge: shipped policies of the right one on an emulated left hand, in virtual time."""

from types import SimpleNamespace

import numpy as np
import pytest

from dexsim.hand.load import load_hand
from dexsim_ppo.policy import load_policy
from dexsim_real.calibrate.plan import placements
from dexsim_real.core.errors import HandError
from dexsim_real.twin.plant.emulated_hand import EmulatedHand
from dexsim_real.twin.virtual import VirtualRun, ideal_calibration
from dexsim_real.twin.wire.firmware import Firmware
from dexsim_real.wire.frames import HOST, Command, Frame, palm_address
from dexsim_real.wire.identity import SERIAL_NUMBER, SIDE, check_identity, read_identity


@pytest.fixture(scope="module")
def left():
    return load_hand("xhand_left")


def test_the_shipped_grasp_holds_on_the_left_hand(left, controller_of):
    plant = EmulatedHand(left, "grasp", 0, kind="nominal", trials=1, seconds=2.0)
    report = VirtualRun(plant, controller_of(load_policy("grasp"), left), ideal_calibration(left)).run()
    assert report["held"] and report["finger_force"] > 0.5 and report["bridge"]["latched"] == ""


def test_each_hand_tells_its_side_and_is_refused_with_the_model_of_the_other(hand, left):
    for one, other in ((hand, left), (left, hand)):
        board, contents = Firmware(SimpleNamespace(hand=one)), []
        for register in (SERIAL_NUMBER, SIDE):
            ask = Frame(HOST, palm_address(0), Command.READ_REGISTER, register.to_bytes(2, "little"))
            contents.append(board.answer(ask).data[2:])
        told = read_identity(*contents)
        assert check_identity(told, one) == []
        with pytest.raises(HandError, match=f"this is a {one.side} hand .* the model a {other.side} one: see --hand"):
            check_identity(told, other)


def test_the_left_hand_is_calibrated_by_the_same_presses(hand, left):
    for one, other in zip(placements(hand), placements(left), strict=True):
        assert (one.name, one.joints, one.task) == (other.name, other.joints, other.task)
        np.testing.assert_array_equal(other.posture, one.posture)
        np.testing.assert_allclose(other.direction, one.direction, atol=1e-5)
