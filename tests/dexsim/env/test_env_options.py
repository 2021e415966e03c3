"""What an environment does beyond its defaults: imperfect taxels, a scale of the ranges, objects held at first."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from episodes import ones_of
from simple_physics import SimplePhysics
from swapped import drawn, rollout

import dexsim
from dexsim.core.compilation import jit
from dexsim.objects.config import ObjectConfig
from dexsim.sensing.config import Sensing
from dexsim.sensing.taxels import TaxelSensor
from dexsim.tasks.grasp.config import GraspConfig

WORLDS = 16
POOR_TAXELS = TaxelSensor(
    hysteresis=(0.0, 0.3),
    crosstalk=(0.0, 0.1),
    gain=(0.85, 1.15),
    bias=(-0.03, 0.03),
    drift=(0.0, 0.005),
    dead=(0.0, 0.05),
)


@pytest.fixture(scope="module")
def env():
    """Over simple physics, with imperfect taxels; objects are let go after 0.1 s."""
    taxels = dataclasses.replace(POOR_TAXELS, rate=(8.0, 20.0), resolution=0.0)
    config = GraspConfig(
        sensing=Sensing(taxel=taxels),
        pool_size=4,
        objects=ObjectConfig(shapes=("sphere",)),
        release_delay=(0.1, 0.1),
        push_probability=0.0,
    )
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("dexsim.env.env.Physics", SimplePhysics)
        return dexsim.make("grasp", config, backend="c")


@pytest.fixture(scope="module")
def restarted(env):
    """`restarted(scale, done)`: a batch that was ones everywhere, in which a new episode begins where `done`."""
    restart = jit(jax.vmap(env.restart), once=True)

    def at(scale, done):
        state = jax.vmap(env.set_randomization_scale)(ones_of(env, WORLDS, jnp.ones(WORLDS)), jnp.full(WORLDS, scale))
        return restart(state, done)

    return at


def test_restarts_draw_at_the_states_scale_of_which_zero_is_nominal(env, restarted, hand):
    """Only what is done is drawn; sizes stay as the pool has them."""
    begun = restarted(0.0, jnp.arange(WORLDS) < 12)
    np.testing.assert_array_equal(begun.episode.hand.encoder_bias[:, 0], np.arange(WORLDS) >= 12)
    np.testing.assert_array_equal(begun.scale, 0.0)
    episode, objects = jax.tree.map(lambda leaf: leaf[:12], begun.episode), env.config.objects
    for value, nominal in (
        (episode.hand.actuator.stall_torque, hand.torque_limit),
        (episode.hand.encoder_bias, 0),
        (episode.hand.tilt, 0),
        (episode.imu.bias, 0),
        (episode.taxels["gain"], 1),
        (episode.taxels["bias"], 0),
        (episode.taxels["crosstalk"], 0),
        (episode.taxels["alive"], True),
        (episode.object.mass, np.mean(objects.mass)),
        (episode.object.friction, np.mean(objects.friction)),
        (episode.object.com, 0),
        (episode.object.contact[:, 0], np.mean(objects.stiffness)),
    ):
        np.testing.assert_array_equal(value, np.broadcast_to(np.float32(nominal), value.shape))
    assert len(np.unique(episode.object.contact[:, 1])) == 1
    radius = np.asarray(episode.object.size[:, 1, 0])
    assert len(np.unique(radius)) > 1
    ball = np.mean(objects.mass) * 0.4 * radius**2
    # A sphere is a capsule with a straight part of 0.2 mm.
    np.testing.assert_allclose(episode.object.inertia, np.repeat(ball[:, None], 3, 1), rtol=0.01)


@pytest.fixture(scope="module")
def begun(env, restarted):
    """Episodes that begin, and the compiled step."""
    return restarted(1.0, jnp.ones(WORLDS, bool)), jit(jax.vmap(env.step), once=True)


def test_an_object_is_held_until_it_is_let_go(env, begun):
    """For 0.1 s, four ticks; then it falls freely."""
    (state, step), heights = begun, []
    for _ in range(7):
        state = step(state, jnp.zeros((WORLDS, 12)))
        heights.append(np.asarray(state.physics.qpos[:, 12]))
    np.testing.assert_array_equal(heights[:4], [heights[0]] * 4)
    steps = env.config.physics.substeps * np.arange(1, 4)  # semi-implicit Euler: n (n + 1) / 2 g h^2
    fall = 0.5 * 9.81 * steps * (steps + 1) * env.config.physics.timestep**2
    np.testing.assert_allclose(np.array(heights[4:]) - heights[3], np.tile(fall[:, None], WORLDS), rtol=0.02)


def test_every_error_of_taxels_reaches_their_readings_and_nothing_else(begun):
    states, step = begun
    shows = rollout(step, states, ticks=10)
    found = {path.removeprefix("taxels.") for path in drawn(states.episode) if path.startswith("taxels.")}
    assert found == set("hysteresis memory crosstalk gain bias drift alive rate phase".split())
    for name in found - {"phase"}:  # which shows late
        assert shows(f"taxels.{name}") == ["taxel_force"], name
