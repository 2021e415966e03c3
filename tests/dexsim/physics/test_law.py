"""Motor laws as recorded: evaluated by NumPy and printed as CUDA (here compiled by a C++ compiler), against JAX."""

import ctypes

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import warp_emulation

from dexsim.errors import ConfigError
from dexsim.physics.cuda.program import print_law
from dexsim.physics.cuda.scene import args_type, declare_args
from dexsim.physics.law import evaluator, record

WORLDS, JOINTS = 16, 12
SCALE, OFFSET = jnp.float32(1.7), jnp.linspace(-1.0, 1.0, JOINTS)


def in_numpy(recorded, constants):
    """The law as a function of sub-step, position [B, J] and velocity [B, J]."""
    return evaluator(recorded.text.encode())(constants)


def in_cpp(recorded, constants):
    """The same, printed and compiled."""
    if warp_emulation.compiler is None:
        pytest.skip("needs g++")
    printed = print_law(recorded, JOINTS)
    library = warp_emulation.build(declare_args(printed.buffers) + printed.text, "laws.cpp")
    constants = [np.ascontiguousarray(np.broadcast_to(x, (WORLDS, *x.shape[1:]))) for x in constants]

    def run(substep, position, velocity):
        motors = np.zeros((*position.shape, 2), np.float32)
        addresses = (ctypes.c_void_p * len(constants))(*(constant.ctypes.data for constant in constants))
        arrays = (ctypes.c_void_p(x.ctypes.data) for x in (position, velocity, motors))
        args = args_type(len(constants))(addresses, WORLDS)
        ctypes.CDLL(str(library)).run(ctypes.byref(args), JOINTS, substep, *arrays)
        return motors[..., 0], motors[..., 1]

    return run


WAYS = pytest.mark.parametrize("way", [in_numpy, in_cpp])


def moments(seed):
    """Positions rad and velocities rad/s [B, J]."""
    random = np.random.default_rng(seed)
    return np.float32(random.uniform(-0.3, 1.2, (WORLDS, JOINTS))), np.float32(
        random.uniform(-12, 12, (WORLDS, JOINTS))
    )


def every_operation(reach):
    """A law that has every operation, on scalars and vectors, shared and of a batch (`reach`)."""

    def law(index, position, velocity):
        near = jnp.abs(position) < jnp.abs(reach)
        either = (near | (velocity > 0.5)) & ~(position >= velocity) | (position != position) | (index == 2)
        bent = jnp.tanh(position) + jnp.cos(velocity) * jnp.exp(-jnp.abs(position)) - jnp.sqrt(jnp.abs(velocity))
        mixed = jnp.where(either, bent, jnp.sign(velocity) / (2.0 + jnp.maximum(position, OFFSET)))
        clipped = jax.lax.clamp(jnp.float32(-1.0), mixed * SCALE, jnp.float32(1.0))
        count = (index <= 1).astype(jnp.int32) + jnp.where(velocity < 0.0, 3, -4)
        torque = jnp.minimum(reach, 0.3) - clipped + jnp.minimum(jnp.sin(velocity), jnp.inf) * count.astype(jnp.float32)
        return torque, velocity * reach

    return law


@jax.jit
def reference(index, reach, position, velocity):
    return jax.vmap(lambda r, p, v: every_operation(r)(index, p, v))(reach, position, velocity)


@WAYS
def test_every_operation(way):
    reach, recorded = np.float32(np.random.default_rng(1).normal(size=WORLDS)), []

    def constants(reach):
        recorded.append(record(every_operation(reach), jnp.zeros(JOINTS)))
        return recorded[-1].constants

    values = [np.asarray(x) for x in jax.vmap(constants)(reach)]
    law = way(recorded[-1], values)
    position, velocity = moments(2)
    for index in (1, 2):
        expected = reference(jnp.int32(index), reach, position, velocity)
        for result, value in zip(law(index, position, velocity), expected, strict=True):
            np.testing.assert_allclose(result, value, rtol=1e-5, atol=2e-6)


WIDE = jnp.zeros((2, JOINTS))


def test_a_law_that_is_not_element_by_element_is_named():
    for torque, word in ((jnp.cumsum, "cumsum"), (lambda p: p[None] + WIDE, "broadcast_in_dim")):
        with pytest.raises(ConfigError, match=f"a motor law with .*{word}.*choose backend mjx"):
            print_law(record(lambda index, p, v, torque=torque: (torque(p), v), jnp.zeros(JOINTS)), JOINTS)
