"""How far a joint can have moved between two readings: everything farther is wrong, everything nearer is not."""

import numpy as np
import pytest
from test_safety import AGREEING, CYCLE

from dexsim_real.control.pose_check import PoseCheck

JOINT, START = 4, 0.9  # index_joint1, in the middle of its range
UP, DOWN = 1.0, -1.0


@pytest.fixture
def check(hand):
    """Knows the pose, motors on where the hand is. The newest reading is of time 0."""
    check = PoseCheck(hand, 0.1)
    for k in range(1 - AGREEING, 1):
        check.judge(k * CYCLE, pose(), None)
    np.testing.assert_array_equal(check.at_rest, pose())
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


@pytest.mark.parametrize("apart", [0.049, 0.051, -0.049, -0.051])
@pytest.mark.parametrize("at", range(AGREEING))
def test_readings_that_disagree_do_not_make_a_pose(hand, apart, at):
    """With the motors off; wherever among the last ten the wrong one is, the pose is the median."""
    check = PoseCheck(hand, 0.1)
    for k in range(AGREEING):
        assert check.at_rest is None
        assert check.judge(k * CYCLE, pose(START + apart * (k == at)), None) == ""
    if abs(apart) > 0.05:
        assert check.at_rest is None
    else:
        np.testing.assert_array_equal(check.at_rest, pose())


def test_four_equal_wrong_readings_of_ten_do_not_move_the_pose(hand):
    check = PoseCheck(hand, 0.1)
    for k in range(AGREEING):
        check.judge(k * CYCLE, pose(START + 0.04 * (k in (1, 2, 8, 9))), None)
    np.testing.assert_array_equal(check.at_rest, pose())


@pytest.mark.parametrize("angle", [2.02, -0.11])
def test_a_reading_outside_the_limits_ends_the_agreement(hand, angle):
    check = PoseCheck(hand, 0.1)
    for k in range(AGREEING - 1):
        check.judge(k * CYCLE, pose(), None)
    assert "outside its limits" in check.judge(AGREEING * CYCLE, pose(angle), None)
    for k in range(AGREEING):
        assert check.at_rest is None
        assert check.judge((AGREEING + k) * CYCLE, pose(), None) == ""
    assert check.at_rest is not None


def test_motors_that_went_off_unseen_come_on_at_a_pose_of_new_readings(hand, check):
    for k in range(1, AGREEING + 1):
        assert check.at_rest is None or k == 1
        assert check.judge(k * CYCLE, pose(), None) == ""
    assert check.at_rest is not None


@pytest.mark.parametrize("way", [UP, DOWN])
def test_where_commands_were_before_explains_nothing(hand, check, way):
    """A joint that went there and back does not go there again by itself."""
    path = START + way * 0.6 * np.concatenate([np.linspace(0, 1, 20), np.linspace(1, 0, 20)])
    for k, angle in enumerate(path, start=1):
        check.follow(pose(angle))
        assert check.judge(k * CYCLE, pose(angle), pose(angle)) == ""
    for k in range(41, 200):
        assert check.judge(k * CYCLE, pose(START + way * 0.5), pose())


@pytest.mark.parametrize("way", [UP, DOWN])
def test_all_commands_since_the_last_reading_count(hand, check, way):
    """The joint may have followed the one before the newest."""
    check.follow(pose(START + way * 0.5))
    check.follow(pose())
    assert check.judge(0.1, pose(START + way * 0.5), pose()) == ""
