"""Safety: every limit and its reaction, on both of its sides, over scripted and over random courses of events."""

import dataclasses

import numpy as np
import pytest

from dexsim_ppo.policy import load_policy
from dexsim_real.control.limits import SafetyConfig
from dexsim_real.control.pose_check import UNKNOWN
from dexsim_real.control.safety import HandSample, Reaction, Safety
from dexsim_real.core.errors import HandError
from dexsim_real.sensors.hand import HandMeasurement
from dexsim_real.wire.frames import Mode, empty_state

CYCLE = 0.012
AGREEING = 10  # readings that make a pose
SOFT = 0.5  # s, in which stiffness and speed grow after the motors came on
FREE = np.array([1, 1, 1, 0] + [1] * 8, np.float32)  # All but the joint whose range is small.
MIDDLE = np.array([0.9, 0.4, 0.8, 0.0] + [0.9] * 8, np.float32)
SAGGED = MIDDLE - np.float32(0.5) * FREE  # farther than one reading may be from the last with the motors on
WAYS = pytest.mark.parametrize("way", [np.float32(1), np.float32(-1)])
UNSEEN = "the object is out of sight"


def sample(
    time, position=MIDDLE, *, velocity=0.0, force=0.0, current=0.5, temperature=35.0, errors=0, mode=3, generation=1
):
    taxels = np.zeros((5, 120), np.float32)
    taxels[:, 0] = force
    measured = HandMeasurement(
        joint_position=np.array(position, np.float32),
        joint_torque=np.zeros(12, np.float32),
        taxel_force=taxels,
        current=np.full(12, current, np.float32),
        temperature=np.full(18, temperature, np.float32),
        errors=np.full((12, 3), errors, np.uint16),
        mode=np.full(12, mode, np.uint8),
    )
    return HandSample(time, 0, generation, measured, np.full(12, velocity, np.float32), empty_state())


class Bench:
    """A clock, a hand that stays where it is put or follows its commands at once, and the decisions made."""

    def __init__(self, hand, **options):
        self.notes = []
        self.safety = Safety(hand, SafetyConfig(**{"speed": 8.0, "margin": 0.0, **options}), self.notes.append)
        self.now, self.position = 10.0, MIDDLE

    def cycle(self, target=None, fresh=True, follow=True, hold="", read=None, **measurement):
        """One exchange; `read` [J] rad in place of the true angles."""
        if fresh:
            # A last bit of noise: angles that never change are a fault of their own.
            noise = np.float32(1e-7) * (round(self.now / CYCLE) % 2)
            self.safety.update(sample(self.now, self.position + noise if read is None else read, **measurement))
        if target is not None:
            self.safety.set_target(target, self.now, hold)
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


def ready(hand, **options):
    """A bench whose motors are on and whose ramp is over."""
    bench = Bench(hand, **options)
    bench.engage()
    bench.run(2.0, target=MIDDLE)
    return bench


# --- motors on ---------------------------------------------------------------------------------


def test_the_first_command_is_the_measured_pose_then_a_ramp(hand):
    bench = Bench(hand, ramp=2.0)
    bench.position = MIDDLE - np.float32(0.3) * FREE
    assert bench.cycle(fresh=False).mode == bench.cycle(target=MIDDLE).mode == Mode.PASSIVE, "not engaged"
    bench.engage()
    assert bench.safety.anchor == 0
    first = bench.cycle(follow=False)
    assert first.mode == Mode.POSITION and bench.safety.anchor == 1
    np.testing.assert_allclose(first.position, bench.position, atol=2e-7)
    path = np.array([first.position] + [d.position for d in bench.run(2.0, target=MIDDLE + np.float32(0.15))])
    speed = np.abs(np.diff(path, axis=0)).max(1) / CYCLE
    # Nothing moves while the motors stiffen; then slow_speed (0.5) grows to speed (8) within ramp (2 s).
    time = CYCLE + CYCLE * np.arange(len(speed))
    assert np.all(speed <= (time >= SOFT) * (0.5 + 7.5 * np.clip((time - SOFT) / 2, 0.0, 1.0) + 1e-3))
    np.testing.assert_allclose(path[-1], MIDDLE + 0.15, atol=1e-6)


