"""What only a GPU can show: every backend there presses as C MuJoCo does, again and again and in large batches."""

import functools
import importlib.util

import c_scene
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from c_scene import CONVERGED, GRAVITY, row, rows_of, squeeze, stack

import dexsim
from dexsim.core.compilation import collector_paused, jit
from dexsim.objects.config import SHAPES, SLOTS, ObjectConfig
from dexsim.physics.config import PhysicsConfig
from dexsim.physics.interface import PhysicsState
from dexsim.physics.physics import Physics
from dexsim.tasks.grasp.config import GraspConfig

pytestmark = pytest.mark.gpu

EACH, COPIES = 2, 12  # grips of a shape; how often the large batch has each
WARP = pytest.param("warp", marks=pytest.mark.skipif(importlib.util.find_spec("warp") is None, reason="needs warp"))


def compile_advance(hand, backend, worlds):
    """`advance(object, state, torque)`: a converged sub-step of `worlds` worlds."""
    config = PhysicsConfig(substeps=1, **CONVERGED)
    physics = Physics(hand, SLOTS, ObjectConfig().largest, config, gravity=GRAVITY, backend=backend, num_envs=worlds)

    def one(object, state, torque):
        return physics.advance(lambda *_: torque, object, state, jnp.zeros(3))

    program = jit(jax.vmap(one))

    def advance(*inputs):
        with collector_paused():
            return jax.block_until_ready(program(*inputs))

    return advance


@pytest.fixture(scope="module")
def grips(hand):
    """Inputs of `advance` for squeezed hands of all shapes, and C MuJoCo's velocities and finger forces after it."""
    pool = dexsim.make("grasp", GraspConfig(pool_size=80), backend="jax", hand=hand).pool
    rng, inputs, velocity, force = np.random.default_rng(6), [], [], []
    for shape in SHAPES:
        for index in rows_of(pool, shape)[:EACH]:
            start = row(pool, index)
            _, *begun, torque = squeeze(hand, start, rng)
            exact = bool(start.object.active[SLOTS.index("cylinder")])
            model = c_scene.compile_scene(hand, start.object, exact=exact, **CONVERGED)
            data = c_scene.start(model, *begun)
            data.qfrc_applied[:12] = torque
            mujoco.mj_step(model, data)
            inputs.append((start.object, *begun, torque))
            velocity.append(data.qvel.copy())
            force.append(c_scene.finger_force(model, data, hand))
    objects, qpos, qvel, warmstart, torque = zip(*inputs, strict=True)
    state = PhysicsState(*(jnp.stack(x) for x in (qpos, qvel, warmstart)))
    assert np.sum(np.linalg.norm(force, axis=-1).max(-1) > 0.5) > len(force) / 2, "hardly a hand holds anything"
    return (stack(objects), state, jnp.stack(torque)), np.stack(velocity), np.stack(force)


@pytest.fixture(scope="module")
def found(hand, grips):
    inputs, *_ = grips
    return functools.cache(lambda backend: compile_advance(hand, backend, EACH * len(SHAPES))(*inputs))


@pytest.mark.parametrize("backend", ["jax", "cuda", WARP])
def test_a_still_grip_is_c_mujocos(grips, found, backend):
    """No TF32 in the solver, and forces that are not zero. The JAX backend has contacts of its own with cylinders."""
    _, velocity, wanted = grips
    after, force = found(backend)
    same = np.repeat([shape != "cylinder" or backend != "jax" for shape in SHAPES], EACH)
    strength = np.linalg.norm(wanted, axis=-1).max(-1)
    wrong = np.abs(np.asarray(force) - wanted).max((1, 2))
    assert np.all(wrong[same] < 0.01 + 2e-3 * strength[same]), (wrong, strength)
    np.testing.assert_allclose(np.asarray(after.qvel)[same], velocity[same], atol=5e-3)


@pytest.mark.parametrize("backend", ["cuda", WARP])
def test_a_large_batch_is_many_of_a_small_one(hand, grips, found, backend):
    """Every copy of a grip, wherever it is in the batch, has the forces that it has in the small batch."""
    inputs, *_ = grips
    many = jax.tree.map(lambda x: jnp.tile(x, (COPIES,) + (1,) * (jnp.ndim(x) - 1)), inputs)
    _, force = compile_advance(hand, backend, COPIES * EACH * len(SHAPES))(*many)
    _, wanted = found(backend)
    np.testing.assert_allclose(force, np.tile(wanted, (COPIES, 1, 1)), atol=0.0 if backend == "cuda" else 5e-3)


@pytest.mark.parametrize("backend", ["cuda", WARP])
def test_a_captured_graph_reads_its_inputs_anew(hand, grips, backend):
    """Graphs replay what was captured at the first call: other inputs must not meet the first ones' memory."""
    inputs, *_ = grips
    turned = jax.tree.map(lambda x: jnp.roll(jnp.asarray(x), 1, 0), inputs)
    advance = compile_advance(hand, backend, EACH * len(SHAPES))
    first, other, again = (np.asarray(advance(*given)[1]) for given in (inputs, turned, inputs))
    np.testing.assert_allclose(again, first, atol=5e-3)
    np.testing.assert_allclose(other, np.roll(first, 1, 0), atol=5e-3)
    assert np.abs(other - first).max() > 0.5


@pytest.mark.parametrize("backend", ["cuda", WARP])
def test_memory_grows_as_the_batch(hand, backend):
    """XLA's own count of what a step needs at a time: twice the environments, at most twice the memory."""
    needed = []
    for worlds in (16, 32):
        env = dexsim.make("grasp", GraspConfig(pool_size=16), backend=backend, num_envs=worlds)
        state = jax.eval_shape(jax.vmap(env.reset), jax.random.split(jax.random.key(0), worlds))
        program = jit(jax.vmap(env.step)).lower(state, jnp.zeros((worlds, env.action_size))).compile()
        memory = program.memory_analysis()
        needed.append(memory.temp_size_in_bytes + memory.argument_size_in_bytes + memory.output_size_in_bytes)
    assert 1.2 < needed[1] / needed[0] < 2.1, needed


def test_cuda_repeats_to_the_bit(hand, grips):
    """50 ticks in a scan, also in a batch that does not fill its last block and in a batch of batches."""
    inputs, *_ = grips
    physics = Physics(hand, SLOTS, ObjectConfig().largest, PhysicsConfig(), gravity=GRAVITY, backend="cuda")

    def ticks(object, state, torque):
        def body(state, _):
            result = physics.advance(lambda *_: torque, object, state, jnp.zeros(3))
            return result.state, result.finger_force

        return jax.lax.scan(body, state, length=50)

    def same(found, part=lambda x: x):
        jax.tree.map(lambda a, b: np.testing.assert_array_equal(part(a), b), found, whole)

    whole, count = jit(jax.vmap(ticks))(*inputs), EACH * len(SHAPES)
    same(jit(jax.vmap(ticks))(*inputs))
    more = jax.tree.map(lambda x: jnp.concatenate([jnp.asarray(x)] * 2)[: count + 1], inputs)
    same(jit(jax.vmap(ticks))(*more), lambda x: x[:count])
    pairs = jax.tree.map(lambda x: jnp.reshape(x, (EACH, len(SHAPES), *np.shape(x)[1:])), inputs)
    same(jit(jax.vmap(jax.vmap(ticks)))(*pairs), lambda x: x.reshape(count, *x.shape[2:]))
