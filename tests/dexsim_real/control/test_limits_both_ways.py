"""Each limit of `Safety` on both of its sides: a limit of one side passes every test that pushes the other way."""

import numpy as np
import pytest
from test_safety import CYCLE, FREE, MIDDLE, Bench, sample

from dexsim_real.control.safety import Reaction
from dexsim_real.wire.frames import Mode

UP, DOWN = 1.0, -1.0


def ready(hand, **options):
    """A bench whose motors are on and whose ramp is over."""
    bench = Bench(hand, **options)
    bench.engage()
    bench.run(2.0, wish=MIDDLE)
    return bench


@pytest.mark.parametrize("way", [UP, DOWN])
def test_commands_keep_the_margin_from_either_end_stop(hand, way):
    bench = ready(hand, margin=0.05)
    bench.run(2.0, wish=np.full(12, way * 9.0))
    end = hand.joint_upper - 0.05 if way == UP else hand.joint_lower + 0.05
    np.testing.assert_allclose(bench.position, end, atol=1e-5)


@pytest.mark.parametrize("way", [UP, DOWN])
def test_motors_that_come_on_beyond_either_end_stop_begin_at_it(hand, way):
    """Not at the margin, which would be a jump."""
    bench = Bench(hand, margin=0.05)
    stop = np.asarray(hand.joint_upper if way == UP else hand.joint_lower, np.float32)
    bench.position = stop + np.float32(way * 0.04)
    bench.engage()
    np.testing.assert_array_equal(bench.cycle(follow=False).position, stop)


@pytest.mark.parametrize("way", [UP, DOWN])
def test_commands_move_at_most_at_the_speed_limit_in_either_direction(hand, way):
    bench = ready(hand, speed=2.0)
    path = np.array([bench.position] + [d.position for d in bench.run(0.1, wish=MIDDLE + np.float32(way * 0.5) * FREE)])
    np.testing.assert_allclose(np.diff(path, axis=0)[:, FREE > 0], way * 2.0 * CYCLE, rtol=1e-3)


@pytest.mark.parametrize("way", [UP, DOWN])
def test_commands_stop_at_reach_from_a_stuck_hand_in_either_direction(hand, way):
    bench = ready(hand, reach=0.2)
    decision = bench.run(1.0, wish=MIDDLE + np.float32(way * 0.7) * FREE, follow=False)[-1]
    assert decision.reaction == Reaction.CLIP
    np.testing.assert_allclose(decision.position, MIDDLE + np.float32(way * 0.2) * FREE, atol=1e-5)


@pytest.mark.parametrize("way", [UP, DOWN])
def test_reach_pulls_a_command_in_neither_direction(hand, way):
    """A hand that is pushed farther away than reach, slowly enough to be believed, takes no command along."""
    bench = ready(hand, reach=0.2)
    for k in range(60):
        bench.position = MIDDLE + np.float32(way * min(0.008 * k, 0.4)) * FREE
        decision = bench.cycle(wish=MIDDLE, follow=False)
        np.testing.assert_array_equal(decision.position, MIDDLE)
    assert decision.reaction == Reaction.NONE and bench.safety.counts["implausible: measurement"] == 0


@pytest.mark.parametrize("way", [UP, DOWN])
def test_a_joint_too_fast_in_either_direction_holds(hand, way):
    bench = ready(hand)
    for joint in range(12):
        bench.safety.see(sample(bench.now, MIDDLE, velocity=way * 21.0 * (np.arange(12) == joint)))
        bench.safety.set_target(MIDDLE, bench.now)
        decision = bench.safety.decide(bench.now)
        assert decision.reaction == Reaction.HOLD
        assert decision.reason.startswith(f"too fast: joint {hand.joint_names[joint]} (")
        bench.run(0.1, wish=MIDDLE)


@pytest.mark.parametrize("way", [UP, DOWN])
@pytest.mark.parametrize("pause", [0.02, 0.03, 0.06, 0.4])
def test_time_that_a_late_cycle_has_missed_is_not_made_up_for(hand, way, pause):
    """After a pause the next command moves by the speed limit times 30 ms at most."""
    bench = ready(hand, speed=2.0)
    bench.now += pause - CYCLE
    decision = bench.cycle(wish=MIDDLE + np.float32(way * 0.5) * FREE)
    assert decision.reaction == Reaction.CLIP
    np.testing.assert_allclose((decision.position - MIDDLE)[FREE > 0], way * 2.0 * min(pause, 0.03), rtol=1e-3)