def test_a_hold_does_not_shorten_the_start(hand):
    bench = Bench(hand)
    bench.engage()
    path = [d.position for d in bench.run(0.1, target=MIDDLE + np.float32(0.5) * FREE)]
    path += [d.position for d in bench.run(0.05, target=MIDDLE, hold=UNSEEN)]
    path += [d.position for d in bench.run(SOFT - 0.16, target=MIDDLE + np.float32(0.5) * FREE)]
    assert np.ptp(path, axis=0).max() == 0
    path = [d.position for d in bench.run(0.05, target=MIDDLE + np.float32(0.5) * FREE)]
    assert 0.4 < np.abs(np.diff(path, axis=0)).max() / CYCLE <= 0.5 + 7.5 * 0.05


def test_a_target_of_before_the_motors_came_on_moves_nothing(hand):
    bench = Bench(hand)
    bench.run(0.15, target=MIDDLE + np.float32(0.1) * FREE)
    bench.safety.engage()
    for decision in bench.run(0.3):
        assert decision.mode == Mode.POSITION and decision.reaction == Reaction.NONE
        np.testing.assert_allclose(decision.position, MIDDLE, atol=2e-7)


@WAYS
def test_motors_that_come_on_at_or_beyond_an_end_stop_begin_at_it(hand, way):
    """Not at the margin, which would be a jump; a target then moves it off the stop, slowly at first, never back."""
    bench = Bench(hand, margin=0.05)
    stop = np.asarray(hand.joint_upper if way > 0 else hand.joint_lower, np.float32)
    bench.position = stop + np.float32(0.09) * way
    bench.engage()
    np.testing.assert_array_equal(bench.cycle().position, stop)
    np.testing.assert_array_equal(bench.cycle(target=stop, hold=UNSEEN).position, stop)
    away = np.abs([bench.cycle(target=stop).position - stop for _ in range(200)])
    assert away[0].max() <= 0.55 * CYCLE and np.all(np.diff(away, axis=0) >= 0)
    np.testing.assert_allclose(away[-1], 0.05, atol=1e-6)


def test_the_motors_do_not_come_on_at_a_pose_that_was_measured_a_while_ago(hand):
    """Asked for while the hand is silent, which somebody may be moving meanwhile."""
    bench = Bench(hand)
    bench.engage()
    bench.now += 0.06  # s
    asked = bench.run(0.5, target=MIDDLE, fresh=False)
    assert {(decision.mode, decision.reason) for decision in asked} == {(Mode.PASSIVE, "no measurement")}
    bench.position = SAGGED
    modes = [bench.cycle(target=MIDDLE).mode for _ in range(2 * AGREEING)]
    assert Mode.POSITION in modes and not bench.safety.latched
    assert np.abs(bench.safety.commanded - SAGGED).max() < 0.03


# --- limits of commands ------------------------------------------------------------------------


@WAYS
def test_commands_keep_the_margin_from_either_end_stop(hand, way):
    bench = ready(hand, margin=0.05)
    bench.run(2.0, target=np.full(12, way * 9.0))
    end = hand.joint_upper - 0.05 if way > 0 else hand.joint_lower + 0.05
    np.testing.assert_allclose(bench.position, end, atol=1e-5)


@WAYS
def test_commands_move_at_most_at_the_speed_limit(hand, way):
    bench = ready(hand, speed=2.0)
    decisions = bench.run(0.1, target=MIDDLE + way * np.float32(0.5) * FREE)
    path = np.array([MIDDLE, *(decision.position for decision in decisions)])
    np.testing.assert_allclose(np.diff(path, axis=0)[:, FREE > 0], way * 2.0 * CYCLE, rtol=1e-3)
    assert decisions[0].reaction == Reaction.CLIP


@pytest.mark.parametrize("force", [0.0, 16.0])
def test_no_command_is_faster_than_a_speed_below_the_slow_one(hand, force):
    bench = Bench(hand, speed=0.1, slow_speed=0.5, reach=4.0)
    bench.engage()
    path = [bench.cycle(target=hand.joint_upper, follow=False).position for _ in range(100)]
    path += [bench.cycle(target=hand.joint_upper, follow=False, force=force).position for _ in range(100)]
    assert 0.05 < np.abs(np.diff(path, axis=0)).max() / CYCLE <= 0.1 + 1e-4


