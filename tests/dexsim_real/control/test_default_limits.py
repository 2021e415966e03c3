"""The limits of a first run: slower than the joints, away from the end stops, within the fingers' specification."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from test_safety import CYCLE, Bench, sample

from dexsim_ppo.policy import load_policy
from dexsim_real.control.limits import SafetyConfig
from dexsim_real.control.safety import Reaction, Safety
from dexsim_real.wire.frames import Mode

DEFAULTS = SafetyConfig()
MARGIN = 0.03  # rad
FINGER = 15.0  # N, fingertip force in the hand's specification


def test_defaults_are_below_what_the_hand_can_do(hand):
    assert DEFAULTS.speed < hand.speed_limit.min() and DEFAULTS.joint_speed < hand.speed_limit.max()
    assert DEFAULTS.finger_force <= FINGER and DEFAULTS.total_force <= 80.0
    assert DEFAULTS.margin >= MARGIN and DEFAULTS.margin <= 0.2 * (hand.joint_upper - hand.joint_lower).min()


@pytest.mark.parametrize("name", ["grasp", "rotate", "rotate_without_orientation"])
def test_the_speed_limit_lets_the_shipped_policies_move_as_in_training(name):
    policy = load_policy(name)
    assert policy.spec.control.step * policy.control_rate <= DEFAULTS.speed


@pytest.mark.parametrize("end", ["lower", "upper"])
def test_a_hand_at_its_end_stops_is_not_moved_by_the_motors_coming_on(hand, end):
    bench = Bench(hand, margin=MARGIN)
    stop = bench.position = (hand.joint_lower if end == "lower" else hand.joint_upper).astype(np.float32)
    bench.engage()
    first = bench.cycle()
    assert first.mode == Mode.POSITION
    np.testing.assert_array_equal(first.position, stop)
    # Nor by a hold there; a target moves it off the stop, slowly at first, and never back.
    bench.safety.set_target(stop, bench.now, "the object is out of sight")
    np.testing.assert_array_equal(bench.cycle().position, stop)
    path = np.array([bench.cycle(wish=stop).position for _ in range(200)])
    away = np.abs(path - stop)
    assert away[0].max() <= 0.55 * CYCLE and np.all(np.diff(away, axis=0) >= 0)
    np.testing.assert_allclose(away[-1], MARGIN, atol=1e-6)


@given(st.lists(st.floats(-3, 3), min_size=12, max_size=12), st.booleans())
def test_commands_stay_away_from_the_end_stops(hand, wish, hard):
    bench = Bench(hand, **vars(DEFAULTS))
    bench.engage()
    for _ in range(100):
        decision = bench.cycle(wish=np.array(wish), force=16.0 if hard else 0.0)
        assert np.all(decision.position >= hand.joint_lower + MARGIN - 1e-6)
        assert np.all(decision.position <= hand.joint_upper - MARGIN + 1e-6)


def test_the_margin_alone_is_no_event(hand):
    """Policies rest joints at their stops, which would otherwise hide every other clip."""
    bench = Bench(hand, margin=MARGIN, ramp=0.0)
    bench.engage()
    bench.run(1.0, wish=hand.joint_lower)
    assert bench.cycle(wish=hand.joint_lower).reaction == Reaction.NONE
    assert bench.cycle(wish=hand.joint_lower - 0.01).reaction == Reaction.CLIP
    assert bench.cycle(wish=hand.joint_upper).reaction == Reaction.CLIP  # Too fast.


@pytest.mark.parametrize(("newtons", "holds"), [(14.9, False), (15.1, True)])
def test_one_finger_above_its_specification_holds(hand, newtons, holds):
    safety = Safety(hand, DEFAULTS)
    for cycle in range(10):
        seen = sample(1 + cycle * CYCLE)
        seen.measured.taxel_force[2, 0] = newtons
        safety.see(seen)
        safety.engage()
    assert (safety.decide(1 + 9 * CYCLE).reason == "the fingertip force is too high") == holds
