"""Engines `c` and `mjx` in one grip and one slide against C MuJoCo, and gradients through contacts by `mjx`.

`cuda` has the same states in an emulated warp (`test_cuda_kernel`) and on a GPU (`test_on_gpu`).
"""

import dataclasses
import functools

import c_scene
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from c_scene import GRAVITY, row, rows_of, squeeze, stack
from two_fingers import write

from dexsim.core.compilation import jit
from dexsim.core.errors import AssetError
from dexsim.hand.load import load_hand
from dexsim.objects.config import SLOTS, ObjectConfig
from dexsim.objects.params import ObjectParams
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


def test_what_mjx_refuses_is_named(hand, monkeypatch):
    from mujoco import mjx

    def refuse(model, **_):
        raise NotImplementedError("no such joint")

    monkeypatch.setattr(mjx, "put_model", refuse)
    with pytest.raises(AssetError, match="backend mjx: no such joint"):
        physics_of(hand, "mjx")


# --- gradients, forward and reverse: two fingers that pinch a capsule ---

# One finger has a coupled joint, the other dry friction and a limit that presses.
MJCF = """
<mujoco>
  <compiler angle="radian"/>
  <default>
    <joint type="hinge" damping="0.01" armature="0.0005" actuatorfrcrange="-.5 .5"/>
    <geom contype="0" conaffinity="0"/>
    <default class="tip"><geom type="sphere" size=".01" mass=".01" contype="1" conaffinity="1"/></default>
  </default>
  <worldbody>
    <body name="base"><geom name="base" type="box" size=".02 .04 .005" mass=".2"/>
      <body name="a1" pos="0 .0326 0">
        <joint name="a" axis="1 0 0" range="-0.5 1.2"/>
        <geom type="capsule" fromto="0 0 0 0 0 .02" size=".005" mass=".02"/>
        <body name="a2" pos="0 0 .025">
          <joint name="a_next" axis="1 0 0" range="-1 2"/>
          <geom name="a2" class="tip" pos="0 0 .025"/>
          <site name="a_tip" pos="0 0 .025"/>
        </body>
      </body>
      <body name="b1" pos="0 -.0326 0">
        <joint name="b" axis="-1 0 0" range="0.01 1.2" frictionloss="0.003"/>
        <geom name="b1" class="tip" pos="0 0 .05"/>
        <site name="b_tip" pos="0 0 .05"/>
      </body>
    </body>
  </worldbody>
  <equality><joint name="couple" joint1="a_next" joint2="a" polycoef="0 0.7 0 0 0"/></equality>
</mujoco>
"""


@pytest.fixture(scope="module")
def physics(tmp_path_factory):
    folder = tmp_path_factory.mktemp("two")
    hand = load_hand(write(folder, MJCF, "a,0,0,0,-.01,.025,0,-1,0,1e-5\nb,0,0,0,.01,.05,0,1,0,1e-5\n"))
    size, config = np.float32([[0.02, 0.03, 0]]), PhysicsConfig(substeps=2)
    return Physics(hand, ("capsule",), size, config, gravity=(9.81, 0, 0), backend="mjx")


def test_gradients_in_a_pinch_are_finite_differences(physics):
    """Of the object's velocity and the fingertips' forces, where contacts stick and where they slip."""
    object = ObjectParams(
        shape_index=jnp.int32(0),
        size=jnp.array([[0.02, 0.03, 0]]),
        position=jnp.zeros((1, 3)),
        active=jnp.ones(1, bool),
        mass=jnp.float32(0.1),
        inertia=jnp.array([5e-5, 5e-5, 2e-5]),
        com=jnp.zeros(3),
        friction=jnp.float32(0.0),
        link_friction=jnp.float32(0.0),
        contact=jnp.array([1700.0, 1.0]),
        kinds=("capsule",),
    )
    pose = jnp.array([0.003, 0.002, 0.008, 0, 0, 0.05, 1, 0, 0, 0])  # joint b is beyond its limit
    speed = jnp.array([0.1, 0.07, 0.05, 0.02, 0.01, -0.03, 0.4, -0.2, 0.3])
    weight = jnp.asarray(np.random.default_rng(0).normal(size=12), jnp.float32)

    def outcome(x):
        """Of targets [2] of the joints, friction and mass."""

        def law(substep, position, velocity):
            return 2.0 * (x[:2] - position) - 0.05 * velocity

        held = dataclasses.replace(object, friction=x[2], mass=x[3])
        result = physics.advance(law, held, PhysicsState(pose, speed, jnp.zeros(9)), jnp.zeros(3))
        return jnp.sum(weight * jnp.concatenate([result.state.qvel[3:], result.finger_force.ravel()]))

    @functools.partial(jit, once=True)
    def derivatives(x):
        """Value, gradient, and slope along [1, 1, 1, 1] in forward mode, from one linearisation: one compilation."""
        value, push = jax.linearize(outcome, x)
        return value, jax.linear_transpose(push, x)(jnp.float32(1.0))[0], push(jnp.ones(4))

    for friction in (0.9, 0.1):
        x, steps = np.float32([0.06, 0.08, friction, 0.1]), np.diag(np.float32([0.01, 0.01, 0.02, 0.002]))
        _, reverse, forward = derivatives(x)
        numeric = [(derivatives(x + step)[0] - derivatives(x - step)[0]) / (2 * step.sum()) for step in steps]
        np.testing.assert_allclose(reverse, numeric, rtol=0.01, atol=1e-3)
        assert float(forward) == pytest.approx(float(reverse.sum()), rel=1e-4)
        assert (reverse[2] != 0) == (friction == 0.1), "contacts that stick do not feel friction, those that slip do"
