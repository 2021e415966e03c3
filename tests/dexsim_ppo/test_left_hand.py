"""Shipped policies on the left hand in simulation: the mirror image of what they do on the right one."""

import dataclasses
import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dexsim
from dexsim.core.config import from_dict
from dexsim.geometry.mirror import POLAR, QUAT
from dexsim.hand.load import load_hand
from dexsim.registry import find_task, make_task
from dexsim.task_spec import TaskSpec
from dexsim_ppo.policy import load_policy

SECONDS = 1.0


@pytest.fixture(scope="module")
def left():
    return load_hand("xhand_left")


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


def actor_of(env, obs):
    """The actor's observation without the noise of sensors: the critic's values of its fields."""
    values, at = {}, 0
    for entry in env.observation_layout["critic"]:
        values[entry.name] = obs["critic"][at : at + entry.size]
        at += entry.size
    return jnp.concatenate([values[entry.name] for entry in env.observation_layout["actor"]])


def mirror_start(start):
    """A start state in the mirror, its object reflected in its own plane y = 0."""
    object = start.object
    quat = None if object.quat is None else object.quat * QUAT
    mirrored = dataclasses.replace(object, position=object.position * POLAR, com=object.com * POLAR, quat=quat)
    qpos = np.array(start.qpos)
    qpos[-7:] *= np.concatenate([POLAR, QUAT])
    return dataclasses.replace(start, qpos=qpos, object=mirrored)


@pytest.mark.slow
def test_both_hands_do_the_same_in_the_mirror(hand, left):
    """A closed loop of a shipped policy in C MuJoCo, with contacts: nominal hands, no pushes, no noise of sensors."""
    policy = load_policy("grasp")
    config = from_dict(find_task(policy.task).config_class, policy.env_config)
    config = dataclasses.replace(config, pool_size=10, push_probability=0.0, release_delay=(0.0, 0.0))
    worlds = [dexsim.make(policy.task, config, backend="c", hand=one) for one in (hand, left)]
    start = jax.tree.map(lambda rows: rows[0], worlds[0].pool)
    runs = []
    for env, begin in zip(worlds, (start, mirror_start(start)), strict=True):
        step, act = jax.jit(env.step), jax.jit(lambda carry, obs, env=env: policy.act(carry, actor_of(env, obs)))
        reset = jax.jit(lambda key, begin, env=env: env.reset_from(key, begin, scale=jnp.zeros(())))
        state, carry, run = reset(jax.random.key(0), begin), policy.initial_carry(), []
        for _ in range(round(SECONDS / env.control_period)):
            carry, action = act(carry, state.obs)
            state = step(state, action)
            run.append((np.asarray(state.physics.qpos), np.asarray(state.finger_force), state.terminated))
        runs.append([np.stack(part) for part in zip(*run, strict=True)])
    (right, force, dropped), (mirrored, other_force, _) = runs
    assert force.sum(1).max() > 1.0 and not dropped.any(), "it is touched, and held"
    there = right.copy()
    there[:, -7:] *= np.concatenate([POLAR, QUAT])
    np.testing.assert_allclose(mirrored, there, atol=2e-4)
    np.testing.assert_allclose(other_force, force, atol=0.05)
