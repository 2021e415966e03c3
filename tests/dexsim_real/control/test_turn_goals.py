"""Goals of the rotation task on hardware."""

import math

import numpy as np
import pytest

from dexsim.task_spec import TurnSpec
from dexsim.tasks.rotate.task import goal_quat
from dexsim_real.control.policy_loop import TurnGoals
from dexsim_real.sensors.readings import ObjectEstimate

REFERENCE = (0.047, 0.024, 0.088)


def seen(angle, axis=(1.0, 0, 0), place=(0.048, 0.0, 0.085)):
    quat = np.array([math.cos(angle / 2), *(math.sin(angle / 2) * np.array(axis))])
    return ObjectEstimate(np.array(place), np.zeros(3), quat)


@pytest.mark.parametrize("direction", [1, -1])
def test_goals_move_on_as_in_the_task(direction):
    turn = TurnSpec(step=direction * math.pi / 2)
    goals = TurnGoals(turn, REFERENCE)
    rate, period, turns = 0.8 * direction, 0.03, 0
    for k in range(600):
        wanted = np.asarray(goal_quat(turns, np.asarray(turn.axis), turn.step))
        np.testing.assert_allclose(goals.quat, wanted, atol=1e-5)
        angle = rate * period * k
        goals.update(period * k, seen(angle))
        # A goal is reached 0.3 rad before it.
        turns = max(turns, math.floor((abs(angle) + turn.angle - 1e-9) / abs(turn.step)))
        assert goals.successes == turns
    assert turns >= 8 and len(goals.times) == turns


@pytest.mark.parametrize("way", [1, -1])
def test_a_goal_passed_at_speed_or_far_away_does_not_count(way):
    """Whichever way round the object passes it."""
    turn = TurnSpec(spin=2.0)
    fast, far = TurnGoals(turn, REFERENCE), TurnGoals(turn, REFERENCE)
    for k in range(40):
        fast.update(0.03 * k, seen(way * 6.0 * 0.03 * k))
        far.update(0.03 * k, seen(way * 1.0 * 0.03 * k, place=(0.2, 0, 0.085)))
    assert fast.successes == far.successes == 0


@pytest.mark.parametrize("direction", [1, -1])
def test_a_quaternion_of_the_other_sign_is_no_turn(direction):
    """q and -q are one orientation; an IMU may give either, from one sample to the next."""
    turn = TurnSpec(step=direction * math.pi / 2, spin=2.0)
    goals = TurnGoals(turn, REFERENCE)
    for k in range(100):
        estimate = seen(0.8 * direction * 0.03 * k)
        sign = -1 if k % 2 else 1
        goals.update(0.03 * k, ObjectEstimate(estimate.position, estimate.velocity, sign * estimate.quat))
    assert goals.successes == 1


@pytest.mark.parametrize(("off", "counts"), [(0.049, True), (0.051, False)])
def test_a_goal_counts_within_its_distance_at_the_time_of_the_orientation(off, counts):
    turn = TurnSpec(distance=0.05)
    goals = TurnGoals(turn, REFERENCE)
    place = np.asarray(REFERENCE) + [0.0, 0.6 * off, 0.8 * off]
    goals.update(7.5, seen(math.pi / 2, place=place))
    assert goals.successes == counts and goals.times == [7.5] * counts
