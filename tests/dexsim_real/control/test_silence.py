"""A hand that stops answering, or answers wrongly, and comes back: where its motors come on again, and what is said."""

import numpy as np
import pytest
from test_safety import AGREEING, CYCLE, FREE, MIDDLE, Bench

from dexsim_real.control.pose_check import UNKNOWN
from dexsim_real.wire.frames import Mode

SAGGED = (MIDDLE - np.float32(0.4)) * FREE


@pytest.fixture
def bench(hand):
    bench = Bench(hand)
    bench.engage()
    bench.run(2.0, wish=MIDDLE)
    return bench


def test_while_the_hand_is_silent_that_is_the_reason(bench):
    reasons = [decision.reason for decision in bench.run(3.0, wish=MIDDLE, fresh=False)]
    assert set(reasons[10:]) == {"no measurement"} and not bench.safety.latched
    # Back, it says why the motors stay off until enough readings agree.
    bench.position = SAGGED
    assert {bench.cycle(wish=MIDDLE).reason for _ in range(AGREEING - 1)} == {UNKNOWN}
    assert bench.cycle(wish=MIDDLE, follow=False).mode == Mode.POSITION


def test_after_a_silence_the_motors_begin_at_the_pose_of_now(bench):
    """Neither at the last command before it nor at the target."""
    bench.run(2.0, wish=MIDDLE, fresh=False)
    bench.position = SAGGED
    for _ in range(AGREEING - 1):
        bench.cycle(wish=MIDDLE)
    first = bench.cycle(wish=MIDDLE, follow=False)
    assert first.mode == Mode.POSITION and np.abs(first.position - SAGGED).max() <= 0.7 * CYCLE


def test_a_wrong_angle_before_a_silence_remains_wrong_after_it(bench):
    """Readings agree, but on an angle that was wrong: the motors do not come on there."""
    wrong = MIDDLE.copy()
    wrong[4] = 1.9
    bench.position = wrong
    bench.run(0.5, wish=MIDDLE, follow=False)
    assert "index_joint1 reads 1.9 rad" in bench.safety.problem
    assert bench.run(2.0, wish=MIDDLE, fresh=False, follow=False)[-1].mode == Mode.PASSIVE
    back = bench.run(0.5, wish=MIDDLE, follow=False)
    assert all(decision.mode == Mode.PASSIVE for decision in back) and "index_joint1" in back[-1].reason
    assert bench.safety.latched.startswith("implausible measurements for 1 s: joint index_joint1")


def test_the_motors_do_not_come_on_at_a_pose_that_was_measured_a_while_ago(hand):
    """Asked for while the hand is silent, which somebody may be moving meanwhile."""
    bench = Bench(hand)
    bench.engage()
    bench.now += 0.06  # s
    asked = bench.run(0.5, wish=MIDDLE, fresh=False)
    assert {(decision.mode, decision.reason) for decision in asked} == {(Mode.PASSIVE, "no measurement")}
    bench.position = SAGGED
    modes = [bench.cycle(wish=MIDDLE).mode for _ in range(2 * AGREEING)]
    assert Mode.POSITION in modes and not bench.safety.latched
    assert np.abs(bench.safety.commanded - SAGGED).max() < 0.03


@pytest.mark.parametrize("generation", [1, 2])
def test_after_a_reading_that_was_no_number_several_must_agree_as_well(bench, generation):
    """It was the last before the hand was silent for long, or disconnected."""
    bench.position = np.full(12, np.nan, np.float32)
    bench.cycle(wish=MIDDLE, follow=False)
    if generation == 1:
        assert bench.run(2.0, wish=MIDDLE, fresh=False, follow=False)[-1].mode == Mode.PASSIVE
    bench.position = MIDDLE - np.float32(0.1) * FREE
    back = [bench.cycle(wish=MIDDLE, generation=generation) for _ in range(AGREEING)]
    assert [decision.mode for decision in back] == [Mode.PASSIVE] * (AGREEING - 1) + [Mode.POSITION]
    assert {decision.reason for decision in back[:-1]} == {UNKNOWN}


def test_a_short_silence_does_not_turn_the_motors_off(bench):
    decisions = bench.run(0.9, wish=MIDDLE, fresh=False) + bench.run(0.1, wish=MIDDLE)
    assert {decision.mode for decision in decisions} == {Mode.POSITION}
    # Each silence counts for itself.
    decisions = bench.run(0.9, wish=MIDDLE, fresh=False) + bench.run(0.1, wish=MIDDLE)
    assert {decision.mode for decision in decisions} == {Mode.POSITION}
