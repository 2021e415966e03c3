"""Wrong readings of the hand: they are no measurements, and no command follows them."""

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from test_safety import AGREEING, CYCLE, FREE, MIDDLE, UNSEEN, WAYS, Bench, sample

from dexsim_real.control.pose_check import UNKNOWN, PoseCheck
from dexsim_real.control.safety import Reaction, Safety
from dexsim_real.core.errors import HandError
from dexsim_real.sensors.hand import HandSensing, HardwareConfig
from dexsim_real.wire.frames import Mode

JOINT, START = 4, 0.9  # index_joint1, in the middle of its range


def wrong(joint, value, base=MIDDLE):
    position = np.array(base, np.float32)
    position[joint] = value
    return position


@pytest.mark.parametrize("value", [1.3, -1.3, 1e30, 1.9, np.nan])
@pytest.mark.parametrize(("cycles", "hold"), [(1, ""), (40, UNSEEN)])
def test_a_wrong_angle_moves_nothing(bench, value, cycles, hold):
    """For one cycle and for half a second; while the policy is in command, and in a hold."""
    true = bench.position.copy()
    bench.position = wrong(4, value if value in (1e30, 1.9) else true[4] + value)
    for _ in range(cycles):
        decision = bench.cycle(target=MIDDLE, hold=hold, follow=False)
        assert decision.mode == Mode.POSITION
        np.testing.assert_array_equal(decision.position, MIDDLE)
    np.testing.assert_allclose(bench.safety.sample.measured.joint_position, true, atol=2e-7)
    bench.position = true
    assert bench.cycle(target=MIDDLE).reaction == Reaction.NONE
    assert bench.safety.counts["implausible: measurement"] == cycles


def test_the_first_reading_after_the_motors_came_on_may_be_wrong_as_well(hand):
    bench = Bench(hand)
    bench.engage()
    assert bench.cycle().mode == Mode.POSITION
    bench.position = wrong(4, 1.5)
    bench.cycle(follow=False)
    assert "index_joint1 reads 1.5 rad" in bench.safety.problem


@pytest.mark.parametrize("right", [2, 4, 40, 1000])
def test_wrong_angles_that_last_turn_the_motors_off_and_name_the_joint(bench, right):
    """Also with one right reading of so many: commands would follow it, and nothing would tell."""
    start = bench.now
    for k in range(round(6.0 / CYCLE)):
        bench.position = MIDDLE if k % right == 0 else wrong(4, 1.9)
        decision = bench.cycle(target=MIDDLE, follow=False)
        if bench.safety.latched:
            break
        np.testing.assert_array_equal(decision.position, MIDDLE)
    assert (decision.mode == Mode.PASSIVE) == bool(bench.safety.latched) == (right > 2)
    assert right == 2 or "joint index_joint1 reads 1.9 rad" in bench.safety.latched and bench.now - start < 4.5


def test_wrong_readings_far_apart_do_not_add_up(bench):
    """One every two seconds for half a minute; each is a fault, but none of them lasts."""
    for _ in range(15):
        bench.position = wrong(4, 1.9)
        bench.cycle(target=MIDDLE, follow=False)
        bench.position = MIDDLE
        assert all(d.mode == Mode.POSITION for d in bench.run(2.0, target=MIDDLE))
    assert bench.safety.counts["implausible: measurement"] == 15 and not bench.safety.latched


@pytest.mark.parametrize("pose", [wrong(4, 2.2), wrong(3, -0.4), np.full(12, -0.5, np.float32)])
def test_nothing_is_enabled_on_a_pose_outside_the_limits(hand, pose):
    bench = Bench(hand)
    bench.position = pose
    bench.run(0.1)
    bench.safety.engage()
    assert all(d.mode == Mode.PASSIVE for d in bench.run(3.0, target=MIDDLE, follow=False))
    assert "outside its limits" in bench.safety.problem


def test_a_wrong_angle_before_a_silence_remains_wrong_after_it(bench):
    """Readings agree, but on an angle that was wrong: the motors do not come on there."""
    bench.position = wrong(4, 1.9)
    bench.run(0.5, target=MIDDLE, follow=False)
    assert bench.run(2.0, target=MIDDLE, fresh=False, follow=False)[-1].mode == Mode.PASSIVE
    back = bench.run(0.5, target=MIDDLE, follow=False)
    assert all(decision.mode == Mode.PASSIVE for decision in back) and "index_joint1" in back[-1].reason
    assert bench.safety.latched.startswith("implausible measurements for 1 s: joint index_joint1")


