"""The `cuda` engine behind `Physics`, its kernel run by the emulation of a warp in place of a GPU; each
task's kernel through NVRTC, which needs no GPU."""

import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import warp_emulation
from episodes import POOL_SIZE

import dexsim
from dexsim.core.compilation import jit
from dexsim.env.motors import JointCommand, Motors
from dexsim.errors import ConfigError
from dexsim.physics import ffi, physics as engines
from dexsim.physics.cuda import backend, launch, program
from dexsim.physics.physics import Physics
from dexsim.tasks.rotate.config import RotateConfig

pytestmark = pytest.mark.skipif(warp_emulation.compiler is None, reason="the emulation of a warp needs g++")


KERNELS, LAUNCHES = {}, []


def serve(frame):
    """In place of the GPU's: a launch of `KERNELS`."""
    emulation, settings = KERNELS[ffi.attributes(frame)["kernel"].decode()]
    given, results = ffi.arrays(frame.arguments), ffi.arrays(frame.results)
    inputs, outputs = ([b for b in emulation.buffers if b.output == which] for which in (False, True))
    LAUNCHES.append((math.prod(given[0].shape[:-1]), settings.substeps))
    given = {b.name: x.reshape(-1, b.size) for b, x in zip(inputs, given, strict=True)}
    outputs_by_name = emulation.run(given, **dataclasses.asdict(settings))
    for buffer, result in zip(outputs, results, strict=True):
        result[...] = outputs_by_name[buffer.name].reshape(result.shape)


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
    task, config = env.task, dataclasses.replace(env.config.physics, iterations=50)
    return Physics(env.hand, task.slots, task.largest, config, gravity=task.gravity, backend=name)


def tick_of(env, physics):
    """A control tick of a batch under the task's own motors, whose targets have moved a little."""
    motors = Motors(physics)

    def one(s):
        target = s.joint_target + 0.1
        command = JointCommand(action=0 * target, target=target, previous=s.joint_target, valid=jnp.array(True))
        law, push = motors.law(s.episode.hand, command), jnp.array([0.1, -0.2, 0.3])
        result = physics.advance(law, physics.fields(s.episode.object, s.tip_stiffness), s.physics, push)
        return result, motors.current_torque(s.episode.hand, command, result.state)[0]

    return jit(jax.vmap(one), once=True)


@pytest.fixture(scope="module")
def states(grasp_rollout):
    """Start states, a few ticks on: objects lie on the hand."""
    state = grasp_rollout.reset(jax.random.key(0))
    for _ in range(6):
        state = grasp_rollout.step(state, jnp.full(state.joint_target.shape, 0.5, jnp.float32))
    return state


def test_a_tick_is_that_of_c_mujoco(grasp_env, states, emulated):
    (expected, torque), (result, cuda_torque) = (
        jax.block_until_ready(tick_of(grasp_env, physics_of(grasp_env, name))(states)) for name in ("c", "cuda")
    )
    assert emulated == [(len(states.tick), grasp_env.config.physics.substeps)]
    assert np.abs(expected.finger_force).max() > 0.5, "nothing is touched"
    np.testing.assert_allclose(result.state.qpos, expected.state.qpos, atol=2e-5)
    np.testing.assert_allclose(result.finger_force, expected.finger_force, atol=0.02)
    np.testing.assert_allclose(cuda_torque, torque, atol=1e-3)


@pytest.mark.parametrize("task", ["rotate", "grasp"])
def test_tasks_compile(task, grasp_env, emulated, monkeypatch):
    try:
        program.find_compiler()
    except ConfigError as error:
        pytest.skip(str(error))
    texts = []
    monkeypatch.setattr(backend, "source", program.source)
    monkeypatch.setattr(backend, "compile_kernel", lambda text, _: texts.append(text))
    monkeypatch.setattr(launch, "load", lambda *_: "0")
    env = grasp_env if task == "grasp" else dexsim.make(task, RotateConfig(pool_size=POOL_SIZE), backend="c")
    states = jax.eval_shape(jax.vmap(env.reset), jax.random.split(jax.random.key(0), 1))
    for _ in range(2):
        jax.eval_shape(tick_of(env, physics_of(env, "cuda")), states)
    assert texts[0] == texts[1], "kernels are cached by their text"
    code = program.compile_source(texts[0], (*program.OPTIONS, "--gpu-architecture=sm_90"))
    assert code[:4] == b"\x7fELF"
    for name in (program.ENTRY, program.SHARED_BYTES):
        assert name.encode() in code
