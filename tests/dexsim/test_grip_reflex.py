"""The grip reflex against closed forms, and its limits. `test_force_loop.py` compares bridge and simulation."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dexsim.control import Control, closing, reflex_target
from dexsim.core.errors import ConfigError
from dexsim.force_loop import target_force
from dexsim.grip_reflex import GripReflex, move_reflex
from dexsim.hand.load import load_hand
from dexsim.task_spec import TaskSpec, next_target

SPAN, PERIOD = (2.0, 7.0), 0.03
REFLEX = GripReflex(gain=0.02, limit=0.3, slew=0.5)
FORCES = st.lists(st.floats(0, 60), min_size=5, max_size=5)


def test_a_spring_under_a_finger_is_pressed_to_the_force_that_is_wanted():
    """Force = stiffness times angle: the angle approaches what gives the force, with rate gain times stiffness."""
    stiffness, wanted, angle, found = 30.0, 4.0, jnp.zeros(5), []
    for _ in range(300):
        force = 1.0 + stiffness * angle
        angle = move_reflex(REFLEX, PERIOD, angle, jnp.asarray(wanted), force)
        found.append(np.asarray(angle))
    final = (wanted - 1.0) / stiffness
    expected = final * (1 - (1 - REFLEX.gain * stiffness * PERIOD) ** np.arange(1, 301))
    np.testing.assert_allclose(np.array(found)[:, 1:], np.repeat(expected[:, None], 4, 1), atol=1e-5)
    assert np.all(np.array(found)[:, 0] == 0), "the thumb has no reflex"


def test_a_finger_in_the_air_loses_its_angle_and_does_not_close_on_nothing():
    angle = jnp.array([0.0, 0.1, -0.1, 0.004, 0.0])
    after = move_reflex(REFLEX, PERIOD, angle, jnp.asarray(7.0), jnp.zeros(5))
    np.testing.assert_allclose(after, [0.0, 0.085, -0.085, 0.0, 0.0], atol=1e-6)


@given(FORCES, st.floats(-0.3, 0.3), st.floats(0.001, 1.0), st.floats(0.01, 5.0), st.floats(0, 1.5))
def test_its_limits_hold_whatever_is_measured(force, start, gain, slew, command):
    reflex = GripReflex(gain=gain, limit=0.3, slew=slew)
    wanted = target_force(jnp.asarray(command), SPAN)
    angle = jnp.full(5, start).at[0].set(0.0)
    after = np.asarray(move_reflex(reflex, PERIOD, angle, wanted, jnp.asarray(force)))
    assert np.all(np.abs(after) <= 0.3 + 1e-6) and np.all(np.abs(after - angle) <= slew * PERIOD + 1e-6)


def test_closing_brings_every_fingertip_nearer_to_what_is_grasped(hand):
    from dexsim.hand.kinematics import forward_kinematics

    posture, centre = np.array(hand.grasp_posture, np.float32), np.array(hand.grasp_centre)
    for finger in range(1, hand.num_fingers):
        angle = jnp.zeros(hand.num_fingers).at[finger].set(0.05)
        added = np.asarray(reflex_target(hand, angle))
        assert np.count_nonzero(added) == 1 and abs(added[hand.root_joint[finger]]) == pytest.approx(0.05)
        near, nearer = (
            np.linalg.norm(np.asarray(forward_kinematics(hand, posture + by).tip_position)[finger] - centre)
            for by in (0.0, added)
        )
        assert nearer < near - 1e-3


def readings_of(hand, felt):
    """Only what the reflex reads."""

    class Readings:
        taxel_force = jnp.zeros((5, hand.num_taxels)).at[:, 0].set(jnp.asarray(felt))
        joint_torque = jnp.zeros(12)
        command = jnp.asarray(1.0)

    return Readings()


@pytest.mark.slow
@pytest.mark.parametrize("name", [None, "leap_like", "inspire_like"])
def test_every_shipped_hand_closes_with_positive_angles_and_its_mirror_image_with_negative_ones(name):
    """As their makers count them. In LEAP's posture the fingertips are beyond the point nearest to the grasp."""
    hand = load_hand(name)
    np.testing.assert_array_equal(closing(hand), np.ones(hand.num_fingers))
    mirrored = dataclasses.replace(
        hand,
        joint_axis=-hand.joint_axis,
        joint_lower=-hand.joint_upper,
        joint_upper=-hand.joint_lower,
        body_offset=-hand.body_offset,
        joint_reference=-hand.joint_reference,
        grasp_posture=tuple(-angle for angle in hand.grasp_posture),
    )
    np.testing.assert_array_equal(closing(mirrored), -np.ones(hand.num_fingers))


def test_targets_stay_within_reach_and_what_is_cut_off_does_not_wind_up(hand):
    control = Control(reach=0.1, reflex=GripReflex(gain=1.0, limit=1.0, slew=10.0))
    spec = TaskSpec(name="hold", fields=(), control=control, finger_force=SPAN)
    measured = jnp.full(12, 0.1)
    readings, target, reflex = readings_of(hand, [1.0] * 5), measured, jnp.zeros(5)
    for _ in range(50):  # No force comes: the fingers are blocked.
        target, reflex = next_target(spec, hand, PERIOD, readings, target, reflex, jnp.zeros(12), measured)
    assert np.all(np.abs(target - measured) <= 0.1 + 1e-6)
    np.testing.assert_allclose(reflex, [0.0, 0.1, 0.1, 0.1, 0.1], atol=1e-6)
    heavy = readings_of(hand, [1.0, 30.0, 30.0, 30.0, 30.0])
    after, less = next_target(spec, hand, PERIOD, heavy, target, reflex, jnp.zeros(12), measured)
    assert np.all(np.asarray(less)[1:] <= reflex[1:] - 0.15), "it answers at once, for nothing has wound up"
    assert np.all(np.asarray(closing(hand)[1:] * (after - target)[hand.root_joint[1:]]) < -0.15)


def test_a_task_without_a_force_command_refuses_a_reflex():
    with pytest.raises(ConfigError, match="Control.reflex needs a force command"):
        TaskSpec(name="turn", fields=(), control=Control(reflex=REFLEX))
