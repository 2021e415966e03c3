"""Wrong readings of the hand: they are no measurements, and no command follows them."""

import sys
import threading

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from test_safety import AGREEING, CYCLE, FREE, MIDDLE, Bench, sample

from dexsim_real.control.limits import SafetyConfig
from dexsim_real.control.pose_check import PoseCheck
from dexsim_real.control.safety import Reaction, Safety, TargetRequest
from dexsim_real.core.errors import HandError
from dexsim_real.loop import LoopThread
from dexsim_real.sensors.hand import HandSensing, HardwareConfig
from dexsim_real.wire import frames
from dexsim_real.wire.frames import Mode
from dexsim_real.wire.link import LinkCounts, Reply


def wrong(joint, value, base=MIDDLE):
    position = np.array(base, np.float32)
    position[joint] = value
    return position


@pytest.fixture
def bench(hand):
    bench = Bench(hand)
    bench.engage()
    bench.run(2.0, wish=MIDDLE)
    return bench


@pytest.mark.parametrize("event", [{"velocity": 25.0}, {"wish": np.full(12, np.nan)}])
def test_hold_keeps_the_last_confirmed_command(bench, event):
    """The hand is pressed away from its command; hold keeps the command."""
    wish = MIDDLE + np.float32(0.15) * FREE
    bench.run(1.0, wish=wish)
    bench.position = wish - np.float32(0.15) * FREE
    bench.cycle(wish=wish, follow=False)
    for _ in range(20):
        decision = bench.cycle(**{"wish": wish, "follow": False} | event)
        assert decision.reaction == Reaction.HOLD
        np.testing.assert_array_equal(decision.position, wish)


def test_a_command_that_was_not_answered_is_not_held(bench):
    confirmed = bench.cycle(wish=MIDDLE + np.float32(0.02), follow=False).position
    bench.cycle(wish=MIDDLE + np.float32(0.04), follow=False)  # Its measurement confirms the one before.
    sent = bench.cycle(wish=MIDDLE + np.float32(0.06), fresh=False, follow=False).position
    held = bench.cycle(wish=np.full(12, np.nan), fresh=False).position
    assert not np.array_equal(held, sent)
    np.testing.assert_array_equal(held, confirmed)


def test_too_much_force_eases_slowly_toward_the_measured_pose(bench):
    """Keeping the command would keep the force."""
    wish = MIDDLE + np.float32(0.1) * FREE
    bench.run(1.0, wish=wish, follow=False)
    path = [d.position for d in bench.run(0.5, wish=wish, follow=False, force=30.0)]
    assert np.abs(np.diff(path, axis=0)).max() <= 0.5 * CYCLE + 1e-6
    np.testing.assert_allclose(path[-1], MIDDLE, atol=1e-6)


@pytest.mark.parametrize("value", [1.3, -1.3, 1e30, 1.9])
@pytest.mark.parametrize("cycles", [1, 3, 40])
@pytest.mark.parametrize("reason", ["", "the object is out of sight"])
def test_a_wrong_angle_moves_nothing(bench, value, cycles, reason):
    """For one cycle, for a few, and for half a second; while the policy is in command, and in a hold."""
    true = bench.position.copy()
    bench.position = wrong(4, value if value in (1e30, 1.9) else true[4] + value)
    for _ in range(cycles):
        bench.safety.set_target(MIDDLE, bench.now, reason)
        decision = bench.cycle(follow=False)
        assert decision.mode == Mode.POSITION
        np.testing.assert_array_equal(decision.position, MIDDLE)
    np.testing.assert_array_equal(bench.safety.sample.measured.joint_position, true)
    bench.position = true
    decision = bench.cycle(wish=MIDDLE)
    assert decision.reaction == Reaction.NONE
    assert bench.safety.counts["implausible: measurement"] == cycles


def test_wrong_angles_that_last_turn_the_motors_off_and_name_the_joint(bench):
    bench.position = wrong(4, 1.9)
    decisions = bench.run(1.2, wish=MIDDLE, follow=False)
    assert decisions[-1].mode == Mode.PASSIVE
    assert all(np.array_equal(d.position, MIDDLE) for d in decisions if d.mode == Mode.POSITION)
    assert "implausible" in bench.safety.latched and "index_joint1 reads 1.9 rad" in bench.safety.latched


def test_reach_does_not_pull_a_command(hand, bench):
    """A joint that is off slowly enough to be believed takes no command along."""
    for k in range(60):
        bench.position = wrong(4, MIDDLE[4] + 0.016 * k)
        decision = bench.cycle(wish=MIDDLE, follow=False)
        assert decision.mode == Mode.POSITION
        np.testing.assert_array_equal(decision.position, MIDDLE)


@pytest.mark.parametrize("pose", [wrong(4, 2.2), wrong(3, -0.4), np.full(12, -0.5, np.float32)])
def test_nothing_is_enabled_on_a_pose_outside_the_limits(hand, pose):
    bench = Bench(hand)
    bench.position = pose
    bench.run(0.1)
    bench.safety.engage()
    assert all(d.mode == Mode.PASSIVE for d in bench.run(3.0, wish=MIDDLE, follow=False))
    assert "outside its limits" in bench.safety.problem


def test_nothing_is_enabled_on_a_single_reading(hand):
    bench = Bench(hand)
    bench.engage()
    bench.run(0.1, fresh=False)
    for k in range(20):  # Every other reading is off: none of them is the pose.
        bench.position = wrong(4, 1.9 if k % 2 else 0.9)
        assert bench.cycle(wish=MIDDLE, generation=2, follow=False).mode == Mode.PASSIVE


