"""Engines `c` and `mjx` in one grip and one slide against C MuJoCo, and gradients through `mjx`.

`cuda` has the same states in an emulated warp (`test_cuda_kernel`) and on a GPU (`test_on_gpu`).
"""

import dataclasses

import c_scene
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from c_scene import GRAVITY, row, rows_of, squeeze, stack

from dexsim.core.compilation import jit
from dexsim.core.errors import AssetError
from dexsim.objects.config import SLOTS, ObjectConfig
from dexsim.physics.config import PhysicsConfig
from dexsim.physics.interface import PhysicsState
from dexsim.physics.physics import Physics

SUBSTEPS = 2
CAPSULE = SLOTS.index("capsule")  # MJX compiles one kind of primitive in a third of the time of all


def alone(objects):
    """Capsules without the other slots."""
    parts = {name: getattr(objects, name)[..., CAPSULE : CAPSULE + 1, :] for name in ("size", "position")}
    return dataclasses.replace(objects, kinds=("capsule",), active=objects.active[..., CAPSULE : CAPSULE + 1], **parts)


def physics_of(hand, backend):
    largest = ObjectConfig().largest[CAPSULE : CAPSULE + 1]
    config = PhysicsConfig(substeps=SUBSTEPS)
    return Physics(hand, ("capsule",), largest, config, gravity=GRAVITY, backend=backend)


@pytest.fixture(scope="module")
def worlds(hand, grasp_env):
    """Inputs of three grips and one slide over the palm: objects, state, torque, push; and C MuJoCo's velocities and
    finger forces at the end of `SUBSTEPS`."""
    rng, inputs, outcomes = np.random.default_rng(5), [], []
    for start in (row(grasp_env.pool, i) for i in rows_of(grasp_env.pool, "capsule")):
        model, qpos, qvel, warmstart, torque = squeeze(hand, start, rng)
        push = np.zeros(3, np.float32)
        if len(inputs) == 3:  # lying on the palm, away from fingers, with gravity onto it
            qpos, qvel, warmstart, torque = (np.zeros_like(x) for x in (qpos, qvel, warmstart, torque))
            place = model.geom("palm_face").id
            data = mujoco.MjData(model)
            mujoco.mj_forward(model, data)
            height = data.geom_xpos[place, 0] + start.object.size[CAPSULE, 0]
            qpos[12:16], qvel[13] = (height - 2e-4, 0.0, -0.5, 1.0), 0.3
            push[0] = -2 * 9.81 * start.object.mass
        data = c_scene.start(model, qpos, qvel, warmstart)
        data.qfrc_applied[:12] = torque
        data.xfrc_applied[model.body("object").id, :3] = push
        for _ in range(SUBSTEPS):
            mujoco.mj_step(model, data)
        force = c_scene.finger_force(model, data, hand)
        if len(inputs) < 3 and np.linalg.norm(force, axis=-1).max() < 0.5:
            continue  # a hand that holds nothing
        inputs.append((alone(start.object), PhysicsState(qpos, qvel, warmstart), torque, push))
        outcomes.append((data.qvel.copy(), force, qvel))
        if len(inputs) == 4:
            break
    return stack(inputs), *(np.stack(x) for x in zip(*outcomes, strict=True))


@pytest.fixture(scope="module")
def mjx_physics(hand):
    return physics_of(hand, "mjx")


@pytest.mark.parametrize("backend", ["c", "mjx"])
def test_a_grip_and_a_slide_are_c_mujocos(hand, worlds, mjx_physics, backend):
    inputs, velocity, force, before = worlds
    physics = mjx_physics if backend == "mjx" else physics_of(hand, backend)
    tick = jit(jax.vmap(lambda o, s, torque, push: physics.advance(lambda *_: torque, o, s, push)), once=True)
    after, pressed = tick(*inputs)
    assert len(force) == 4
    assert not np.any(force[3]) and velocity[3, 13] < before[3, 13] - 0.02, "no friction on the palm"
    np.testing.assert_allclose(pressed, force, atol=0.02)
    np.testing.assert_allclose(after.qvel, velocity, atol=5e-3)


@pytest.mark.slow
def test_gradients_through_a_grip_are_finite_differences(worlds, mjx_physics):
    """Of velocities and forces after two sub-steps, along a random change of the torques, of friction, and of mass."""
    (object, state, torque, push), *_ = jax.tree.map(lambda x: x[0], worlds)
    weight, way = (np.float32(np.random.default_rng(k).normal(size=n)) for k, n in ((0, 18), (1, 12)))

    def outcome(along):
        """Of how far [3] torque, friction and mass have changed."""
        held = dataclasses.replace(object, friction=object.friction + along[1], mass=object.mass + along[2])
        result = mjx_physics.advance(lambda *_: torque + along[0] * way, held, state, push)
        return jnp.sum(weight * result.state.qvel) + jnp.sum(result.finger_force)

    def derivatives(x):
        _, push = jax.linearize(outcome, x)
        return jax.linear_transpose(push, x)(jnp.float32(1.0))[0], jax.vmap(push)(jnp.eye(3))

    steps = np.diag(np.float32([3e-3, 0.01, 0.003]))
    after, before = jit(jax.vmap(outcome), once=True)(np.concatenate([steps, -steps])).reshape(2, 3)
    numeric = (after - before) / (2 * np.diag(steps))
    reverse, forward = jit(derivatives, once=True)(jnp.zeros(3))
    assert abs(numeric[0]) > 0.1
    np.testing.assert_allclose(reverse, numeric, rtol=0.05)
    np.testing.assert_allclose(forward, reverse, rtol=1e-3)


def test_what_mjx_refuses_is_named(hand, monkeypatch):
    from mujoco import mjx

    def refuse(model, **_):
        raise NotImplementedError("no such joint")

    monkeypatch.setattr(mjx, "put_model", refuse)
    with pytest.raises(AssetError, match="backend mjx: no such joint"):
        physics_of(hand, "mjx")