@pytest.mark.parametrize("generation", [1, 2])
def test_after_a_reading_that_was_no_number_several_must_agree_as_well(bench, generation):
    """It was the last before the hand was silent for long, or disconnected."""
    bench.position = np.full(12, np.nan, np.float32)
    bench.cycle(target=MIDDLE, follow=False)
    if generation == 1:
        assert bench.run(2.0, target=MIDDLE, fresh=False, follow=False)[-1].mode == Mode.PASSIVE
    bench.position = MIDDLE - np.float32(0.1) * FREE
    back = [bench.cycle(target=MIDDLE, generation=generation) for _ in range(AGREEING)]
    assert [decision.mode for decision in back] == [Mode.PASSIVE] * (AGREEING - 1) + [Mode.POSITION]
    assert {decision.reason for decision in back[:-1]} == {UNKNOWN}


# --- the check of a pose ---------------------------------------------------------------------------


def pose(angle=START):
    return np.array([0.9, 0.4, 0.8, 0.0] + [angle] + [START] * 7)


@pytest.fixture
def check(hand):
    """Knows the pose, motors on where the hand is. The newest reading is of time 0."""
    check = PoseCheck(hand)
    for k in range(1 - AGREEING, 1):
        check.judge(k * CYCLE, pose(), None)
    np.testing.assert_array_equal(check.at_rest, pose())
    check.follow(pose())
    return check


def fastest(hand):
    """rad/s"""
    return 1.25 * float(hand.speed_limit[JOINT])


@WAYS
@pytest.mark.parametrize("gap", [CYCLE, 0.5])
def test_away_from_its_commands_a_joint_moves_for_30_ms_at_most(hand, check, way, gap):
    """However long nothing was read: with the motors on nothing carries it farther."""
    room = 0.1 + fastest(hand) * min(gap, 0.03)
    assert "index_joint1 reads" in check.judge(gap, pose(START + way * (room + 0.02)), pose())
    assert check.judge(gap + 1e-9, pose(START + way * 0.09), pose()) == ""


@WAYS
def test_toward_its_command_a_joint_moves_no_faster_than_it_can(hand, check, way):
    command = pose(START + way * 0.8)
    check.follow(command)
    room = 0.1 + fastest(hand) * CYCLE
    assert "too far from 0.90 rad before" in check.judge(CYCLE, pose(START + way * (room + 0.02)), command)
    # The same angle is plausible once there was time to get there.
    assert check.judge(2 * CYCLE, pose(START + way * (room + 0.02)), command) == ""


@WAYS
def test_commands_explain_a_motion_since_the_last_reading_and_not_later(check, way):
    """A joint may have followed the command before the newest; one that came back does not go there again by itself."""
    check.follow(pose(START + way * 0.5))
    check.follow(pose())
    assert check.judge(0.1, pose(START + way * 0.5), pose()) == ""
    for k, angle in enumerate(START + way * np.linspace(0.5, 0.0, 20)):
        assert check.judge(0.2 + k * CYCLE, pose(angle), pose(angle)) == ""
    for k in range(200):
        assert check.judge(0.5 + k * CYCLE, pose(START + way * 0.5), pose())


@pytest.mark.parametrize(
    ("off", "known"),
    [({0: 0.049}, 1), ({9: 0.049}, 1), ({0: 0.051}, 0), ({9: -0.051}, 0), ({1: 0.04, 2: 0.04, 8: 0.04, 9: 0.04}, 1)],
)
def test_a_pose_is_the_median_of_ten_readings_that_agree(hand, off, known):
    """With the motors off; wherever among them the wrong ones are."""
    check = PoseCheck(hand)
    for k in range(AGREEING):
        assert check.at_rest is None
        assert check.judge(k * CYCLE, pose(START + off.get(k, 0.0)), None) == ""
    np.testing.assert_array_equal(check.at_rest, pose() if known else None)


