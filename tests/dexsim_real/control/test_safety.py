"""Safety: every limit and its reaction, over scripted and over random courses of events; the two loops' phases."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dexsim.core.errors import ConfigError
from dexsim_real.control.limits import SafetyConfig
from dexsim_real.control.safety import HandSample, Reaction, Safety
from dexsim_real.core.timing import GRACE, Pace, keep_phase
from dexsim_real.loop import LoopThread
from dexsim_real.sensors.hand import HandMeasurement, HandSensing, HardwareConfig
from dexsim_real.wire.frames import Mode

CYCLE = 0.012
AGREEING = 10  # readings that make a pose
SOFT = 0.5  # s, in which stiffness and speed grow after the motors came on
FREE = np.array([1, 1, 1, 0] + [1] * 8, np.float32)  # All but the joint whose range is small.
MIDDLE = np.array([0.9, 0.4, 0.8, 0.0] + [0.9] * 8, np.float32)


def sample(time, position=MIDDLE, *, velocity=0.0, force=0.0, current=0.1, temperature=35.0, generation=1):
    taxels = np.zeros((5, 120), np.float32)
    taxels[:, 0] = force
    measured = HandMeasurement(
        joint_position=np.array(position, np.float32),
        joint_torque=np.zeros(12, np.float32),
        taxel_force=taxels,
        current=np.full(12, current, np.float32),
        temperature=np.full(18, temperature, np.float32),
        errors=np.zeros((12, 3), np.uint16),
        mode=np.full(12, Mode.POSITION, np.uint8),
    )
    return HandSample(time, 0, generation, measured, np.full(12, velocity, np.float32))


class Bench:
    """A clock, a hand that stays where it is put, and the decisions made."""

    def __init__(self, hand, **options):
        self.notes = []
        self.safety = Safety(hand, SafetyConfig(**{"speed": 8.0, "margin": 0.0, **options}), self.notes.append)
        self.now, self.position = 10.0, MIDDLE

    def cycle(self, wish=None, fresh=True, follow=True, **measurement):
        if fresh:
            self.safety.see(sample(self.now, self.position, **measurement))
        if wish is not None:
            self.safety.set_target(wish, self.now)
        decision = self.safety.decide(self.now)
        self.now += CYCLE
        if follow and decision.mode == Mode.POSITION:
            self.position = decision.position
        return decision

    def engage(self):
        """Motors on, as soon as the pose is known."""
        for _ in range(AGREEING):
            self.cycle()
        self.safety.engage()

    def run(self, seconds, **options):
        return [self.cycle(**options) for _ in range(round(seconds / CYCLE))]


@pytest.fixture
def bench(hand):
    bench = Bench(hand)
    bench.engage()
    bench.run(2.0, wish=MIDDLE)  # The ramp is over.
    return bench


def test_motors_are_off_until_engaged(hand):
    bench = Bench(hand)
    assert bench.cycle(fresh=False).mode == Mode.PASSIVE
    assert bench.cycle(wish=MIDDLE + 0.1).mode == Mode.PASSIVE


def test_the_first_command_is_the_measured_pose_then_a_ramp(hand):
    bench = Bench(hand)
    bench.position = MIDDLE - np.float32(0.3) * FREE
    bench.engage()
    first = bench.cycle(follow=False)
    assert first.mode == Mode.POSITION
    np.testing.assert_array_equal(first.position, bench.position)
    path = [first.position]
    for _ in range(int(2 / CYCLE)):
        path.append(bench.cycle(wish=MIDDLE + np.float32(0.15)).position)
    speed = np.abs(np.diff(path, axis=0)).max(1) / CYCLE
    # Zero grows to slow_speed (0.5) within half a second, and that to speed (8) within ramp (1 s).
    time = CYCLE + CYCLE * np.arange(len(speed))
    allowed = 0.5 * np.minimum(time / SOFT, 1.0) + 7.5 * np.clip(time - SOFT, 0.0, 1.0)
    assert np.all(speed <= allowed + 1e-3)
    np.testing.assert_allclose(path[-1], MIDDLE + 0.15, atol=1e-6)


@pytest.mark.parametrize("force", [0.0, 16.0])
def test_no_command_is_faster_than_a_speed_below_the_slow_one(hand, force):
    bench = Bench(hand, speed=0.1, slow_speed=0.5, reach=4.0)
    bench.engage()
    path = [bench.cycle(wish=hand.joint_upper, follow=False, force=0.0).position for _ in range(100)]
    path += [bench.cycle(wish=hand.joint_upper, follow=False, force=force).position for _ in range(100)]
    assert 0.05 < np.abs(np.diff(path, axis=0)).max() / CYCLE <= 0.1 + 1e-4


@pytest.mark.parametrize("cause", ["dead", "out of sight"])
@pytest.mark.parametrize("other", [{"force": 16.0}, {"velocity": 20.0}])
def test_a_cause_that_lasts_turns_the_motors_off_whatever_else_interrupts(bench, cause, other):
    start, k = bench.now, 0
    while not bench.safety.latched and bench.now < start + 5:
        if cause != "dead":
            bench.safety.set_target(MIDDLE, bench.now, "the object is out of sight")
        bench.cycle(**other if k % 30 == 0 else {})  # every 0.36 s, for one cycle
        k += 1
    assert bench.safety.latched == f"{'no target' if cause == 'dead' else 'the object is out of sight'} for 1 s"
    assert 1.0 < bench.now - start < 1.2


def test_an_ordinary_wish_passes_untouched(bench):
    decision = bench.cycle(wish=MIDDLE + np.float32(0.05))
    np.testing.assert_array_equal(decision.position, MIDDLE + np.float32(0.05))
    assert (decision.reaction, decision.mode) == (Reaction.NONE, Mode.POSITION)


def test_position_step_and_reach_are_clipped(hand, bench):
    decision = bench.cycle(wish=np.full(12, 9.0))
    assert decision.reaction == Reaction.CLIP
    wanted = np.minimum(MIDDLE + 8.0 * CYCLE, hand.joint_upper)
    np.testing.assert_allclose(decision.position, wanted, atol=1e-4)
    # The hand is stuck: commands stop at reach from where it is.
    stuck = [bench.cycle(wish=np.full(12, 9.0), follow=False) for _ in range(100)]
    assert np.all(stuck[-1].position <= np.minimum(bench.position + 0.6, hand.joint_upper) + 1e-5)
    bench.run(1.0, wish=np.full(12, -9.0))
    np.testing.assert_allclose(bench.position, hand.joint_lower, atol=1e-6)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_a_wish_that_is_not_finite_holds_the_last_command(bench, bad):
    wish = MIDDLE.copy()
    wish[7] = bad
    decision = bench.cycle(wish=wish)
    assert decision.reaction == Reaction.HOLD and decision.mode == Mode.POSITION
    np.testing.assert_array_equal(decision.position, MIDDLE)
    assert bench.cycle(wish=MIDDLE).reaction in (Reaction.NONE, Reaction.CLIP)


def test_a_measurement_that_is_not_finite_is_none(bench):
    broken = MIDDLE.copy()
    broken[0] = np.nan
    bench.position = broken
    decisions = bench.run(0.12, wish=MIDDLE, follow=False)
    assert decisions[0].reaction == Reaction.NONE and decisions[-1].reaction == Reaction.HOLD
    assert all(np.isfinite(d.position).all() for d in decisions)
    assert bench.safety.counts["implausible: measurement"] == len(decisions)


@pytest.mark.parametrize("measurement", [{"velocity": 25.0}, {"force": 26.0}, {"force": 15.0}])
def test_too_fast_or_too_hard_holds_while_it_lasts(bench, measurement):
    bench.run(0.15, wish=MIDDLE + np.float32(0.2))
    before = bench.position.copy()
    held = bench.run(3.0, wish=MIDDLE + np.float32(0.2), follow=False, **measurement)
    assert all(d.reaction == Reaction.HOLD for d in held)
    assert all(np.array_equal(d.position, before) for d in held)
    # Then commands begin there again, slowly.
    after = bench.cycle(wish=MIDDLE + np.float32(0.3))
    assert np.abs(after.position - before).max() <= 0.7 * CYCLE


def test_heat_relaxes_for_good(bench):
    assert bench.cycle(wish=MIDDLE, temperature=71.0).mode == Mode.POSITION  # A single answer may be wrong.
    assert bench.cycle(wish=MIDDLE, temperature=71.0).mode == Mode.PASSIVE
    assert all(d.mode == Mode.PASSIVE for d in bench.run(5.0, wish=MIDDLE))
    bench.safety.engage()
    assert bench.cycle(wish=MIDDLE).mode == Mode.PASSIVE
    assert any("too hot: joint thumb_bend (thumb), 71" in note for note in bench.notes)


def test_current_relaxes_only_when_it_lasts(bench):
    assert all(d.mode == Mode.POSITION for d in bench.run(0.9, wish=MIDDLE, current=2.0))
    bench.cycle(wish=MIDDLE, current=0.5)
    assert all(d.mode == Mode.POSITION for d in bench.run(0.9, wish=MIDDLE, current=2.0))
    decisions = bench.run(0.2, wish=MIDDLE, current=2.0)
    assert decisions[-1].mode == Mode.PASSIVE and "current too high: 2.00 A" in bench.safety.latched


def test_a_dead_policy_is_held_within_100_ms_then_relaxed(bench):
    start = bench.now
    decisions = bench.run(2.0)
    reactions = [d.reaction for d in decisions]
    first = reactions.index(Reaction.HOLD)
    assert (first * CYCLE) <= 0.1
    assert Reaction.RELAX in reactions and 1.0 <= reactions.index(Reaction.RELAX) * CYCLE <= 1.2
    assert bench.safety.latched.startswith("no target") and bench.now > start
    assert bench.cycle(wish=MIDDLE).mode == Mode.PASSIVE


def test_a_silent_hand_is_held_then_relaxed_then_taken_up_where_it_is(bench):
    anchor = bench.safety.anchor
    decisions = bench.run(2.0, wish=MIDDLE, fresh=False)
    reactions = [d.reaction for d in decisions]
    assert reactions.index(Reaction.HOLD) * CYCLE <= 0.1
    assert reactions[-1] == Reaction.RELAX and not bench.safety.latched
    bench.position = (MIDDLE - np.float32(0.4)) * FREE  # It sagged meanwhile.
    assert all(bench.cycle(wish=MIDDLE).mode == Mode.PASSIVE for _ in range(AGREEING - 1))
    decision = bench.cycle(wish=MIDDLE)
    assert decision.mode == Mode.POSITION
    assert np.abs(decision.position - bench.position).max() <= 0.7 * CYCLE
    assert bench.safety.anchor > anchor


def test_a_policy_that_waits_for_a_silent_hand_is_not_dead(bench):
    bench.run(3.0, fresh=False)
    assert not bench.safety.latched
    for _ in range(AGREEING):
        bench.cycle()
    assert not bench.safety.latched
    assert bench.cycle(wish=MIDDLE).mode == Mode.POSITION


def test_a_wish_with_a_reason_not_to_heed_it_holds(bench):
    bench.safety.set_target(MIDDLE + np.float32(0.1), bench.now, "the object is out of sight")
    decision = bench.cycle()
    assert (decision.reaction, decision.reason) == (Reaction.HOLD, "the object is out of sight")


def test_an_object_that_stays_out_of_sight_ends_it(bench):
    def unseen(seconds):
        for _ in range(round(seconds / CYCLE)):
            bench.safety.set_target(MIDDLE, bench.now, "the object is out of sight")
            decision = bench.cycle()
        return decision

    assert unseen(0.9).reaction == Reaction.HOLD
    assert bench.cycle(wish=MIDDLE).reaction < Reaction.HOLD  # Seen again in time.
    assert unseen(0.9).reaction == Reaction.HOLD and unseen(0.2).mode == Mode.PASSIVE
    assert bench.safety.latched == "the object is out of sight for 1 s"
    assert bench.cycle(wish=MIDDLE).mode == Mode.PASSIVE


def test_a_reconnected_hand_starts_from_its_pose(bench):
    anchor = bench.safety.anchor
    bench.position = MIDDLE - np.float32(0.5) * FREE
    for _ in range(AGREEING - 1):
        assert bench.cycle(wish=MIDDLE, generation=2).mode == Mode.PASSIVE
    first = bench.cycle(wish=MIDDLE, generation=2, follow=False)
    np.testing.assert_allclose(first.position, bench.position, atol=0.7 * CYCLE)
    assert bench.safety.anchor == anchor + 1


@pytest.mark.parametrize("back", [{"generation": 2}, {}])
def test_a_hand_that_was_away_during_a_hold(bench, back):
    """After a new connection its motors are off: it is held where it is. Otherwise the last command remains."""

    def unseen(**event):
        bench.safety.set_target(MIDDLE, bench.now, "the object is out of sight")
        return bench.cycle(**event)

    assert all(unseen().reason == "the object is out of sight" for _ in range(5))
    assert [unseen(fresh=False).reason for _ in range(10)][-1] == "no measurement"
    away = np.float32(0.4 if back else 0.05)
    bench.position = MIDDLE - away * FREE
    for _ in range(AGREEING - 1 if back else 0):
        assert unseen(follow=False, **back).mode == Mode.PASSIVE
    for _ in range(3):
        decision = unseen(follow=False, **back)
        assert (decision.reaction, decision.reason) == (Reaction.HOLD, "the object is out of sight")
        np.testing.assert_array_equal(decision.position, bench.position if back else MIDDLE)


def test_changes_are_noted_once(bench):
    bench.notes.clear()
    bench.run(0.5, wish=MIDDLE, force=30.0)
    bench.run(2.0, wish=MIDDLE)
    assert bench.notes == ["hold: the fingertip force is too high", "in command"]
    assert bench.safety.counts["the fingertip force is too high"] == round(0.5 / CYCLE)


EVENT = st.fixed_dictionaries(
    {
        "wish": st.one_of(
            st.none(), st.floats(width=32), st.lists(st.floats(-20, 20, width=32), min_size=12, max_size=12)
        ),
        "fresh": st.booleans(),
        "velocity": st.sampled_from([0.0, 5.0, 50.0]),
        "force": st.sampled_from([0.0, 5.0, 30.0]),
        "current": st.sampled_from([0.1, 3.0]),
        "temperature": st.sampled_from([30.0] * 9 + [80.0]),
        "generation": st.sampled_from([1, 1, 1, 2]),
        "follow": st.booleans(),
    }
)


@settings(max_examples=60)
@given(st.lists(EVENT, max_size=60))
def test_no_course_of_events_yields_a_command_outside_the_limits(hand, events):
    bench = Bench(hand)
    bench.engage()
    last = None
    for event in events:
        wish = event.pop("wish")
        wish = None if wish is None else np.full(12, wish) if isinstance(wish, float) else np.array(wish)
        decision = bench.cycle(wish=wish, **event)
        assert np.isfinite(decision.position).all() and decision.mode in (Mode.PASSIVE, Mode.POSITION)
        if decision.mode == Mode.POSITION:
            assert np.all(decision.position >= hand.joint_lower - 1e-6)
            assert np.all(decision.position <= hand.joint_upper + 1e-6)
            near = bench.safety.sample.measured.joint_position if last is None else last
            assert np.abs(decision.position - near).max() <= 8.0 * CYCLE + 1e-5
        last = decision.position if decision.mode == Mode.POSITION else None
        if bench.safety.latched:
            assert decision.mode == Mode.PASSIVE


def test_limits_have_ranges():
    with pytest.raises(ConfigError, match=r"SafetyConfig\.temperature = 500 degC"):
        SafetyConfig(temperature=500.0)
    assert dataclasses.replace(SafetyConfig(), stale=0.1).stale == 0.1


@pytest.mark.parametrize(
    ("rate", "policy", "expected"),
    [
        (83.0, 100 / 3, 250 / 3),
        (83.0, 25.0, 83.0),
        (99.5, 25.0, 100.0),
        (83.0, 83.0, 83.0),
        (40.0, 1000.0, 40.0),
        (12.4, 25.0, 12.5),
    ],
)
def test_exchanges_keep_their_phase_with_the_policy(rate, policy, expected):
    kept = keep_phase(rate, policy)
    assert kept == pytest.approx(expected)
    if kept != rate:  # At the policy's deadlines an exchange is in one of at most two phases.
        phases = np.arange(40) / policy * kept % 1
        assert len({round(float(phase), 3) % 1 for phase in phases}) <= 2


@given(st.lists(st.one_of(st.floats(0.0, 0.05), st.floats(0.0119, 0.0132)), min_size=1, max_size=60))
def test_a_cycle_begins_at_a_deadline_or_a_little_after_and_skips_what_is_past(durations):
    clock = [0.0]

    def sleep(seconds):
        clock[0] += seconds

    pace, last, missed = Pace(250 / 3, lambda: clock[0], sleep), 0, 0
    for duration in durations:
        clock[0] += duration
        ready = clock[0]
        # The first deadline after the last one that is still to come, or has passed by the grace at most.
        index = last + 1
        while ready > index * CYCLE + GRACE:
            index += 1
        if abs(ready - index * CYCLE - GRACE) < 1e-9 or abs(ready - (index - 1) * CYCLE - GRACE) < 1e-9:
            return  # On the brink: rounding decides.
        pace.wait()
        assert clock[0] == pytest.approx(max(ready, index * CYCLE), abs=1e-9)
        missed, last = missed + index - last - 1, index
        assert pace.jitter.missed == missed and pace.jitter.worst <= GRACE + 1e-9
    assert pace.jitter.count == len(durations)


def test_the_policy_begins_while_the_line_is_busy(hand):
    loop = LoopThread(None, HandSensing(hand, HardwareConfig()), None, 250 / 3)
    for now in np.linspace(0, 0.2, 41) + loop.pace.next - 0.05:
        begin = loop.free(now)
        assert now <= begin < now + loop.pace.period + 1e-9
        since = (begin - loop.pace.next) % loop.pace.period
        assert since == pytest.approx(0.001, abs=1e-6)
