"""Gradients through contacts, forward and reverse, by engine `mjx`: two fingers that pinch a capsule."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from two_fingers import write

from dexsim.core.compilation import jit
from dexsim.hand.load import load_hand
from dexsim.objects.params import ObjectParams
from dexsim.physics.config import PhysicsConfig
from dexsim.physics.interface import PhysicsState
from dexsim.physics.physics import Physics

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
