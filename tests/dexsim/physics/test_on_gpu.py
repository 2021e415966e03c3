"""What only a GPU can show: engines there press as C MuJoCo does, again and again and in large batches."""

import functools

import c_scene
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from c_scene import GRAVITY, row, rows_of, squeeze, stack

import dexsim
from dexsim.core.compilation import jit
from dexsim.objects.config import SHAPES, SLOTS, ObjectConfig
from dexsim.physics.config import PhysicsConfig
from dexsim.physics.interface import PhysicsState
from dexsim.physics.physics import Physics
from dexsim.tasks.grasp.config import GraspConfig

pytestmark = pytest.mark.gpu

EACH = 2  # grips of a shape


def compile_advance(hand, backend):
    """`advance(object, state, torque)`: a sub-step of a batch."""
    config = PhysicsConfig(substeps=1)
    physics = Physics(hand, SLOTS, ObjectConfig().largest, config, gravity=GRAVITY, backend=backend)

    def one(object, state, torque):
        return physics.advance(lambda *_: torque, physics.fields(object), state, jnp.zeros(3))

    return jit(jax.vmap(one))


@pytest.fixture(scope="module")
def grips(hand):
    """Inputs of `advance` for squeezed hands of all shapes, and C MuJoCo's velocities and finger forces after it."""
    pool = dexsim.make("grasp", GraspConfig(pool_size=80), backend="mjx", hand=hand).pool
    rng, inputs, velocity, force = np.random.default_rng(6), [], [], []
    for shape in SHAPES:
        for index in rows_of(pool, shape)[:EACH]:
            start = row(pool, index)
            _, *begun, torque = squeeze(hand, start, rng)
            exact = bool(start.object.active[SLOTS.index("cylinder")])
            data, expected = c_scene.step(hand, start.object, begun, torque, exact=exact)
            inputs.append((start.object, *begun, torque))
            velocity.append(data.qvel.copy())
            force.append(expected)
    objects, qpos, qvel, warmstart, torque = zip(*inputs, strict=True)
    state = PhysicsState(*(jnp.stack(x) for x in (qpos, qvel, warmstart)))
    assert np.sum(np.linalg.norm(force, axis=-1).max(-1) > 0.5) > len(force) / 2, "hardly a hand holds anything"
    return (stack(objects), state, jnp.stack(torque)), np.stack(velocity), np.stack(force)


@pytest.fixture(scope="module")
def on_engine(hand, grips):
    inputs, *_ = grips
    return functools.cache(lambda backend: compile_advance(hand, backend)(*inputs))


@pytest.mark.parametrize("backend", ["mjx", "cuda"])
def test_a_still_grip_is_c_mujocos(grips, on_engine, backend):
    """No TF32 in the solver, and forces that are not zero. MJX has other contacts with cylinders and boxes."""
    _, velocity, expected = grips
    after, force = on_engine(backend)
    same = np.repeat([shape in ("sphere", "capsule") or backend == "cuda" for shape in SHAPES], EACH)
    strength = np.linalg.norm(expected, axis=-1).max(-1)
    wrong = np.abs(np.asarray(force) - expected).max((1, 2))
    assert np.all(wrong[same] < 0.01 + 2e-3 * strength[same]), (wrong, strength)
    np.testing.assert_allclose(np.asarray(after.qvel)[same], velocity[same], atol=5e-3)


def test_a_captured_graph_reads_its_inputs_anew(hand, grips):
    """Graphs replay what was captured at the first call: other inputs must not meet the first ones' memory."""
    inputs, *_ = grips
    turned = jax.tree.map(lambda x: jnp.roll(jnp.asarray(x), 1, 0), inputs)
    advance = compile_advance(hand, "cuda")
    first, other, again = (np.asarray(advance(*given)[1]) for given in (inputs, turned, inputs))
    np.testing.assert_array_equal(again, first)
    np.testing.assert_array_equal(other, np.roll(first, 1, 0))
    assert np.abs(other - first).max() > 0.5


def test_cuda_repeats_to_the_bit(hand, grips):
    """50 ticks in a scan, also in a batch that does not fill its last block and in a batch of batches."""
    inputs, *_ = grips
    physics = Physics(hand, SLOTS, ObjectConfig().largest, PhysicsConfig(), gravity=GRAVITY, backend="cuda")

    def ticks(object, state, torque):
        def body(state, _):
            result = physics.advance(lambda *_: torque, physics.fields(object), state, jnp.zeros(3))
            return result.state, result.finger_force

        return jax.lax.scan(body, state, length=50)

    def same(result, part=lambda x: x):
        jax.tree.map(lambda a, b: np.testing.assert_array_equal(part(a), b), result, whole)

    whole, count = jit(jax.vmap(ticks))(*inputs), EACH * len(SHAPES)
    same(jit(jax.vmap(ticks))(*inputs))
    more = jax.tree.map(lambda x: jnp.concatenate([jnp.asarray(x)] * 2)[: count + 1], inputs)
    same(jit(jax.vmap(ticks))(*more), lambda x: x[:count])
    pairs = jax.tree.map(lambda x: jnp.reshape(x, (EACH, len(SHAPES), *np.shape(x)[1:])), inputs)
    same(jit(jax.vmap(jax.vmap(ticks)))(*pairs), lambda x: x.reshape(count, *x.shape[2:]))
