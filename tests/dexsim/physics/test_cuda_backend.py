"""The `cuda` engine behind `Physics`, its kernel run by the emulation of a warp in place of a GPU."""

import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import warp_emulation

from dexsim.core.compilation import jit
from dexsim.core.errors import AssetError, ConfigError, DexsimWarning
from dexsim.env.motors import JointCommand, Motors
from dexsim.physics import ffi
from dexsim.physics import physics as engines
from dexsim.physics.cuda import backend, launch
from dexsim.physics.host import call
from dexsim.physics.physics import Physics

pytestmark = pytest.mark.skipif(warp_emulation.compiler is None, reason="the emulation of a warp needs g++")


KERNELS, LAUNCHES = {}, []


def serve(frame):
    """In place of the GPU's: a launch of `KERNELS`."""
    emulation, settings = KERNELS[ffi.attributes(frame)["kernel"].decode()]
    given, results = call._arrays(frame.arguments), call._arrays(frame.results)
    inputs, outputs = ([b for b in emulation.buffers if b.output == which] for which in (False, True))
    LAUNCHES.append((math.prod(given[0].shape[:-1]), settings.substeps))
    given = {b.name: x.reshape(-1, b.size) for b, x in zip(inputs, given, strict=True)}
    found = emulation.run(given, **dataclasses.asdict(settings))
    for buffer, result in zip(outputs, results, strict=True):
        result[...] = found[buffer.name].reshape(result.shape)


@pytest.fixture
def emulated(monkeypatch):
    """Kernels are emulated; returns how many worlds and sub-steps each launch had."""

    def load(code, settings, buffers):
        scene, law = code
        emulation, name = warp_emulation.Emulation(scene, law.text, list(law.buffers)), str(len(KERNELS))
        assert buffers == len(emulation.buffers)
        KERNELS[name] = emulation, settings
        return name

    ffi.register(launch.TARGET, "cpu", serve)
    monkeypatch.setattr(engines, "_on_nvidia", lambda: True)
    monkeypatch.setattr(launch, "architecture", lambda: "sm_90")
    monkeypatch.setattr(launch, "load", load)
    monkeypatch.setattr(backend, "find_compiler", lambda: None)
    monkeypatch.setattr(backend, "source", lambda scene, law: (scene, law))
    monkeypatch.setattr(backend, "compile_kernel", lambda text, architecture: text)
    LAUNCHES.clear()
    return LAUNCHES


def physics_of(env, name):
    task, config = env.task, dataclasses.replace(env.config.physics, iterations=50, line_search=50)
    return Physics(env.hand, task.slots, task.largest, config, gravity=task.gravity, backend=name, skin=env.config.skin)


def tick(env, physics, state):
    """A control tick of a batch under the task's own motors, whose targets have moved a little."""
    motors = Motors(env.config, env.hand, physics)

    def one(s):
        target = s.joint_target + 0.1
        command = JointCommand(action=0 * target, target=target, previous=s.joint_target, valid=jnp.array(True))
        return motors.tick(s.episode, command, s.physics, s.gear, jnp.array([0.1, -0.2, 0.3]))

    return jax.block_until_ready(jit(jax.vmap(one), once=True)(state))


@pytest.fixture(scope="module")
def states(grasp_rollout):
    """Start states, a few ticks on: objects lie on the hand."""
    state = grasp_rollout.reset(jax.random.key(0))
    for _ in range(6):
        state = grasp_rollout.step(state, jnp.full((grasp_rollout.num_envs, grasp_rollout.env.action_size), 0.5))
    return state


def test_a_tick_is_that_of_c_mujoco(grasp_env, states, emulated):
    wanted = tick(grasp_env, physics_of(grasp_env, "c"), states)
    found = tick(grasp_env, physics_of(grasp_env, "cuda"), states)
    assert emulated == [(len(states.tick), grasp_env.config.physics.substeps)]
    assert np.abs(wanted.finger_force).max() > 0.5, "nothing is touched"
    assert np.all(found.finite)
    np.testing.assert_allclose(found.physics.qpos, wanted.physics.qpos, atol=2e-5)
    np.testing.assert_allclose(found.finger_force, wanted.finger_force, atol=0.02)
    np.testing.assert_allclose(found.joint_torque, wanted.joint_torque, atol=1e-3)


def test_a_law_with_memory_takes_a_launch_for_each_sub_step(grasp_env, states, emulated):
    """Also a law that has what the kernel cannot evaluate, such as a table."""
    physics, table = physics_of(grasp_env, "cuda"), jnp.linspace(0.1, 0.3, 5)

    def remembering(index, position, velocity, count):
        return (0.1 + 0.05 * count) * jnp.ones_like(position) - 0.01 * velocity, count + 1

    def looking_up(index, position, velocity, memory):
        return table[index] * jnp.ones_like(position) - 0.01 * velocity, memory

    def plain(index, position, velocity, memory):
        return (0.1 + 0.05 * index.astype(jnp.float32)) * jnp.ones_like(position) - 0.01 * velocity, memory

    def run(law, memory):
        emulated.clear()
        advance = lambda s: physics.advance_motors(s.episode.object, s.physics, law, memory, jnp.zeros(3))  # noqa: E731
        found = jax.block_until_ready(jit(jax.vmap(advance), once=True)(states))
        return found, list(emulated)

    (wanted, force, _), launches = run(plain, None)
    assert launches == [(len(states.tick), 5)]
    for law, memory in ((remembering, jnp.float32(0)), (looking_up, None)):
        (after, other, memory), launches = run(law, memory)
        assert launches == [(len(states.tick), 1)] * 5
        np.testing.assert_allclose(after.qpos, wanted.qpos, atol=1e-5)
        np.testing.assert_allclose(other, force, atol=0.02)
        assert memory is None or np.all(memory == 5)


def test_no_gradient(grasp_env, states, emulated):
    physics, one = physics_of(grasp_env, "cuda"), jax.tree.map(lambda x: x[0], states)

    def loss(scale):
        law = lambda index, position, velocity: scale * position  # noqa: E731
        return jnp.sum(physics.advance(one.episode.object, one.physics, law, jnp.zeros(3))[0].qpos)

    with pytest.raises(ConfigError, match="'cuda' has no gradient: make the environment with backend='jax'"):
        jax.eval_shape(jax.grad(loss), 1.0)


def test_what_does_not_fit_runs_on_jax(grasp_env, emulated, monkeypatch):
    def lacking(scene):
        raise AssetError("hand.xml: backend cuda cannot simulate: tendons")

    monkeypatch.setattr(backend, "kernel_constants", lacking)
    monkeypatch.setattr(engines, "choose_backend", lambda name: "cuda")
    with pytest.warns(DexsimWarning, match="cannot simulate: tendons; backend jax instead"):
        assert physics_of(grasp_env, "auto").backend == "jax"
    with pytest.raises(AssetError, match="cannot simulate: tendons"):
        physics_of(grasp_env, "cuda")