@pytest.mark.parametrize("way", [UP, DOWN])
def test_too_much_force_eases_slowly_from_the_first_command_on(hand, way):
    bench = ready(hand)
    wish = MIDDLE + np.float32(way * 0.1) * FREE
    path = [bench.run(0.5, wish=wish, follow=False)[-1].position]
    path += [d.position for d in bench.run(0.1, wish=wish, follow=False, force=30.0)]
    np.testing.assert_allclose(np.diff(path, axis=0)[:, FREE > 0], -way * 0.5 * CYCLE, rtol=1e-3)


def test_wrong_readings_far_apart_do_not_add_up(hand):
    """One every two seconds for half a minute; each is a fault, but none of them lasts."""
    bench = ready(hand)
    for _ in range(15):
        bench.position = MIDDLE + np.float32(1.9) * (np.arange(12) == 4)
        bench.cycle(wish=MIDDLE, follow=False)
        bench.position = MIDDLE
        assert all(d.mode == Mode.POSITION for d in bench.run(2.0, wish=MIDDLE))
    assert bench.safety.counts["implausible: measurement"] == 15 and not bench.safety.latched


def test_a_target_of_before_the_motors_came_on_moves_nothing(hand):
    bench = Bench(hand)
    bench.run(0.15, wish=MIDDLE + np.float32(0.1) * FREE)
    bench.safety.set_target(MIDDLE + np.float32(0.1) * FREE, bench.now)
    bench.safety.engage()
    for decision in bench.run(0.05):
        assert decision.mode == Mode.POSITION
        np.testing.assert_array_equal(decision.position, MIDDLE)


def test_the_first_reason_for_motors_off_is_the_one_that_is_told(hand):
    bench = ready(hand)
    bench.safety.relax("the cable")
    bench.safety.relax("a later one")
    assert bench.cycle(wish=MIDDLE).reason == bench.safety.latched == "the cable"


@pytest.mark.parametrize(
    ("measurement", "held"),
    [
        ({"force": (13.9,) * 5}, False),  # 69.5 N together
        ({"force": (14.1,) * 5}, True),
        ({"force": (14.9, 0, 0, 0, 0)}, False),
        ({"force": (0, 0, 0, 0, 15.1)}, True),
        ({"velocity": 9.9}, False),
        ({"velocity": 10.1}, True),
        ({"velocity": -10.1}, True),
    ],
)
def test_a_firm_grasp_and_a_fast_joint_go_on_up_to_their_limits(hand, measurement, held):
    """By the defaults: 15 N a fingertip, 70 N all together, 10 rad/s."""
    bench = ready(hand)
    decision = bench.cycle(wish=MIDDLE, **measurement)
    assert decision.reaction == (Reaction.HOLD if held else Reaction.NONE)


def test_a_margin_of_more_than_half_the_range_leaves_the_middle(hand):
    """Limits that change sides would pull a joint away from where it was told to stay."""
    half = np.min(hand.joint_upper - hand.joint_lower) / 2
    bench = Bench(hand, margin=float(half) + 0.1)
    middle = ((hand.joint_lower + hand.joint_upper) / 2).astype(np.float32)
    narrow = hand.joint_upper - hand.joint_lower < 2 * (half + 0.1)
    assert narrow.any()
    bench.position = middle
    bench.engage()
    for way in (UP, DOWN):
        bench.run(2.0, wish=middle + np.float32(way * 9.0))
        np.testing.assert_allclose(bench.position[narrow], middle[narrow], atol=1e-5)


def test_a_clock_that_goes_back_moves_no_joint(hand):
    bench = ready(hand)
    before = bench.position.copy()
    bench.now -= 50.0
    for _ in range(20):
        bench.cycle(wish=MIDDLE + np.float32(0.5) * FREE)
    moved = np.abs(bench.position - before).max()
    assert moved <= 20 * CYCLE * 8.0 and (bench.position <= hand.joint_upper).all()
