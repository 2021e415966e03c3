"""Shipped policies on the emulated hand in virtual time, through the exchange loop, safety and sensors of a run."""

import pytest

from dexsim_ppo.policy import load_policy
from dexsim_real.twin.plant.emulated_hand import EmulatedHand
from dexsim_real.twin.virtual import VirtualRun


@pytest.fixture
def trial(hand, controller_of, monkeypatch):
    """The referee's report of one trial on a nominal hand, which comes to its start posture twice as fast."""
    monkeypatch.setattr("dexsim_real.twin.virtual._APPROACH", 1.0)

    def trial(name, seconds, command=0.5, hand=hand):
        controller = controller_of(load_policy(name), hand)
        controller.warm()
        task = name if name == "rotate_clear" else controller.policy.task  # its mount is another
        plant = EmulatedHand(hand, task, 1, kind="nominal", seconds=seconds, trials=1, shape_name="sphere")
        run = VirtualRun(plant, controller, command)
        list(run.ticking())
        report = run.report()
        assert report["bridge"]["latched"] == "", report
        return report

    return trial


def test_the_grasp_holds_and_presses_as_asked(trial):
    """Force is judged in the second half."""
    weak, strong = (trial("grasp", 2.5, command) for command in (0.0, 1.0))
    assert weak["held"] and strong["held"]
    assert strong["finger_force"] > weak["finger_force"] + 1.5, (weak["finger_force"], strong["finger_force"])


def test_the_shipped_grasp_of_the_right_hand_holds_on_the_left_one(trial, left):
    report = trial("grasp", 1.5, hand=left)
    assert report["held"] and report["finger_force"] > 0.5


@pytest.mark.parametrize("name", ["rotate", "rotate_without_orientation", "rotate_clear"])
def test_a_rotation_policy_turns_the_cube(trial, name):
    """Two quarter turns at least and no drop, by the referee and by the bridge's own count, which needs the IMU."""
    report = trial(name, 4.0)
    assert not report["fell"] and report["successes"] >= 2, report
    if name != "rotate_without_orientation":
        assert report["bridge"]["successes"] >= 2, report
