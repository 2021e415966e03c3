"""From actions to joint targets and what of them an observation shows; the force loop around a policy, against closed
forms; its estimate of force; the same on the bridge."""

import copy
import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dexsim.control import Control, ForceLoop, correct_command, move_target, observed_action
from dexsim.errors import ConfigError
from dexsim.touch.reduce import estimate_force

SPAN, PERIOD = (2.0, 7.0), 0.03
LOOP = ForceLoop(gain=0.5, limit=0.6)
correct = jax.jit(correct_command, static_argnums=(0, 1, 2))


def test_a_target_moves_by_the_action_within_reach_and_limits(hand):
    """Joint by joint: free, held back by reach on either side, by the end stop on either side; in this order."""
    control = Control(step=0.2, reach=0.3)
    lower, upper = (np.asarray(x, np.float32) for x in (hand.joint_lower, hand.joint_upper))
    middle = (lower + upper) / 2
    target, measured, action = middle.copy(), middle.copy(), np.zeros(12, np.float32)
    wanted = middle.copy()
    action[0], wanted[0] = -0.5, middle[0] - 0.1
    measured[4], action[4], wanted[4] = middle[4] - 0.25, 1.0, middle[4] + 0.05
    measured[5], action[5], wanted[5] = middle[5] + 0.25, -1.0, middle[5] - 0.05
    target[6] = measured[6] = upper[6] - 0.1
    action[6], wanted[6] = 1.0, upper[6]
    target[7] = measured[7] = lower[7] + 0.1
    action[7], wanted[7] = -1.0, lower[7]
    # A target left far behind by its joint comes after it without any action.
    measured[8], wanted[8] = middle[8] + 0.5, middle[8] + 0.2
    # A joint pushed beyond its stop does not take the target with it.
    target[9] = upper[9]
    measured[9], wanted[9] = upper[9] + 0.4, upper[9]
    found = move_target(control, hand, *(jnp.asarray(x) for x in (target, action, measured)))
    np.testing.assert_allclose(found, wanted, atol=1e-6)


def test_a_recalled_target_is_a_place_in_its_joints_range(hand):
    lower, upper = (np.asarray(x, np.float32) for x in (hand.joint_lower, hand.joint_upper))
    action = jnp.linspace(-1, 1, 12)
    for share, place in ((0.0, -1.0), (0.5, 0.0), (0.75, 0.5), (1.0, 1.0)):
        target = jnp.asarray(lower + share * (upper - lower))
        found = observed_action(Control(last_action_encoding="target"), hand, action, target)
        np.testing.assert_allclose(found, np.full(12, place), atol=1e-5)
        np.testing.assert_array_equal(observed_action(Control(), hand, action, target), action)
    with pytest.raises(ConfigError, match="last_action_encoding = 'nothing': choose from action, target"):
        Control(last_action_encoding="nothing")


def fingers(*force):
    return jnp.asarray(force, jnp.float32)


def test_the_correction_of_a_weak_grip_follows_its_differential_equation():
    """A grip with 0.8 of the shown force: the correction approaches what closes the gap, with rate gain times slope."""
    command, slope, found, correction = 0.5, 0.8, [], jnp.zeros(())
    for _ in range(400):
        force = SPAN[0] + slope * (command + correction) * (SPAN[1] - SPAN[0])
        correction = correct(LOOP, SPAN, PERIOD, jnp.asarray(command), correction, fingers(9.0, *[force] * 4))
        found.append(float(correction))
    final, steps = command / slope - command, np.arange(1, 401)
    np.testing.assert_allclose(found, final * (1 - (1 - LOOP.gain * slope * PERIOD) ** steps), atol=1e-5)
    assert abs(found[-1] - final) < 0.01


@pytest.mark.parametrize(
    ("force", "moves"),
    [((0, 4, 0, 0, 0), False), ((9, 0, 0, 0, 0), False), ((9, 4, 0, 0, 0), False), ((0, 4, 0, 0, 2), True)],
)
def test_it_waits_for_two_fingers_beside_the_thumb(force, moves):
    after = correct(LOOP, SPAN, PERIOD, jnp.asarray(1.0), jnp.asarray(0.2), fingers(*force))
    assert float(after) == pytest.approx(0.2 + moves * 0.5 * (1 - (3 - 2) / 5) * PERIOD)


