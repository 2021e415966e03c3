"""How far a joint can have moved between two readings: everything farther is wrong, everything nearer is not."""

import numpy as np
import pytest

from dexsim_real.control.pose_check import PoseCheck

CYCLE = 0.012
JOINT, START = 4, 0.9  # index_joint1, in the middle of its range
UP, DOWN = 1.0, -1.0


@pytest.fixture
def check(hand):
    """Knows the pose, motors on where the hand is. The newest reading is of time 0."""
    check = PoseCheck(hand, 0.1)
    for k in range(-2, 1):
        check.judge(k * CYCLE, pose(), None)
    assert check.known
    check.follow(pose())
    return check


def pose(angle=START):
    position = np.array([0.9, 0.4, 0.8, 0.0] + [START] * 8)
    position[JOINT] = angle
    return position


def fastest(hand):
    """rad/s"""
    return 1.25 * float(hand.speed_limit[JOINT])


@pytest.mark.parametrize("way", [UP, DOWN])
@pytest.mark.parametrize("gap", [CYCLE, 0.03, 0.5])
def test_away_from_its_commands_a_joint_moves_for_30_ms_at_most(hand, check, way, gap):
    """However long nothing was read: with the motors on nothing carries it farther."""
    room = 0.1 + fastest(hand) * min(gap, 0.03)
    assert "index_joint1 reads" in check.judge(gap, pose(START + way * (room + 0.02)), pose())
    assert check.judge(gap + 1e-9, pose(START + way * 0.09), pose()) == ""


@pytest.mark.parametrize("way", [UP, DOWN])
def test_toward_its_command_a_joint_moves_no_faster_than_it_can(hand, check, way):
    command = pose(START + way * 0.8)
    check.follow(command)
    room = 0.1 + fastest(hand) * CYCLE
    assert "too far from 0.90 rad before" in check.judge(CYCLE, pose(START + way * (room + 0.02)), command)
    # The same angle is plausible once there was time to get there.
    assert check.judge(2 * CYCLE, pose(START + way * (room + 0.02)), command) == ""


@pytest.mark.parametrize("way", [UP, DOWN])
def test_beyond_its_command_it_is_wrong_however_long_it_lasts(hand, check, way):
    angle = START + way * (0.1 + fastest(hand) * CYCLE + 0.02)
    for k in range(1, 200):
        assert check.judge(k * CYCLE, pose(angle), pose())
    assert check.judge(200 * CYCLE, pose(), pose()) == ""


@pytest.mark.parametrize("way", [UP, DOWN])
def test_readings_that_disagree_do_not_make_a_pose(hand, way):
    """With the motors off: agreement is counted anew after every jump."""
    check = PoseCheck(hand, 0.1)
    far = START + way * (0.1 + fastest(hand) * CYCLE + 0.02)
    for k, angle in enumerate((START, START, far, far)):
        assert check.judge(k * CYCLE, pose(angle), None) and not check.known
    assert check.judge(4 * CYCLE, pose(far), None) == "" and check.known


@pytest.mark.parametrize("angle", [2.02, -0.11])
def test_a_reading_outside_the_limits_ends_the_agreement(hand, angle):
    check = PoseCheck(hand, 0.1)
    for k in range(2):
        check.judge(k * CYCLE, pose(), None)
    assert "outside its limits" in check.judge(2 * CYCLE, pose(angle), None)
    assert [bool(check.judge(k * CYCLE, pose(), None)) for k in range(3, 6)] == [True, True, False]
