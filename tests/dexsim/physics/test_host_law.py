"""Motor laws on the host: JAX's trace of them, evaluated by NumPy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dexsim
from dexsim.env.motors import JointCommand
from dexsim.physics.host.law import Law, record
from dexsim.tasks.grasp.config import GraspConfig

WORLDS = 16


def command(state):
    """Joint targets a little further on."""
    target = state.joint_target + 0.2
    return JointCommand(action=0 * target, target=target, previous=state.joint_target, valid=jnp.array(True))


@pytest.fixture(scope="module")
def motors():
    """An environment, some of its states, and its motors for one of them."""
    env = dexsim.make("grasp", GraspConfig(pool_size=10), backend="c")
    states = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(0), WORLDS))

    def law_of(state):
        law = env.motors.law(state.episode.hand, command(state))
        return lambda substep, position, velocity, memory: (law(substep, position, velocity), memory)

    return env, states, law_of


@pytest.mark.slow
def test_they_agree_with_xla_to_rounding(motors):
    env, states, law_of = motors
    rng, text = np.random.default_rng(0), []
    position = np.float32(rng.uniform(-0.3, 1.2, (WORLDS, 12)))
    velocity = np.float32(rng.uniform(-12, 12, (WORLDS, 12)))

    def constants(state):
        written = record(law_of(state), jnp.zeros(12), None)
        text.append(written.text)
        return written.constants

    given = [np.broadcast_to(x, (WORLDS, *x.shape[1:])) for x in map(np.asarray, jax.vmap(constants)(states))]
    law = Law(text[-1].encode())
    wanted = jax.jit(jax.vmap(lambda s, i, p, v: law_of(s)(i, p, v, None)[0], in_axes=(0, None, 0, 0)))
    moved = 0.0
    for substep in range(5):
        torque, _ = law(given, substep, position, velocity, [])
        expected = wanted(states, jnp.int32(substep), position, velocity)
        assert torque.dtype == np.float32 and np.shape(torque) == (WORLDS, 12)
        np.testing.assert_allclose(torque, expected, rtol=2e-5, atol=2e-6)
        moved = max(moved, np.abs(torque).max())
    assert moved > 0.05, "no torque: the test tests nothing"


@pytest.mark.slow
def test_a_tick_is_that_of_a_call_for_each_sub_step(motors, monkeypatch):
    """Laws that the host cannot evaluate stay in XLA, at a call for each sub-step. Here both ways, with one law."""
    env, states, _ = motors

    def tick():
        def run(s):
            law = env.motors.law(s.episode.hand, command(s))
            return env.physics.advance(law, s.episode.object, s.physics, jnp.zeros(3), s.tip_stiffness)

        return jax.jit(jax.vmap(run))(states)

    whole, calls = tick(), []

    def unknown(law, joints, memory):
        """Knows no law of the motors', but the torques that the other way sends."""
        calls.append(law)
        return None if len(calls) == 1 else record(law, joints, memory)

    monkeypatch.setattr("dexsim.physics.c_backend.record", unknown)
    parts = tick()
    assert len(calls) > 1
    for mine, theirs in zip(jax.tree.leaves(whole), jax.tree.leaves(parts), strict=True):
        scale = np.abs(np.asarray(theirs)).max()
        np.testing.assert_allclose(mine, theirs, atol=1e-4 * max(scale, 1.0))


def test_a_law_with_a_table_is_left_to_xla():
    table, one = jnp.arange(60.0).reshape(5, 12), jnp.arange(12.0)
    assert record(lambda index, *_: (table[index], None), jnp.zeros(12), None) is None
    assert record(lambda *_: (one, None), jnp.zeros(12), None) is not None


def test_operations_and_shapes():
    """Every operation that the host knows, on scalars and vectors, shared and of a batch."""
    scale, offset = jnp.float32(1.7), jnp.linspace(-1.0, 1.0, 12)

    def law(index, position, velocity, memory):
        near = jnp.abs(position) < jnp.abs(memory["reach"])
        either = (near | (velocity > 0.5)) & ~(position >= velocity)
        bent = jnp.tanh(position) + jnp.cos(velocity) * jnp.exp(-jnp.abs(position)) - jnp.sqrt(jnp.abs(velocity))
        mixed = jnp.where(either, bent, jnp.sign(velocity) / (2.0 + jnp.maximum(position, offset)))
        clipped = jax.lax.clamp(jnp.float32(-1.0), mixed * scale, jnp.float32(1.0))
        count = memory["count"] + (index != 2).astype(jnp.int32)
        return -clipped + jnp.minimum(memory["reach"], 0.3), {"reach": memory["reach"] * 0.5, "count": count}

    rng = np.random.default_rng(1)
    position, velocity = np.float32(rng.normal(size=(2, 7, 12)))
    memory = {"reach": np.float32(rng.normal(size=7)), "count": np.arange(7, dtype=np.int32)}
    one = jax.tree.map(lambda leaf: leaf[0], memory)
    written = record(law, jnp.zeros(12), one)
    assert written is not None, "an operation is missing"
    host = Law(written.text.encode())
    for index in (1, 2):
        torque, after = host(
            [np.asarray(c)[None] for c in written.constants], index, position, velocity, jax.tree.leaves(memory)
        )
        expected, later = jax.vmap(law, in_axes=(None, 0, 0, 0))(jnp.int32(index), position, velocity, memory)
        np.testing.assert_allclose(torque, expected, rtol=1e-5, atol=1e-6)
        for mine, theirs in zip(after, jax.tree.leaves(later), strict=True):
            np.testing.assert_allclose(mine, theirs, rtol=1e-6)
