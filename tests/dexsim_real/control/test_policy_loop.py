"""The policy's side of a run in virtual time: a silent sensor of the object ends it; goals of the rotation task."""

import math
from types import SimpleNamespace

import numpy as np
import pytest
from test_safety import CYCLE, MIDDLE, Bench

from dexsim.task_spec import TurnSpec
from dexsim.tasks.rotate.task import goal_quat
from dexsim_real.control import policy_loop
from dexsim_real.control.controller import Tick
from dexsim_real.control.policy_loop import TurnGoals
from dexsim_real.control.safety import Reaction
from dexsim_real.sensors.camera import ObjectEstimate
from dexsim_real.sensors.imu import IDENTITY, ImuReader, encode


class Still:
    """What the loop needs of a controller, with a policy that stays where it is."""

    def __init__(self, hand):
        self.hand, self.period = hand, 3 * CYCLE
        self.spec = SimpleNamespace(turn=None, posture=None, reference=(0.0, 0.0, 0.1))

    def start(self, target):
        self.target = target

    resume = anchor = start

    def tick(self, measured, estimate, goal, command):
        return Tick(None, None, np.zeros(12), MIDDLE)


@pytest.mark.parametrize("silent", [False, True])
def test_a_silent_imu_is_held_within_a_third_of_a_second_then_relaxed(hand, silent):
    bench, imu = Bench(hand), ImuReader()
    objects = policy_loop.ObjectSensors(np.zeros(3), None, imu)
    loop = policy_loop.PolicyLoop(Still(hand), bench.safety, objects, command=0.5, approach_seconds=0, place_seconds=0)
    imu.receive(bench.now, encode(0, IDENTITY))
    bench.engage()
    bench.cycle()
    while loop.approach(bench.now):
        bench.cycle()
    loop.begin()
    start, reactions = bench.now, []
    for k in range(round(3.0 / CYCLE)):
        if not (silent and bench.now > start + 1.0):
            imu.receive(bench.now, encode(k, IDENTITY))
        if k % 3 == 0 and not bench.safety.latched:
            assert loop.tick(bench.now) is not None
        reactions.append((bench.now - start, *bench.safety.last))
        bench.cycle()
    held = [(time, reason) for time, reaction, reason in reactions if reaction >= Reaction.HOLD]
    if silent:
        assert 1.3 <= held[0][0] < 1.4 and held[0][1] == "the IMU is silent"
        assert bench.safety.latched == "the IMU is silent for 1 s"
    else:
        assert not held and not bench.safety.latched


# --- goals of the rotation task ----------------------------------------------------------------------

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