@pytest.mark.parametrize("angle", [2.02, -0.11])
def test_a_reading_outside_the_limits_ends_the_agreement(hand, angle):
    check = PoseCheck(hand)
    for k in range(AGREEING - 1):
        check.judge(k * CYCLE, pose(), None)
    assert "outside its limits" in check.judge(AGREEING * CYCLE, pose(angle), None)
    for k in range(AGREEING):
        assert check.at_rest is None
        assert check.judge((AGREEING + k) * CYCLE, pose(), None) == ""
    assert check.at_rest is not None


def test_motors_that_went_off_unseen_come_on_at_a_pose_of_new_readings(check):
    for k in range(1, AGREEING + 1):
        assert check.at_rest is None or k == 1
        assert check.judge(k * CYCLE, pose(), None) == ""
    assert check.at_rest is not None


# --- any readings and targets ------------------------------------------------------------------------


READING = st.one_of(
    st.none(),  # Silence.
    st.just("true"),
    st.tuples(st.integers(0, 11), st.one_of(st.floats(width=32), st.floats(-1.75, 1.75, width=32))),
)
TARGET = st.one_of(st.none(), st.floats(width=32), st.lists(st.floats(-3, 3, width=32), min_size=12, max_size=12))
MEASUREMENT = st.fixed_dictionaries(
    {
        "velocity": st.sampled_from([0.0, 5.0, 50.0]),
        "force": st.sampled_from([0.0, 5.0, 30.0]),
        "current": st.sampled_from([0.1, 0.1, 3.0]),
        "temperature": st.sampled_from([30.0] * 9 + [80.0]),
        "generation": st.sampled_from([1] * 9 + [2]),
    }
)
STEPS = st.lists(st.tuples(READING, TARGET, MEASUREMENT, st.booleans(), st.floats(0.001, 0.2)), max_size=60)


@settings(max_examples=150, deadline=None)
@given(STEPS)
def test_no_course_of_events_makes_a_command_jump(hand, steps):
    """Finite, within the limits, and at most speed x time from the command before; the first is the measured pose."""
    bench = Bench(hand)
    bench.engage()
    bench.cycle()
    last, before = bench.position, bench.now - CYCLE
    for reading, target, measurement, follow, pause in steps:
        now, position = bench.now, bench.position
        if reading is not None:
            if reading != "true":
                position = wrong(*reading, position)
            with np.errstate(all="ignore"):
                bench.safety.update(sample(now, position, **measurement))
        if target is not None:
            bench.safety.set_target(np.full(12, target) if isinstance(target, float) else np.array(target), now)
        decision = bench.safety.decide(now)
        assert np.isfinite(decision.position).all() and decision.mode in (Mode.PASSIVE, Mode.POSITION)
        assert np.all(decision.position >= hand.joint_lower) and np.all(decision.position <= hand.joint_upper)
        assert not bench.safety.latched or decision.mode == Mode.PASSIVE
        if decision.mode == Mode.POSITION:
            if last is None:  # Motors on: where the hand is.
                last, before = bench.safety.sample.measured.joint_position.clip(hand.joint_lower, hand.joint_upper), now
            assert np.abs(decision.position - last).max() <= 8.0 * (now - before) + 1e-5
            last, before = decision.position, now
            bench.position = decision.position if follow else bench.position
        else:
            last = None
        bench.now += pause


def test_a_command_that_is_not_finite_never_leaves(hand):
    sensing = HandSensing(hand, HardwareConfig())
    for bad in (np.nan, np.inf, 1e300):
        with pytest.raises(HandError, match="not finite"), np.errstate(over="ignore"):
            sensing.command(np.where(np.arange(12) == 7, bad, 0.5), Mode.POSITION)


def test_another_thread_may_change_a_target_at_any_moment(bench):
    """It is copied as it is set, and read once a cycle."""
    target, reads = MIDDLE.copy(), []
    bench.cycle(target=target)
    target[:] = np.nan
    assert bench.cycle().reaction == Reaction.NONE
    now = bench.safety._target
    bench.safety.__class__ = type("Changing", (Safety,), {"_target": property(lambda self: reads.pop(0))})
    reads += [now, now._replace(position=np.full(12, np.nan)), None]
    assert bench.cycle().reaction == Reaction.NONE
