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
        return env.motors.law(state.episode.hand, command(state))

    return env, states, law_of


@pytest.mark.slow
def test_torques_agree_with_xla_to_rounding(motors):
    env, states, law_of = motors
    rng, text = np.random.default_rng(0), []
    position = np.float32(rng.uniform(-0.3, 1.2, (WORLDS, 12)))
    velocity = np.float32(rng.uniform(-12, 12, (WORLDS, 12)))

    def constants(state):
        written = record(law_of(state), jnp.zeros(12))
        text.append(written.text)
        return written.constants

    given = [np.broadcast_to(x, (WORLDS, *x.shape[1:])) for x in map(np.asarray, jax.vmap(constants)(states))]
    law = Law(text[-1].encode())
    expected_of = jax.jit(jax.vmap(lambda s, i, p, v: law_of(s)(i, p, v), in_axes=(0, None, 0, 0)))
    largest = 0.0
    for substep in range(5):
        torque = law(given, substep, position, velocity)
        expected = expected_of(states, jnp.int32(substep), position, velocity)
        assert torque.dtype == np.float32 and np.shape(torque) == (WORLDS, 12)
        np.testing.assert_allclose(torque, expected, rtol=2e-5, atol=2e-6)
        largest = max(largest, np.abs(torque).max())
    assert largest > 0.05, "no torque: the test tests nothing"


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

    def unknown(law, joints):
        """Knows no law of the motors', but the torques that the other way sends."""
        calls.append(law)
        return None if len(calls) == 1 else record(law, joints)

    monkeypatch.setattr("dexsim.physics.c_backend.record", unknown)
    parts = tick()
    assert len(calls) > 1
    for mine, theirs in zip(jax.tree.leaves(whole), jax.tree.leaves(parts), strict=True):
        scale = np.abs(np.asarray(theirs)).max()
        np.testing.assert_allclose(mine, theirs, atol=1e-4 * max(scale, 1.0))


def test_a_law_with_a_table_is_left_to_xla():
    table, one = jnp.arange(60.0).reshape(5, 12), jnp.arange(12.0)
    assert record(lambda index, *_: table[index], jnp.zeros(12)) is None
    assert record(lambda *_: one, jnp.zeros(12)) is not None


def test_operations_and_shapes():
    """Every operation that the host knows, on scalars and vectors, shared and of a batch."""
    scale, offset = jnp.float32(1.7), jnp.linspace(-1.0, 1.0, 12)

    def law_of(reach):
        def law(index, position, velocity):
            near = jnp.abs(position) < jnp.abs(reach)
            either = (near | (velocity > 0.5)) & ~(position >= velocity)
            bent = jnp.tanh(position) + jnp.cos(velocity) * jnp.exp(-jnp.abs(position)) - jnp.sqrt(jnp.abs(velocity))
            mixed = jnp.where(either, bent, jnp.sign(velocity) / (2.0 + jnp.maximum(position, offset)))
            clipped = jax.lax.clamp(jnp.float32(-1.0), mixed * scale, jnp.float32(1.0))
            later = (index != 2).astype(jnp.float32)
            return later * jnp.minimum(reach, 0.3) - clipped

        return law

    rng = np.random.default_rng(1)
    position, velocity = np.float32(rng.normal(size=(2, 7, 12)))
    reach, written = np.float32(rng.normal(size=7)), []

    def constants(reach):
        written.append(record(law_of(reach), jnp.zeros(12)))
        assert written[-1] is not None, "an operation is missing"
        return written[-1].constants

    given = [np.asarray(constant) for constant in jax.vmap(constants)(reach)]
    host = Law(written[-1].text.encode())
    for index in (1, 2):
        torque = host(given, index, position, velocity)
        expected = jax.vmap(lambda r, p, v, i=index: law_of(r)(jnp.int32(i), p, v))(reach, position, velocity)
        np.testing.assert_allclose(torque, expected, rtol=1e-5, atol=1e-6)
