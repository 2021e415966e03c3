"""The grip reflex against closed forms; its limits; the same on the bridge; a policy's file carries it."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dexsim.control import Control, closing, reflex_target
from dexsim.core.errors import ConfigError
from dexsim.grip_reflex import GripReflex, move_reflex, wanted_force
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
    wanted = wanted_force("finger", SPAN, jnp.asarray(command), jnp.ones(5, bool))
    angle = jnp.full(5, start).at[0].set(0.0)
    after = np.asarray(move_reflex(reflex, PERIOD, angle, wanted, jnp.asarray(force)))
    assert np.all(np.abs(after) <= 0.3 + 1e-6) and np.all(np.abs(after - angle) <= slew * PERIOD + 1e-6)


@pytest.mark.parametrize(("force_command", "wanted"), [("finger", 4.5), ("squeeze", 1.5)])
def test_a_squeeze_is_shared_among_the_fingers_that_touch(force_command, wanted):
    touching = jnp.array([True, True, False, True, True])
    assert float(wanted_force(force_command, SPAN, jnp.asarray(0.5), touching)) == pytest.approx(wanted)


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


def test_bridge_and_simulation_send_the_same_targets(hand):
    """The environment's readings, given to the controller, lead to the targets of the environment."""
    pytest.importorskip("serial")
    import dexsim
    from dexsim.tasks.grasp.config import GraspConfig
    from dexsim_real.control.controller import Controller
    from dexsim_real.sensors.hand import HandMeasurement
    from dexsim_real.sensors.readings import ObjectEstimate

    config = GraspConfig(pool_size=64)
    control = dataclasses.replace(config.control, reflex=dataclasses.replace(REFLEX, gain=0.1))
    env = dexsim.make("grasp", dataclasses.replace(config, control=control), num_envs=8)

    class Close:
        task, spec, control_rate = env.name, env.spec, env.control_rate
        observation_layout = env.observation_layout["actor"]

        def __call__(self, observation):
            return np.full(12, 0.2, np.float32)

    state = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(3), 8))
    step, controllers = jax.jit(jax.vmap(env.step)), [Controller(Close(), hand) for _ in range(8)]
    for index, controller in enumerate(controllers):
        controller.start(np.asarray(state.joint_target[index]))
    sent, wanted, nothing, largest = [], [], np.zeros(1), 0.0
    encoder = jax.jit(jax.vmap(lambda s: env.motors.encoder(s.physics.qpos[env.physics.joint_qpos], s.gear)))
    for _ in range(60):
        before, true = jax.device_get((state, encoder(state)))
        for index, controller in enumerate(controllers):
            row = jax.tree.map(lambda x, i=index: x[i], before.readings)
            # Targets are kept near the true angles in simulation, near the measured ones on the hand.
            measured = HandMeasurement(
                true[index], row.joint_torque, row.taxel_force, row.joint_torque, nothing, nothing, nothing
            )
            seen = ObjectEstimate(row.object_position, row.object_velocity, row.object_quat)
            command = float(before.goal.command[index])
            sent.append(controller.tick(measured, seen, row.goal_quat, command).target)
        state = step(state, jnp.full((8, 12), 0.2))
        wanted += list(np.asarray(state.joint_target))
        largest = max(largest, float(np.abs(np.asarray(state.reflex)).max()))
    np.testing.assert_allclose(sent, wanted, atol=1e-5)
    assert largest > 0.02, "no hand has pressed"
