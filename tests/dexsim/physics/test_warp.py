"""The Warp backend, on the CPU too: the same sub-step as C MuJoCo and JAX, and full buffers.

Cold Warp kernels compile for about a minute, once per machine.
"""

import dataclasses

import c_scene
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from c_scene import CONVERGED, GRAVITY, row, rows_of, squeeze, stack

import dexsim
from dexsim.objects.config import SHAPES, SLOTS, ObjectConfig
from dexsim.physics.config import PhysicsConfig
from dexsim.physics.interface import PhysicsState
from dexsim.physics.physics import Physics
from dexsim.tasks.rotate.config import RotateConfig

pytest.importorskip("warp")
pytestmark = [pytest.mark.slow]

WORLDS = 4


def compile_advance(hand, config):
    physics = Physics(hand, SLOTS, ObjectConfig().largest, config, gravity=GRAVITY, backend="warp", num_envs=WORLDS)
    return jax.jit(
        jax.vmap(
            lambda target, state, torque: physics.advance(
                lambda index, position, velocity: torque, target, state, jnp.zeros(3)
            )
        )
    )


@pytest.fixture(scope="module")
def worlds(hand, grasp_env):
    """By shape: (batched inputs of 4 worlds in contact, C MuJoCo's qvel and finger forces)."""
    rng, found = np.random.default_rng(4), {}
    for shape in SHAPES:
        inputs, wanted = [], []
        for index in rows_of(grasp_env.pool, shape):
            start = row(grasp_env.pool, index)
            _, *state, torque = squeeze(hand, start, rng)
            # Warp's convex collisions are C MuJoCo's native ones.
            exact = bool(start.object.active[SLOTS.index("cylinder")])
            model = c_scene.compile_scene(hand, start.object, exact=exact, **CONVERGED)
            data = c_scene.start(model, *state)
            data.qfrc_applied[:12] = torque
            mujoco.mj_step(model, data)
            force = c_scene.finger_force(model, data, hand)
            if np.linalg.norm(force, axis=-1).max() > 0.5 and len(inputs) < WORLDS:
                inputs.append((start.object, *state, torque))
                wanted.append((data.qvel.copy(), force))
        assert len(inputs) == WORLDS, shape
        targets, qpos, qvel, warmstart, torque = zip(*inputs, strict=True)
        state = PhysicsState(*(jnp.stack(x) for x in (qpos, qvel, warmstart)))
        found[shape] = ((stack(targets), state, jnp.stack(torque)), *(np.stack(x) for x in zip(*wanted, strict=True)))
    return found


@pytest.fixture(scope="module")
def results(hand, worlds):
    advance = compile_advance(hand, PhysicsConfig(substeps=1, **CONVERGED))
    return {shape: advance(*inputs) for shape, (inputs, *_) in worlds.items()}


@pytest.mark.parametrize("shape", SHAPES)
def test_a_sub_step_equals_c_mujoco(worlds, results, shape):
    """Both walk the same contacts: what is left is float32, 1e-3 of a newton and of a rad/s."""
    _, velocity, force = worlds[shape]
    after, found = results[shape]
    assert np.all(np.linalg.norm(found, axis=-1).max(-1) > 0.4), "no force in contact"
    np.testing.assert_allclose(found, force, atol=0.005)
    np.testing.assert_allclose(after.qvel, velocity, atol=2e-3)


@pytest.mark.parametrize("shape", ["sphere", "capsule"])
def test_a_sub_step_equals_jax(worlds, results, physics_advance, shape):
    (target, state, torque), *_ = worlds[shape]
    double = jax.tree.map(lambda x: jnp.concatenate([x, x]), (target, state, torque))
    after, force = physics_advance(*double, jnp.zeros((2 * WORLDS, 3)))
    np.testing.assert_allclose(results[shape][1], force[:WORLDS], atol=0.03, rtol=0.03)
    np.testing.assert_allclose(results[shape][0].qvel, after.qvel[:WORLDS], atol=0.02)


def test_a_full_buffer_is_loud(hand, worlds, monkeypatch):
    """Fewer constraint rows than a grip needs: Warp would drop contacts without a word."""
    monkeypatch.setattr("dexsim.physics.warp_backend.constraint_rows", lambda config, hand: 16)
    advance = compile_advance(hand, PhysicsConfig(substeps=2))
    (inputs, *_) = worlds["box"]
    _, force = advance(*inputs)
    broken = np.isnan(np.asarray(force)).all((1, 2))
    assert np.any(broken)
    assert np.all(np.isfinite(np.asarray(force)[~broken]))


def test_the_palm_ends_where_the_hand_does():
    """A cube over the palm's edge stays as long as its weight's line meets the palm, and falls beyond.

    Boxes on boxes have a kernel of their own.
    """
    env = dexsim.make("rotate", RotateConfig(pool_size=16), backend="warp", num_envs=8)
    half, down = 0.0275, np.asarray(env.task.gravity)
    palm = next(g for g in env.hand.geoms if g.name == "palm")
    edge = palm.position[1] + palm.size[1]
    past = np.array([-0.006, -0.004, -0.002, -0.001, 0.001, 0.002, 0.004, 0.006])  # m, of the line's foot
    target = jax.tree.map(lambda x: jnp.repeat(jnp.asarray(x)[:1], 8, 0), env.pool.object)
    target = dataclasses.replace(
        target, size=jnp.full_like(target.size, half), com=jnp.zeros((8, 3)), link_friction=jnp.full(8, 0.7)
    )
    qpos = np.zeros((8, 19), np.float32)
    qpos[:, :12] = np.clip(0, env.hand.joint_lower, env.hand.joint_upper)  # thumb and fingers out of the way
    qpos[:, 12:16] = palm.position[0] + palm.size[0] + half, 0, 0.085, 1
    qpos[:, 13] = edge - half * down[1] / -down[0] + past
    state = PhysicsState(jnp.asarray(qpos), jnp.zeros((8, 18)), jnp.zeros((8, 18)))
    advance = jax.jit(
        jax.vmap(
            lambda target, state: env.physics.advance(
                target, state, lambda index, position, velocity: jnp.zeros(12), jnp.zeros(3)
            )[0]
        )
    )
    for _ in range(20):
        state = advance(target, state)
        state = dataclasses.replace(
            state, qpos=state.qpos.at[:, :12].set(qpos[:, :12]), qvel=state.qvel.at[:, :12].set(0.0)
        )
    moved = np.linalg.norm(np.asarray(state.qpos[:, 12:15]) - qpos[:, 12:15], axis=-1)
    assert np.all(moved[past < 0] < 1e-3) and np.all(moved[past > 0] > 0.1), moved