@pytest.mark.parametrize(
    ("command", "force", "rest"),
    [(0.5, 2.1, 0.6), (1.0, 2.1, 0.5), (0.2, 60.0, -0.2), (0.9, 60.0, -0.6), (0.0, 60.0, 0.0)],
)
def test_it_rests_at_its_limit_or_at_the_ends_of_what_a_policy_is_shown(command, force, rest):
    """A grip that cannot follow: the command shown is between 0 and 1.5, the correction 0.6 at most."""
    loop, correction, steps = ForceLoop(gain=20.0, limit=0.6), jnp.zeros(()), [0.0]
    for _ in range(60):
        correction = correct(loop, SPAN, PERIOD, jnp.asarray(command), correction, fingers(0, force, force, 0, 0))
        steps.append(float(correction))
    assert steps[-1] == pytest.approx(rest, abs=1e-6)
    if rest:
        assert abs(steps[1]) == pytest.approx(1.0 * PERIOD, rel=1e-5), "no faster, and as fast as allowed"


def test_an_estimate_is_the_taxels_and_a_share_of_what_the_torque_adds_and_zero_without_touch(hand):
    taxels = np.zeros((5, hand.num_taxels), np.float32)
    taxels[:, 3] = [2.0, 0.5, 0.0, 6.0, 0.05]
    torque = np.zeros(12, np.float32)
    torque[hand.root_joint] = [0.1, -0.2, 0.3, 0.1, 0.4]
    gain = np.float32([8.0, 15.0, 13.0, 14.0, 15.0]) / hand.torque_limit[hand.root_joint]
    calibrated = dataclasses.replace(hand, force_per_torque=gain)
    for share, second in ((1.0, 3.0), (0.5, 1.75), (0.0, 0.5)):
        found = estimate_force(share, calibrated, taxels, torque)
        np.testing.assert_allclose(found, [2.0, second, 0.0, 6.0, 0.0], rtol=1e-6)
    unknown = dataclasses.replace(hand, force_per_torque=np.zeros(5, np.float32))
    np.testing.assert_allclose(estimate_force(0.4, unknown, taxels, torque), [2.0, 0.5, 0.0, 6.0, 0.0])


def test_bridge_and_simulation_show_the_policy_the_same_command_and_send_the_same_targets(
    hand, grasp_env, grasp_rollout
):
    """The environment's readings, given to the controller with the user's command, lead to the same corrections of the
    command by the force loop; in both the action of a reading is the one that led to it."""
    pytest.importorskip("serial")
    from dexsim_real.control.controller import Controller
    from dexsim_real.sensors.camera import ObjectEstimate
    from dexsim_real.sensors.hand import HandMeasurement

    env, rng = grasp_env, np.random.default_rng(0)

    class Close:
        task, spec, control_rate = env.name, env.spec, 1 / env.control_period
        observation_layout = env.observation_layout["actor"]

        def initial_carry(self):
            return None

        def act(self, carry, observation):
            return carry, rng.uniform(-0.3, 0.7, 12).astype(np.float32)

    state, first = grasp_rollout.reset(jax.random.key(3)), Controller(Close(), hand)
    controllers = [copy.copy(first) for _ in range(4)]  # which share what is compiled
    for index, controller in enumerate(controllers):
        controller.start(np.asarray(state.joint_target[index]))
    shown, wanted, nothing, sent, targets = [], [], np.zeros(1), [], []
    actions = np.zeros((8, 12), np.float32)
    for _ in range(40):
        readings, true = jax.device_get((state.readings, state.physics.qpos[:, env.physics.joint_qpos]))
        for index, controller in enumerate(controllers):
            row = jax.tree.map(lambda x, i=index: x[i], readings)
            # Targets are kept near the true angles in simulation, near the measured ones on the hand.
            measured = HandMeasurement(
                true[index], row.joint_torque, row.taxel_force, row.joint_torque, nothing, nothing, nothing
            )
            seen = ObjectEstimate(row.object_position, row.object_velocity, row.object_quat)
            command = float(state.goal.command[index])
            tick = controller.tick(measured, seen, row.goal_quat, command)
            np.testing.assert_array_equal(tick.readings.last_action, actions[index])
            for name in ("last_action", "past_actions"):
                np.testing.assert_allclose(getattr(tick.readings, name), getattr(row, name), atol=1e-6)
            shown.append(float(tick.readings.command))
            wanted.append(float(row.command))
            sent.append(tick.target)
            actions[index] = tick.action
        state = grasp_rollout.step(state, jnp.asarray(actions))
        targets += list(np.asarray(state.joint_target)[: len(controllers)])
    np.testing.assert_allclose(shown, wanted, atol=1e-6)
    np.testing.assert_allclose(sent, targets, atol=1e-5)
    assert np.abs(np.asarray(state.correction)[: len(controllers)]).max() > 0.02, "no hand has pressed"
