"""What an environment does beyond its defaults: imperfect taxels, added observations, scales."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from ranges import draw_alone
from simple_physics import SimplePhysics

import dexsim
from dexsim.core.compilation import jit
from dexsim.objects.config import ObjectConfig
from dexsim.observation import ObservationConfig
from dexsim.randomization import Randomization
from dexsim.sensing.config import Sensing
from dexsim.sensing.imu import ImuConfig
from dexsim.sensing.taxels import TaxelSensor
from dexsim.tasks.grasp.config import GraspConfig

WORLDS = 4
QUIET_TAXELS = TaxelSensor(noise=0.0, threshold=0.0, resolution=0.0, saturation=1000.0)
POOR_TAXELS = TaxelSensor(
    hysteresis=(0.0, 0.3),
    crosstalk=(0.0, 0.1),
    gain=(0.85, 1.15),
    bias=(-0.03, 0.03),
    drift=(0.0, 0.005),
    dead=(0.0, 0.05),
)
QUIET = Sensing(
    joint_noise=0.0,
    joint_resolution=0.0,
    torque_noise=0.0,
    object_noise=0.0,
    orientation=ImuConfig(noise=0.0, bias=0.0, drift=0.0, delay=(0.0, 0.0)),
    taxel=QUIET_TAXELS,
)


@pytest.fixture(scope="module")
def make():
    """An environment over simple physics, quiet and nominal but for what is asked for."""
    patch = pytest.MonkeyPatch()
    patch.setattr("dexsim.env.env.Physics", SimplePhysics)

    def build(sensing=QUIET, randomization=None, observation=None):
        return dexsim.make(
            "grasp",
            GraspConfig(
                sensing=sensing,
                randomization=randomization or Randomization(scale=0.0),
                pool_size=4,
                observation=observation or ObservationConfig(),
                objects=ObjectConfig(shapes=("sphere",)),
            ),
            backend="c",
        )

    yield build
    patch.undo()


@pytest.fixture(scope="module")
def drawn(make):
    """An environment and 64 resets at three scales."""
    env = make(dataclasses.replace(QUIET, taxel=POOR_TAXELS, orientation=ImuConfig()), Randomization())
    draw = jit(lambda key, scale: jax.vmap(lambda k: env.reset(k, scale))(jax.random.split(key, 64)), once=True)
    return env, {scale: draw(jax.random.key(0), jnp.float32(scale)) for scale in (0.0, 0.5, 1.0)}


class TestScale:
    """A width of the ranges that is part of the state: 0 is nominal exactly, for hand, sensors and object."""

    def test_zero_is_nominal(self, drawn, hand):
        env, states = drawn
        state, objects = states[0.0], env.config.objects
        for value, nominal in (
            (state.episode.hand.actuator.stall_torque, hand.torque_limit),
            (state.episode.hand.encoder_bias, 0),
            (state.episode.hand.tilt, 0),
            (state.episode.imu.bias, 0),
            (state.episode.taxels.gain, 1),
            (state.episode.taxels.bias, 0),
            (state.episode.taxels.crosstalk, 0),
            (state.episode.taxels.alive, True),
            (state.episode.object.mass, np.mean(objects.mass)),
            (state.episode.object.friction, np.mean(objects.friction)),
            (state.episode.object.com, 0),
            (state.episode.object.contact[:, 0], np.mean(objects.stiffness)),
        ):
            np.testing.assert_array_equal(value, np.broadcast_to(np.float32(nominal), value.shape))
        assert len(np.unique(state.episode.object.contact[:, 1])) == 1
        radius = np.asarray(state.episode.object.size[:, 1, 0])
        assert len(np.unique(radius)) > 1  # sizes stay as the pool has them
        ball = np.mean(objects.mass) * 0.4 * radius**2
        # A sphere is a capsule with a straight part of 0.2 mm.
        np.testing.assert_allclose(state.episode.object.inertia, np.repeat(ball[:, None], 3, 1), rtol=0.01)

    def test_restarts_draw_at_the_states_scale(self, drawn):
        env, states = drawn
        state = jax.vmap(env.set_randomization_scale, (0, None))(states[1.0], jnp.float32(0.0))
        np.testing.assert_array_equal(state.episode.hand.encoder_bias, states[1.0].episode.hand.encoder_bias)
        begun = jit(jax.vmap(env.restart), once=True)(state, jnp.arange(64) < 32)
        assert np.all(np.asarray(begun.episode.hand.encoder_bias)[:32] == 0) and np.all(np.asarray(begun.scale) == 0)
        np.testing.assert_array_equal(begun.episode.hand.encoder_bias[32:], state.episode.hand.encoder_bias[32:])
        np.testing.assert_array_equal(begun.episode.object.mass[:32], np.float32(np.mean(env.config.objects.mass)))


def test_every_range_of_taxels_reaches_their_readings_and_nothing_else(make):
    env = make(Sensing(taxel=dataclasses.replace(POOR_TAXELS, rate=(8.0, 20.0), resolution=0.0)), Randomization())
    states = jit(lambda key: jax.vmap(env.reset)(jax.random.split(key, WORLDS)), once=True)(jax.random.key(0))
    step = jax.jit(jax.vmap(env.step))
    for name in ("hysteresis", "hysteresis_time", "crosstalk", "gain", "bias", "drift", "dead", "rate"):
        changed, moved = draw_alone(env, step, states, f"sensing.taxel.{name}", ticks=10)
        assert changed == [f"taxels.{ {'hysteresis_time': 'memory', 'dead': 'alive'}.get(name, name) }"], name
        assert [reading for reading, size in moved.items() if size > 0] == ["taxel_force"], name