def test_a_moving_joint_is_plausible_up_to_its_speed(hand):
    check, top = PoseCheck(hand, 0.1), np.asarray(hand.speed_limit)
    position, goal = np.full(12, 0.1), np.asarray(hand.joint_upper)
    for k in range(AGREEING):
        check.judge(k * CYCLE, position, None)
    assert check.at_rest is not None
    check.follow(goal)
    for k in range(AGREEING, 40):
        position = np.minimum(position + top * CYCLE, goal)
        assert check.judge(k * CYCLE, position, goal) == ""


READING = st.one_of(
    st.none(),  # Silence.
    st.just("true"),
    st.tuples(st.integers(0, 11), st.one_of(st.floats(width=32), st.floats(-1.75, 1.75, width=32))),
)
WISH = st.one_of(st.none(), st.floats(width=32), st.lists(st.floats(-3, 3, width=32), min_size=12, max_size=12))
STEPS = st.lists(
    st.tuples(READING, WISH, st.sampled_from([0.0, 30.0]), st.sampled_from([1] * 9 + [2]), st.floats(0.001, 0.2)),
    max_size=60,
)


@settings(max_examples=150, deadline=None)
@given(STEPS)
def test_no_readings_and_targets_make_a_command_jump(hand, steps):
    """Finite, within the limits, and at most speed x time from the command before; the first is the measured pose."""
    bench = Bench(hand)
    bench.engage()
    bench.cycle()
    last, before = bench.position, bench.now - CYCLE
    for reading, wish, force, generation, pause in steps:
        now, position = bench.now, bench.position
        if reading is not None:
            if reading != "true":
                position = wrong(*reading, position)
            with np.errstate(all="ignore"):
                bench.safety.see(sample(now, position, force=force, generation=generation))
        if wish is not None:
            bench.safety.set_target(np.full(12, wish) if isinstance(wish, float) else np.array(wish), now)
        decision = bench.safety.decide(now)
        assert np.isfinite(decision.position).all()
        assert np.all(decision.position >= hand.joint_lower) and np.all(decision.position <= hand.joint_upper)
        if decision.mode == Mode.POSITION:
            if last is None:  # Motors on: where the hand is.
                last, before = bench.safety.sample.measured.joint_position.clip(hand.joint_lower, hand.joint_upper), now
            assert np.abs(decision.position - last).max() <= 8.0 * (now - before) + 1e-5
            last, before, bench.position = decision.position, now, decision.position
        else:
            last = None
        bench.now += pause


class Alternating:
    """A wish that another thread replaces in the middle of `decide`: each read gives the other one."""

    def __init__(self, wishes):
        self._wishes, self.reads = wishes, 0

    def __get__(self, safety, kind):
        self.reads += 1
        return self._wishes[(self.reads - 1) % len(self._wishes)]

    def __set__(self, safety, value):
        pass


def test_the_wish_is_read_once_a_cycle(bench):
    good, bad = (TargetRequest(bench.now, pose, "", bench.now) for pose in (MIDDLE, np.full(12, np.nan, np.float32)))

    class Torn(Safety):
        _target = Alternating([good, bad])

    bench.safety.__class__ = Torn
    for _ in range(6):
        bench.safety.see(sample(bench.now, MIDDLE))
        assert np.isfinite(bench.safety.decide(bench.now).position).all()


@settings(max_examples=10, deadline=None)
@given(st.lists(st.one_of(st.just(np.nan), st.just(np.inf), st.floats(-2, 2, width=32)), min_size=2, max_size=6))
def test_a_second_thread_that_writes_any_wish_puts_nothing_wrong_on_the_wire(hand, wishes):
    bench, sensing, stop = Bench(hand), HandSensing(hand, HardwareConfig()), threading.Event()
    bench.engage()

    def write():
        while not stop.is_set():
            for wish in wishes:
                bench.safety.set_target(np.full(12, wish), bench.now)

    before, thread = sys.getswitchinterval(), threading.Thread(target=write)
    sys.setswitchinterval(1e-6)
    thread.start()
    try:
        sent = []
        for _ in range(200):
            decision = bench.cycle()
            sent.append(sensing.command(decision.position, decision.mode)["position"])
    finally:
        stop.set()
        thread.join()
        sys.setswitchinterval(before)
    assert np.isfinite(sent).all()
    assert np.abs(np.diff(sent, axis=0)).max() <= 8.0 * CYCLE + 1e-5


class Port:
    """A hand that keeps every command and answers with scripted angles."""

    def __init__(self, *angles):
        self.angles, self.commands, self.counts = list(angles), [], LinkCounts()

    def exchange(self, command):
        self.commands.append(command)
        state = frames.empty_state()
        state["joint"]["position"] = self.angles[min(len(self.commands), len(self.angles)) - 1]
        return Reply(state, CYCLE * len(self.commands), CYCLE * (len(self.commands) + 1), len(self.commands), 1)

    def close(self):
        pass


def test_a_command_that_is_not_finite_never_leaves(hand):
    sensing = HandSensing(hand, HardwareConfig())
    for bad in (np.nan, np.inf, 1e300):
        with pytest.raises(HandError, match="not finite"), np.errstate(over="ignore"):
            sensing.command(np.full(12, bad), Mode.POSITION)


def test_one_huge_frame_leaves_no_trace_in_the_velocity(hand):
    """Finite to the end of a float: the filter must not keep it."""
    port = Port(MIDDLE, MIDDLE, MIDDLE, MIDDLE, wrong(4, 1e30), MIDDLE)
    sensing = HandSensing(hand, HardwareConfig())
    safety = Safety(hand, SafetyConfig())
    servo = LoopThread(port, sensing, safety, 83.0)
    for _ in range(10):
        servo.cycle()
    assert safety.counts["implausible: measurement"] == 1 and safety.sample.sequence == 10
    np.testing.assert_allclose(safety.sample.velocity, 0.0, atol=1e-6)
