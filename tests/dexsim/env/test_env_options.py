"""What an environment does beyond its defaults: imperfect taxels, and a scale of the ranges."""

import dataclasses
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from simple_physics import SimplePhysics
from swapped import drawn, rollout

import dexsim
from dexsim.core.compilation import jit
from dexsim.objects.config import ObjectConfig
from dexsim.sensing.config import Sensing
from dexsim.sensing.taxels import TaxelSensor
from dexsim.tasks.grasp.config import GraspConfig

KEY = jax.random.key(0)
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
    """Over simple physics, with imperfect taxels."""
    taxels = dataclasses.replace(POOR_TAXELS, rate=(8.0, 20.0), resolution=0.0)
    config = GraspConfig(sensing=Sensing(taxel=taxels), pool_size=4, objects=ObjectConfig(shapes=("sphere",)))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("dexsim.env.env.Physics", SimplePhysics)
        return dexsim.make("grasp", config, backend="c")


class TestScale:
    """A width of the ranges that is part of the state: 0 is nominal exactly, for hand, sensors and object."""

    def test_zero_is_nominal(self, env, hand):
        objects = env.config.objects
        rows = jax.tree.map(lambda leaf: jnp.asarray(leaf)[np.arange(64) % 4], env.pool.object)
        draw = jit(jax.vmap(lambda *given: env.sampler.sample(*given, jnp.float32(0))), once=True)
        state = SimpleNamespace(episode=draw(*jax.random.split(jax.random.key(0), (3, 64)), rows))
        for value, nominal in (
            (state.episode.hand.actuator.stall_torque, hand.torque_limit),
            (state.episode.hand.encoder_bias, 0),
            (state.episode.hand.tilt, 0),
            (state.episode.imu.bias, 0),
            (state.episode.taxels["gain"], 1),
            (state.episode.taxels["bias"], 0),
            (state.episode.taxels["crosstalk"], 0),
            (state.episode.taxels["alive"], True),
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

    def test_restarts_draw_at_the_states_scale(self, env):
        """Here of a state with ones everywhere: only what is done is drawn, and at the state's scale."""
        shapes = jax.eval_shape(lambda key: jax.vmap(env.reset)(jax.random.split(key, 8), jnp.ones(8)), KEY)
        ones = lambda x: jnp.ones(x.shape, x.dtype)  # noqa: E731
        is_key = lambda x: jnp.issubdtype(x.dtype, jax.dtypes.prng_key)  # noqa: E731
        state = jax.tree.map(lambda x: jax.random.split(KEY, x.shape) if is_key(x) else ones(x), shapes)
        state = jax.vmap(env.set_randomization_scale)(state, jnp.zeros(8))
        begun = jit(jax.vmap(env.restart), once=True)(state, jnp.arange(8) < 4)
        np.testing.assert_array_equal(begun.episode.hand.encoder_bias[:, 0], np.arange(8) >= 4)
        np.testing.assert_array_equal(begun.scale, 0.0)
        np.testing.assert_array_equal(begun.episode.object.mass[:4], np.float32(np.mean(env.config.objects.mass)))


def test_every_error_of_taxels_reaches_their_readings_and_nothing_else(env):
    states = jit(lambda key: jax.vmap(env.reset)(jax.random.split(key, 8)), once=True)(KEY)
    shows = rollout(jit(jax.vmap(env.step), once=True), states, ticks=10)
    found = {path.removeprefix("taxels.") for path in drawn(states.episode) if path.startswith("taxels.")}
    assert found == set("hysteresis memory crosstalk gain bias drift alive rate phase".split())
    for name in found - {"phase"}:  # which shows late
        assert shows(f"taxels.{name}") == ["taxel_force"], name
