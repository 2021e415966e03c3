"""The policies in assets/policies: load without a simulator, fit tasks and left hand of today, act, hold and turn."""

import dataclasses
import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from episodes import POOL_SIZE, reset_to

import dexsim
from dexsim import observation
from dexsim.core.compilation import jit
from dexsim.core.config import from_dict
from dexsim.errors import ConfigError
from dexsim.observation import GRASP, ROTATE, layout
from dexsim.registry import TASKS, find_task, make_task
from dexsim.task_spec import TaskSpec
from dexsim.tasks.grasp.task import GraspGoal
from dexsim_ppo.policy import load_policy

SHIPPED = {
    "grasp": (GRASP, 66),
    "rotate": (ROTATE, 92),
    "rotate_without_orientation": (ROTATE, 86),
    "rotate_clear": (ROTATE, 65),
}


@pytest.mark.parametrize("name", SHIPPED)
def test_it_fits_the_task_and_the_hand(hand, name):
    policy, (names, size) = load_policy(name), SHIPPED[name]
    config = from_dict(TASKS[policy.task].config_class, policy.env_config)
    fields = layout(hand, names, config.observation)
    assert policy.observation_layout == fields
    assert sum(field.size for field in fields) == size
    action = np.asarray(policy.act(policy.initial_carry(), jnp.zeros(size))[1])
    assert action.shape == (hand.num_joints,) and np.all(np.abs(action) <= 1.0)
    assert policy.control_rate == pytest.approx(1 / config.physics.control_period)


def test_an_ablated_policy_takes_the_mean_or_zero_of_what_it_does_not_see():
    policy = load_policy("rotate")
    names = ("contact_force", "relative_orientation")
    hidden = np.concatenate([np.full(f.size, f.name in names) for f in policy.observation_layout])
    obs = np.random.default_rng(0).normal(size=(20, 92)).astype(np.float32)
    mean = np.asarray(policy.params.normalizer.mean)
    fixed = np.concatenate([np.full(f.size, f.scale is not None) for f in policy.observation_layout])
    assert np.any(fixed & hidden) and not mean[fixed].any(), "touch is 0 then"
    ablated = policy.ablate(*names)
    full, without = (lambda x, p=p: np.asarray(p.act(None, x)[1]) for p in (policy, ablated))
    np.testing.assert_allclose(without(obs), full(np.where(hidden, mean, obs)), atol=2e-5)
    np.testing.assert_array_equal(without(obs), without(np.where(hidden, 9.0, obs)))
    assert np.max(np.abs(without(obs) - full(obs))) > 0.1
    np.testing.assert_array_equal(policy.ablate().act(None, obs)[1], full(obs))
    with pytest.raises(ConfigError, match="does not observe colour; it observes .*joint_position"):
        policy.ablate("colour")


WORLDS = 8


def play(env, step, states, seconds, policy=None):
    """Whether episodes failed [T, B], fingertip forces [T, B, F] N, and metrics; a failure does not stop a world here.

    Without a policy the hand gets no action.
    """
    history, action = [], jnp.zeros((WORLDS, 12))
    carry, observe = policy and policy.initial_carry(WORLDS), policy and observer(env.hand, policy)
    for _ in range(round(seconds / env.control_period)):
        if policy is not None:
            carry, action = policy.act(carry, observe(states.readings))
        states = step(states, action)
        history.append(jax.device_get((states.terminated, states.finger_force, states.metrics)))
    return jax.tree.map(lambda *ticks: np.stack(ticks), *history)


def observer(hand, policy):
    """What the policy sees of readings, whatever the environment's own actor observes."""
    config = from_dict(TASKS[policy.task].config_class, policy.env_config).observation
    fields = SHIPPED[policy.task][0]
    return jax.jit(jax.vmap(lambda readings: observation.observe(hand, readings, fields, config)))


def test_the_grasp_holds_and_presses_as_asked(grasp_rollout):
    """Four seconds from four starts, each once with the lowest and once with the highest command.

    A hand that does nothing drops every object, so that holding says something.
    """
    env, begun, none = grasp_rollout.env, grasp_rollout.reset(jax.random.key(2)), jnp.zeros(WORLDS)
    different = np.unique(begun.episode.object.shape_index, return_index=True)[1][: WORLDS // 2]
    pairs = np.repeat(different, 2)
    starts = jax.jit(lambda state: jax.tree.map(lambda x: x[pairs], state))(begun)
    goals = GraspGoal(jnp.tile(jnp.array([0.0, 1.0]), WORLDS // 2), none == 0, none)
    starts = dataclasses.replace(starts, goal=goals)
    dropped, force, _ = play(env, grasp_rollout.step, starts, 4.0, load_policy("grasp"))
    assert np.sum(~dropped.any(0)) >= 6
    late = force[len(force) // 2 :, :, 1:].sum(-1).mean(0)  # N, of the four fingers
    assert np.all(late[1::2] - late[::2] > 4.0), late
    dropped, _, _ = play(env, grasp_rollout.step, starts, 4.0)
    assert np.all(dropped.any(0))


@pytest.mark.parametrize("name", ["rotate", "rotate_without_orientation", "rotate_clear"])
def test_the_rotation_policies_turn(name):
    """At least two quarter turns in four seconds and no drop; a hand that does nothing turns none."""
    policy = load_policy(name)
    config = from_dict(TASKS[policy.task].config_class, policy.env_config)
    env = dexsim.make(policy.task, dataclasses.replace(config, pool_size=POOL_SIZE), backend="c")
    starts = jit(jax.vmap(reset_to(env)), once=True)(jax.random.split(jax.random.key(0), WORLDS), jnp.arange(WORLDS))
    step = jit(jax.vmap(env.step), once=True)
    dropped, _, metrics = play(env, step, starts, 4.0, policy)
    turns = metrics["successes"][-1]
    assert np.sum(~dropped.any(0) & (turns >= 2)) >= 6, turns
    if name == "rotate":
        _, _, metrics = play(env, step, starts, 4.0)
        assert not metrics["successes"].any()


@pytest.mark.parametrize("name", ["grasp", "rotate", "rotate_clear"])
def test_a_right_hands_policy_fits_the_left_one(left, name):
    policy = load_policy(name)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert policy.find_hand("xhand_left").digest == left.digest
    config = from_dict(find_task(policy.task).config_class, policy.env_config)
    task, spec = make_task(policy.task, left, config), policy.spec.mirror_for(left)
    assert task.config == config, "settings are those of the right hand"
    for part in ("gravity", "reference"):
        np.testing.assert_allclose(getattr(spec, part), getattr(TaskSpec.of(task), part), atol=1e-9)
    assert spec.turn == task.turn and spec.mirror_for(left) == policy.spec
