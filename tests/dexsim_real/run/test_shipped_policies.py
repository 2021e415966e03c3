"""Shipped policies on the emulated hand in virtual time, through the exchange loop, safety and sensors of a run."""

import functools

import pytest

from dexsim_ppo.policy import load_policy
from dexsim_real.control.controller import Controller
from dexsim_real.twin.plant.emulated_hand import EmulatedHand
from dexsim_real.twin.virtual import VirtualRun, ideal_calibration


@functools.cache
def controller(hand, name):
    made = Controller(load_policy(name), hand)
    made.warm()
    return made


def trial(hand, name, seconds, command=0.5, shape="sphere"):
    """The referee's report of one trial on a nominal hand."""
    policy = controller(hand, name)
    plant = EmulatedHand(hand, policy.policy.task, 1, kind="nominal", seconds=seconds, trials=1, shape=shape)
    report = VirtualRun(plant, policy, ideal_calibration(hand), command).run()
    assert report["bridge"]["latched"] == "", report
    return report


def test_the_grasp_holds_and_presses_as_asked(hand):
    """Force is judged in the second half."""
    weak, strong = (trial(hand, "grasp", 3.0, command) for command in (0.0, 1.0))
    assert weak["held"] and strong["held"]
    assert strong["finger_force"] > weak["finger_force"] + 1.5, (weak["finger_force"], strong["finger_force"])


@pytest.mark.parametrize("name", ["rotate", "rotate_without_orientation"])
def test_a_rotation_policy_turns_the_cube(hand, name):
    """Two quarter turns at least and no drop, by the referee and by the bridge's own count, which needs the IMU.

    `rotate_clear` is for another mount than the emulated hand's.
    """
    report = trial(hand, name, 4.0)
    assert not report["fell"] and report["successes"] >= 2, report
    if name == "rotate":
        assert report["bridge"]["successes"] >= 2, report