@WAYS
def test_commands_stop_at_reach_from_a_stuck_hand(hand, way):
    bench = ready(hand, reach=0.2)
    decision = bench.run(0.4, target=MIDDLE + way * np.float32(0.7) * FREE, follow=False)[-1]
    assert decision.reaction == Reaction.CLIP
    np.testing.assert_allclose(decision.position, MIDDLE + way * np.float32(0.2) * FREE, atol=1e-5)


@WAYS
def test_reach_pulls_no_command(hand, way):
    """A hand that is pushed farther away than reach, slowly enough to be believed, takes no command along."""
    bench = ready(hand, reach=0.2)
    for k in range(60):
        bench.position = MIDDLE + way * np.float32(min(0.008 * k, 0.4)) * FREE
        decision = bench.cycle(target=MIDDLE, follow=False)
        np.testing.assert_array_equal(decision.position, MIDDLE)
    assert decision.reaction == Reaction.NONE and bench.safety.counts["implausible: measurement"] == 0


@WAYS
@pytest.mark.parametrize("pause", [0.02, 0.4])
def test_time_that_a_late_cycle_has_missed_is_not_made_up_for(hand, way, pause):
    """After a pause the next command moves by the speed limit times 30 ms at most."""
    bench = ready(hand, speed=2.0)
    bench.now += pause - CYCLE
    decision = bench.cycle(target=MIDDLE + way * np.float32(0.5) * FREE)
    np.testing.assert_allclose((decision.position - MIDDLE)[FREE > 0], way * 2.0 * min(pause, 0.03), rtol=1e-3)


@pytest.mark.parametrize("back", [0.03, 0.5, 50.0])
def test_a_clock_that_goes_back_moves_no_joint_away(bench, back):
    """Also where the speed has just begun to grow, after a hold."""
    bench.cycle(target=MIDDLE, hold=UNSEEN)
    before, target = bench.cycle(target=MIDDLE).position, MIDDLE + np.float32(0.5) * FREE
    bench.now -= back
    np.testing.assert_array_equal(bench.cycle(target=target).position, before)
    assert np.all(bench.run(0.1, target=target)[-1].position >= before)


def test_the_defaults_are_below_what_the_hand_can_do_and_above_what_policies_ask(hand):
    limits = SafetyConfig()
    assert limits.speed < hand.speed_limit.min() and limits.joint_speed < hand.speed_limit.max()
    assert limits.finger_force <= 15.0 and limits.total_force <= 80.0, "N, of the hand's specification"
    assert 60.0 <= limits.temperature <= 70.0, "degC: motors at work are warm"
    assert limits.reach <= 0.6, "rad, to which a stuck joint is driven"
    assert 0.03 <= limits.margin <= 0.2 * (hand.joint_upper - hand.joint_lower).min()
    assert limits.stale >= 3 * 0.012, "s: two answers may be lost"
    for name in ("grasp", "rotate", "rotate_clear", "rotate_without_orientation"):
        policy = load_policy(name)
        assert policy.spec.control.step * policy.control_rate <= limits.speed or name == "rotate", "that one is clipped"
        assert limits.watchdog >= 2 / policy.control_rate, "a target may be late by a tick"


# --- holds ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("measurement", "held"),
    [
        ({"force": (13.9,) * 5}, False),  # 69.5 N together
        ({"force": (14.1,) * 5}, True),
        ({"force": (14.9, 0, 0, 0, 0)}, False),
        ({"force": (0, 0, 0, 0, 15.1)}, True),
        *(
            ({"velocity": way * speed * (np.arange(12) == joint)}, speed > 10)
            for way, speed, joint in [(1, 9.9, 3), (1, 10.1, 0), (-1, 10.1, 11), (-1, 9.9, 5)]
        ),
    ],
)
def test_a_firm_grasp_and_a_fast_joint_go_on_up_to_their_limits(bench, measurement, held):
    """By the defaults: 15 N a fingertip, 70 N all together, 10 rad/s. Then commands begin where they were, slowly."""
    bench.run(0.15, target=MIDDLE + np.float32(0.2))
    before = bench.position.copy()
    decisions = bench.run(3.0, target=before, follow=False, **measurement)
    assert {decision.reaction for decision in decisions} == {Reaction.HOLD if held else Reaction.NONE}
    np.testing.assert_allclose(decisions[-1].position, before, atol=2e-7)
    after = bench.cycle(target=MIDDLE + np.float32(0.3))
    assert not held or np.abs(after.position - before).max() <= 0.7 * CYCLE


