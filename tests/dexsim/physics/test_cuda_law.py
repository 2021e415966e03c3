"""Motor laws printed as CUDA, compiled for the CPU by a C++ compiler and compared with JAX's."""

import ctypes
import shutil
import subprocess

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dexsim.core.errors import ConfigError
from dexsim.env.motors import JointCommand
from dexsim.physics.cuda.law import print_law
from dexsim.physics.host.law import record

WORLDS, JOINTS = 16, 12
SCALE, OFFSET = jnp.float32(1.7), jnp.linspace(-1.0, 1.0, JOINTS)
needs_compiler = pytest.mark.skipif(shutil.which("g++") is None, reason="needs g++")

MAIN = """
extern "C" void run(const void **constants, int worlds, int joints, int substep, const float *position,
                    const float *velocity, float *torque) {
  Args args;
  __builtin_memcpy(&args, constants, sizeof args);
  for (int i = 0; i < worlds * joints; i++)
    torque[i] = motor_law(args, i / joints, i % joints, substep, position[i], velocity[i]);
}
"""


def compiled(printed, folder):
    """The printed law as a function of constants, sub-step, position [B, J] and velocity [B, J]."""
    pointers = "".join(f"const {buffer.ctype} *{buffer.name};" for buffer in printed.buffers)
    source, library = folder / "law.cpp", folder / "law.so"
    text = f"#include <cmath>\n#define DEV static\nstruct Args {{ {pointers} }};\n{printed.text}{MAIN}"
    source.write_text(text)
    subprocess.run(["g++", "-O2", "-ffp-contract=off", "-shared", "-fPIC", "-o", library, source], check=True)
    call = ctypes.CDLL(str(library)).run

    def run(constants, substep, position, velocity):
        torque = np.zeros(position.shape, np.float32)
        kept = [np.ascontiguousarray(constant) for constant in constants]
        address = (ctypes.c_void_p * len(kept))(*(constant.ctypes.data for constant in kept))
        given = (np.ascontiguousarray(x).ctypes.data_as(ctypes.c_void_p) for x in (position, velocity, torque))
        call(address, *position.shape, substep, *given)
        return torque

    return run


@needs_compiler
def test_the_motors_are_jaxs(grasp_rollout, tmp_path):
    env, states, worlds = grasp_rollout.env, grasp_rollout.reset(jax.random.key(0)), grasp_rollout.num_envs

    def law_of(state):
        target, ends = state.joint_target + 0.2, jnp.array(True)
        return env.motors.law(
            state.episode.hand, JointCommand(action=0 * target, target=target, previous=state.joint_target, valid=ends)
        )

    printed = []

    def constants(state):
        recorded = record(law_of(state), jnp.zeros(JOINTS))
        printed.append(print_law(recorded, JOINTS))
        return recorded.constants

    given = jax.vmap(constants)(states)
    run = compiled(printed[-1], tmp_path)
    given = [np.broadcast_to(x, (worlds, *x.shape[1:])) for x in map(np.asarray, given)]
    rng = np.random.default_rng(0)
    position = np.float32(rng.uniform(-0.3, 1.2, (worlds, JOINTS)))
    velocity = np.float32(rng.uniform(-12, 12, (worlds, JOINTS)))
    wanted = jax.jit(jax.vmap(lambda s, i, p, v: law_of(s)(i, p, v), in_axes=(0, None, 0, 0)))
    seen = []
    for substep in range(5):
        expected = np.asarray(wanted(states, jnp.int32(substep), position, velocity))
        # Torques are differences of larger terms: the rate that friction sees, inertia / dt times velocity.
        np.testing.assert_allclose(run(given, substep, position, velocity), expected, rtol=1e-6, atol=1e-6)
        seen.append(expected)
    assert np.abs(seen).max() > 0.05, "no torque: the test tests nothing"
    assert np.any(seen[0] != seen[-1]), "no latency: the test does not test it"


def every_operation(index, position, velocity):
    near = jnp.abs(position) < 0.7
    either = (near | (velocity > 0.5)) & ~(position >= velocity) | (position != position) | (index == 2)
    bent = jnp.tanh(position) + jnp.cos(velocity) * jnp.exp(-jnp.abs(position)) - jnp.sqrt(jnp.abs(velocity))
    mixed = jnp.where(either, bent, jnp.sign(velocity) / (2.0 + jnp.maximum(position, OFFSET)))
    clipped = jax.lax.clamp(jnp.float32(-1.0), mixed * SCALE, jnp.float32(1.0))
    count = (index <= 1).astype(jnp.int32) + jnp.where(velocity < 0.0, 3, -4)
    return -clipped + jnp.minimum(jnp.sin(velocity), jnp.inf) * count.astype(jnp.float32)


@needs_compiler
def test_every_operation(tmp_path):
    recorded = record(every_operation, jnp.zeros(JOINTS))
    run = compiled(print_law(recorded, JOINTS), tmp_path)
    position, velocity = np.float32(np.random.default_rng(1).normal(size=(2, WORLDS, JOINTS)))
    constants = [np.broadcast_to(constant, (WORLDS, *np.shape(constant))) for constant in recorded.constants]
    for index in (1, 2):
        expected = jax.vmap(every_operation, in_axes=(None, 0, 0))(jnp.int32(index), position, velocity)
        np.testing.assert_allclose(run(constants, index, position, velocity), expected, rtol=2e-6, atol=2e-6)


def test_arrays_that_are_not_of_the_joints_are_refused():
    wide = jnp.zeros((2, JOINTS))
    recorded = record(lambda index, p, v: jnp.broadcast_to(p, (2, JOINTS)) + wide, jnp.zeros(JOINTS))
    with pytest.raises(ConfigError, match=r"an array \[2, 12\] float32: expected \[\] or \[12\]"):
        print_law(recorded, JOINTS)
