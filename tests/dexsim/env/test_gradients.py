"""`jax.grad` through `env.step`: rewards, forces and observations, with fingers that touch nothing."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, strategies as st
from simple_physics import SimplePhysics

import dexsim
from dexsim.core.compilation import jit
from dexsim.geometry.rotations import length
from dexsim.objects.config import ObjectConfig
from dexsim.tasks.grasp.config import GraspConfig

WORLDS = 8


norm_and_gradient = jax.jit(jax.value_and_grad(length))


@given(st.lists(st.floats(-1e3, 1e3, width=32), min_size=3, max_size=3))
def test_a_length_is_the_norm_and_its_gradient_the_direction(vector):
    vector = np.float32(vector)
    norm = np.linalg.norm(np.float64(vector))
    found, gradient = norm_and_gradient(vector)
    np.testing.assert_allclose(found, norm, rtol=1e-6, atol=1e-18)
    if norm > 1e-15:
        np.testing.assert_allclose(gradient, vector / norm, rtol=1e-5, atol=1e-6)


@pytest.mark.slow
def test_gradients_are_finite_while_fingers_touch_nothing(monkeypatch):
    """Of rewards, forces and observations over ten steps with one action [12], from an object moved by [3]."""
    monkeypatch.setattr("dexsim.env.env.Physics", SimplePhysics)
    config = GraspConfig(pool_size=8, objects=ObjectConfig(shapes=("box", "sphere")))
    env = dexsim.make("grasp", config, backend="c")

    def total(action, shift, state):
        def tick(state, _):
            state = env.step(state, action)
            shown = jnp.sum(state.obs["actor"]) + jnp.sum(state.obs["critic"])
            return state, (state.reward + jnp.sum(state.finger_force) + shown, state.finger_force)

        physics = dataclasses.replace(state.physics, qpos=state.physics.qpos.at[12:15].add(shift))
        state = dataclasses.replace(state, physics=physics)
        _, (outcome, force) = jax.lax.scan(jax.checkpoint(tick), state, None, length=10)
        return jnp.sum(outcome), force

    actions = 0.3 * jax.random.normal(jax.random.key(1), (WORLDS, 12))
    states = jit(jax.vmap(env.reset), once=True)(jax.random.split(jax.random.key(0), WORLDS))
    slope = jit(jax.vmap(jax.grad(total, argnums=(0, 1), has_aux=True)), once=True)
    gradient, force = jax.device_get(slope(actions, jnp.zeros((WORLDS, 3)), states))
    assert np.any(force == 0) and np.any(force > 0), "free fingers and pressing ones are needed"
    assert all(np.all(np.isfinite(part)) for part in gradient)
    assert np.all(np.any(gradient[0] != 0, axis=-1))
