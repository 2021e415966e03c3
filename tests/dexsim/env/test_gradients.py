"""`jax.grad` through `env.step`: rewards, forces and observations, with fingers that touch nothing."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from simple_physics import SimplePhysics

import dexsim
from dexsim.core.compilation import jit
from dexsim.geometry.vectors import length
from dexsim.objects.config import ObjectConfig
from dexsim.tasks.grasp.config import GraspConfig

WORLDS = 8


@given(st.lists(st.floats(-1e3, 1e3, width=32), min_size=3, max_size=3))
def test_a_length_is_the_norm_and_its_gradient_the_direction(vector):
    vector = np.float32(vector)
    norm = np.linalg.norm(np.float64(vector))
    np.testing.assert_allclose(length(jnp.asarray(vector)), norm, rtol=1e-6, atol=1e-18)
    gradient = np.asarray(jax.grad(length)(jnp.asarray(vector)))
    if norm > 1e-15:
        np.testing.assert_allclose(gradient, vector / norm, rtol=1e-5, atol=1e-6)


def test_a_length_of_zero_has_gradient_zero():
    np.testing.assert_array_equal(jax.grad(length)(jnp.zeros(3)), 0.0)
    np.testing.assert_array_equal(jax.jacrev(length)(jnp.zeros((5, 3))), 0.0)


@pytest.fixture(scope="module")
def env():
    """Grasp over simple physics, where fingers that have not closed feel a force of exactly zero."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("dexsim.env.env.Physics", SimplePhysics)
        objects = ObjectConfig(shapes=("sphere",))
        yield dexsim.make("grasp", GraspConfig(pool_size=4, objects=objects), backend="mjx")


def rewards(env, steps):
    """The sum of rewards, forces and observations over some steps with one action [12], from an object moved by [3]."""

    def total(action, shift, state):
        physics = dataclasses.replace(state.physics, qpos=state.physics.qpos.at[12:15].add(shift))

        def tick(state, _):
            state = env.step(state, action)
            seen = jnp.sum(state.obs["actor"]) + jnp.sum(state.obs["critic"])
            return state, (state.reward, jnp.sum(state.finger_force) + seen, state.finger_force)

        state = dataclasses.replace(state, physics=physics)
        _, (reward, other, force) = jax.lax.scan(jax.checkpoint(tick), state, None, length=steps)
        return jnp.sum(reward) + jnp.sum(other), (jnp.sum(reward), force)

    return total


def check_gradients(env, steps):
    """All gradients are finite although fingers are free; the values that they belong to."""
    actions = 0.3 * jax.random.normal(jax.random.key(1), (WORLDS, 12))
    states = jit(jax.vmap(env.reset), once=True)(jax.random.split(jax.random.key(0), WORLDS))
    slope = jit(jax.vmap(jax.grad(rewards(env, steps), argnums=(0, 1), has_aux=True)), once=True)
    gradient, (_, force) = jax.device_get(slope(actions, jnp.zeros((WORLDS, 3)), states))
    assert np.any(force == 0) and np.any(force > 0), "free fingers and pressing ones are needed"
    assert all(np.all(np.isfinite(part)) for part in gradient)
    assert np.all(np.any(gradient[0] != 0, axis=-1))


@pytest.mark.slow
@pytest.mark.parametrize("steps", [1, 10])
def test_gradients_are_finite_while_fingers_touch_nothing(env, steps):
    check_gradients(env, steps)


@pytest.mark.slow
def test_the_gradient_of_the_reward_is_its_finite_difference(env):
    """Central differences in single precision along random directions of the action."""
    keys = jax.random.split(jax.random.key(2), 3)
    states = jit(jax.vmap(env.reset), once=True)(jax.random.split(keys[0], WORLDS))
    actions = 0.3 * jax.random.normal(keys[1], (WORLDS, 12))
    way = jax.random.normal(keys[2], actions.shape)
    reward = lambda action, state: rewards(env, 3)(action, jnp.zeros(3), state)[1][0]  # noqa: E731
    exact = jnp.sum(jit(jax.vmap(jax.grad(reward)), once=True)(actions, states) * way, -1)
    run, step = jit(jax.vmap(reward), once=True), 0.01
    numeric = (run(actions + step * way, states) - run(actions - step * way, states)) / (2 * step)
    close = np.isclose(exact, numeric, rtol=0.05, atol=0.02 * np.abs(numeric).max())
    assert np.mean(close) >= 0.75, (exact, numeric)