@pytest.mark.parametrize(
    "event", [{"velocity": 25.0}, *({"target": np.where(np.arange(12) == 7, bad, 1)} for bad in (np.nan, -np.inf))]
)
def test_hold_keeps_the_last_confirmed_command_and_does_not_last_for_ever(bench, event):
    """The hand is pressed away from its command; hold keeps the command."""
    target = MIDDLE + np.float32(0.15) * FREE
    bench.run(1.0, target=target)
    bench.position = MIDDLE
    bench.cycle(target=target, follow=False)
    for _ in range(20):
        decision = bench.cycle(**{"target": target, "follow": False} | event)
        assert decision.reaction == Reaction.HOLD and decision.mode == Mode.POSITION
        np.testing.assert_array_equal(decision.position, target)
    assert bench.cycle(target=target).reaction < Reaction.HOLD
    modes = [decision.mode != 0 for decision in bench.run(6.0, **{"target": target} | event)]
    assert 4.7 <= sum(modes) * CYCLE < 4.8 and not modes[-1] and bench.safety.latched.endswith("for 5 s")


def test_a_command_that_was_not_answered_is_not_held(bench):
    confirmed = bench.cycle(target=MIDDLE + np.float32(0.02), follow=False).position
    bench.cycle(target=MIDDLE + np.float32(0.04), follow=False)  # Its measurement confirms the one before.
    bench.cycle(target=MIDDLE + np.float32(0.06), fresh=False, follow=False)
    held = bench.cycle(target=np.full(12, np.nan), fresh=False).position
    np.testing.assert_array_equal(held, confirmed)


@WAYS
def test_too_much_force_eases_slowly_toward_the_measured_pose(bench, way):
    """Keeping the command would keep the force."""
    target = MIDDLE + way * np.float32(0.1) * FREE
    path = [bench.run(0.5, target=target, follow=False)[-1].position]
    path += [d.position for d in bench.run(0.5, target=target, follow=False, force=30.0)]
    np.testing.assert_allclose(np.diff(path, axis=0)[:8, FREE > 0], -way * 0.475 * CYCLE, rtol=1e-3)
    np.testing.assert_allclose(path[-1], MIDDLE, atol=1e-6)


@pytest.mark.parametrize(("pause", "eased"), [(0.4, 0.1), (0.6, 0.15)])
def test_holds_for_force_with_a_short_pause_ease_by_a_tenth_of_a_radian_together(bench, pause, eased):
    """Meanwhile the measured pose moves by 0.15 rad; after a longer pause easing begins from where it is then."""
    bench.run(0.3, target=MIDDLE, follow=False, force=30.0)
    ticks = round(pause / CYCLE)
    for k in range(ticks):
        bench.position = MIDDLE - np.float32(0.15 * (k + 1) / ticks) * FREE
        bench.cycle(target=MIDDLE, follow=False)
    last = bench.run(0.8, target=MIDDLE, follow=False, force=30.0)[-1]
    np.testing.assert_allclose(last.position, MIDDLE - np.float32(eased) * FREE, atol=1e-3)


# --- motors off ----------------------------------------------------------------------------------


@pytest.mark.parametrize("cause", ["no target", UNSEEN])
@pytest.mark.parametrize("other", [{}, {"force": 16.0}, {"velocity": 20.0}])
def test_a_cause_that_lasts_turns_the_motors_off_whatever_else_interrupts(bench, cause, other):
    start, k, reactions = bench.now, 0, []
    while not bench.safety.latched and bench.now < start + 5:
        target = MIDDLE if cause == UNSEEN else None
        reactions.append(bench.cycle(target, hold=UNSEEN, **other if k % 30 == 0 else {}).reaction)
        k += 1
    assert bench.safety.latched == f"{cause} for 1 s" and 1.0 < bench.now - start < 1.2
    assert reactions[round(0.1 / CYCLE)] == Reaction.HOLD, "held within 100 ms"
    assert bench.cycle(target=MIDDLE).mode == Mode.PASSIVE
    bench.safety.relax("a later one")
    assert bench.cycle(target=MIDDLE).reason == f"{cause} for 1 s", "the first reason is told"


def test_a_silent_hand_is_held_then_relaxed_then_taken_up_where_it_is(bench):
    """Neither at the last command before it nor at the target; and the policy that waited for it is not dead."""
    anchor = bench.safety.anchor
    decisions = bench.run(2.0, target=MIDDLE, fresh=False)
    reactions = [decision.reaction for decision in decisions]
    assert reactions.index(Reaction.HOLD) * CYCLE <= 0.1 and reactions[-1] == Reaction.RELAX
    assert {decision.reason for decision in decisions[10:]} == {"no measurement"} and not bench.safety.latched
    bench.position = SAGGED
    assert {bench.cycle().reason for _ in range(AGREEING - 1)} == {UNKNOWN}
    decision = bench.cycle()
    assert decision.mode == Mode.POSITION and bench.safety.anchor > anchor
    assert np.abs(decision.position - bench.position).max() <= 0.7 * CYCLE


@pytest.mark.parametrize("hold", ["", UNSEEN])
def test_time_before_the_motors_came_on_again_does_not_count(bench, hold):
    """The target, and the cause that lasts, are as old as the silence: the policy gets its second anew."""
    bench.cycle(target=MIDDLE, hold=hold)
    bench.run(3.0, fresh=False)
    back = [bench.cycle() for _ in range(AGREEING - 1 + round(0.9 / CYCLE))]
    assert {decision.mode for decision in back[AGREEING:]} == {Mode.POSITION} and not bench.safety.latched
    assert bench.run(0.3)[-1].mode == Mode.PASSIVE and bench.safety.latched.endswith("for 1 s")


def test_short_silences_do_not_turn_the_motors_off_unless_they_are_most_of_the_time(bench):
    """Each counts for itself; but a hand that answers now and then is not held for ever."""
    for _ in range(3):
        decisions = bench.run(0.9, target=MIDDLE, fresh=False) + bench.run(0.1, target=MIDDLE)
        assert {decision.mode for decision in decisions} == {Mode.POSITION}
    bench.run(12.0, target=MIDDLE)
    for _ in range(8):
        bench.run(0.9, target=MIDDLE, fresh=False)
        bench.run(0.1, target=MIDDLE)
    assert bench.safety.latched == "no measurement for 5 s"


def test_a_hand_that_is_lost_again_and_again_is_not_taken_up_for_ever(bench):
    """Motors off after each silence and on again: the silences add up."""
    modes = []
    for _ in range(8):
        modes += [decision.mode for decision in bench.run(1.2, target=MIDDLE, fresh=False)]
        modes += [decision.mode for decision in bench.run(0.3, target=MIDDLE)]
    assert bench.safety.latched == "no measurement for 5 s"
    assert np.count_nonzero(np.diff(modes)) >= 8, "taken up at first"


@pytest.mark.parametrize("hold", ["", UNSEEN])
def test_a_reconnected_hand_starts_from_its_pose(bench, hold):
    """Also during a hold: its motors were off."""
    anchor = bench.safety.anchor
    bench.cycle(target=MIDDLE, hold=hold)
    bench.position = MIDDLE - np.float32(0.5) * FREE
    for _ in range(AGREEING - 1):
        assert bench.cycle(target=MIDDLE, hold=hold, generation=2).mode == Mode.PASSIVE
    first = bench.cycle(target=MIDDLE, hold=hold, generation=2, follow=False)
    np.testing.assert_allclose(first.position, bench.position, atol=0.7 * CYCLE)
    assert bench.safety.anchor == anchor + 1 and first.reason == (hold or first.reason)


def test_a_margin_of_more_than_half_the_range_leaves_the_middle(hand):
    """Limits that change sides would pull a joint away from where it was told to stay."""
    half = np.min(hand.joint_upper - hand.joint_lower) / 2
    bench = Bench(hand, margin=float(half) + 0.1)
    bench.position = middle = ((hand.joint_lower + hand.joint_upper) / 2).astype(np.float32)
    narrow = hand.joint_upper - hand.joint_lower < 2 * (half + 0.1)
    bench.engage()
    for way in (1, -1):
        bench.run(2.0, target=middle + np.float32(way * 9.0))
        np.testing.assert_allclose(bench.position[narrow], middle[narrow], atol=1e-5)


def test_a_model_whose_joints_may_turn_for_ever_is_refused(hand):
    """Its limits would limit nothing."""
    for limit in (1e30, np.inf, np.nan):
        with pytest.raises(HandError, match="a joint's limits are beyond a turn"):
            Safety(dataclasses.replace(hand, joint_upper=np.full(12, limit)), SafetyConfig())
