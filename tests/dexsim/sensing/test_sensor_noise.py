"""The sensor's imperfections, one at a time, against closed forms and their statistics."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dexsim.core.config import from_dict, to_dict
from dexsim.core.errors import ConfigError
from dexsim.sensing.taxels import SensorNoise, neighbour_difference

GRID, FINGERS, PERIOD = (10, 12), 5, 0.02
SHAPE = (FINGERS, GRID[0] * GRID[1])
KEY = jax.random.key(0)
INACTIVE_SIZE = SensorNoise(
    hysteresis=None,
    crosstalk=None,
    gain=None,
    bias=None,
    drift=None,
    noise=None,
    dead=None,
    threshold=None,
    counts="none",
    rate=None,
)


def model(**effects):
    return dataclasses.replace(INACTIVE_SIZE, **effects).model(GRID, fingers=FINGERS, control_period=PERIOD)


def forces(seed=0):
    rng = np.random.default_rng(seed)
    return (rng.uniform(0, 3, SHAPE) * (rng.random(SHAPE) < 0.2)).astype(np.float32)


def run(sensor, force, key=KEY):
    """Readings [T, F, N] of forces [T, F, N], and the episode's draw."""
    params = sensor.sample(key)

    def step(state, inputs):
        return sensor.apply(params, state, *inputs)

    keys = jax.random.split(jax.random.fold_in(key, 1), len(force))
    return np.asarray(jax.jit(lambda: jax.lax.scan(step, sensor.init(), (keys, jnp.asarray(force))))()[1]), params


def test_scale_zero_is_the_identity_exactly():
    sensor = SensorNoise(scale=0.0, rate=(5.0, 10.0)).model(GRID, fingers=FINGERS, control_period=PERIOD)
    force = np.stack([forces(seed) for seed in range(5)])
    np.testing.assert_array_equal(run(sensor, force)[0], force)


def test_everything_off_is_the_identity_exactly():
    force = np.stack([forces(seed) for seed in range(5)])
    np.testing.assert_array_equal(run(model(), force)[0], force)


def test_a_small_scale_is_a_small_error():
    sensor = dataclasses.replace(SensorNoise(), scale=1e-4, counts="none")
    force = np.stack([forces(seed) for seed in range(4)])
    readings, params = run(sensor.model(GRID, fingers=FINGERS, control_period=PERIOD), force)
    assert bool(params.alive.all())
    assert 0 < np.abs(readings - force).max() < 2e-3


def test_hysteresis_is_an_exponential_creep():
    """After a step to 2 N the reading is 2 (1 - a exp(-t / tau)); after the release a share lingers."""
    sensor = model(hysteresis=(0.4, 0.4), hysteresis_time=(0.1, 0.1))
    force = np.zeros((40, *SHAPE), np.float32)
    force[:20, 2, 7] = 2.0
    readings, _ = run(sensor, force)
    time = PERIOD * np.arange(1, 21)
    np.testing.assert_allclose(readings[:20, 2, 7], 2 * (1 - 0.4 * np.exp(-time / 0.1)), rtol=1e-5)
    left = 2 * (1 - np.exp(-20 * PERIOD / 0.1))
    np.testing.assert_allclose(readings[20:, 2, 7], 0.4 * left * np.exp(-time / 0.1), rtol=1e-4)
    np.testing.assert_array_equal(readings[:, 2, 8], 0)


def test_hysteresis_makes_a_loop():
    """Loading and unloading through the same force, the reading is lower on the way up."""
    sensor = model(hysteresis=(0.3, 0.3), hysteresis_time=(0.1, 0.1))
    ramp = np.concatenate([np.linspace(0, 5, 25), np.linspace(5, 0, 25)[1:]]).astype(np.float32)
    readings, _ = run(sensor, np.broadcast_to(ramp[:, None, None], (len(ramp), *SHAPE)))
    up, down = readings[5:20, 0, 0], readings[::-1][5:20, 0, 0]
    assert np.all(down - up > 0.1)


def test_crosstalk_by_loops_and_keeps_the_total():
    sensor = model(crosstalk=(0.2, 0.2))
    force = forces()
    map_ = force.reshape(FINGERS, *GRID)
    wanted = map_.copy()
    for column in range(GRID[0]):
        for row in range(GRID[1]):
            for c, r in ((column - 1, row), (column + 1, row), (column, row - 1), (column, row + 1)):
                if 0 <= c < GRID[0] and 0 <= r < GRID[1]:
                    wanted[:, column, row] += 0.05 * (map_[:, c, r] - map_[:, column, row])
    reading = run(sensor, force[None])[0][0]
    np.testing.assert_allclose(reading, wanted.reshape(SHAPE), atol=1e-6)
    np.testing.assert_allclose(reading.sum(1), force.sum(1), rtol=1e-5)
    np.testing.assert_allclose(neighbour_difference(jnp.ones(SHAPE), GRID), 0, atol=1e-7)


def test_gain_and_bias_are_each_taxels_own_and_last_an_episode():
    sensor = model(gain=(0.8, 1.2), bias=(-0.05, 0.05))
    zero, one = np.zeros((3, *SHAPE), np.float32), np.ones((3, *SHAPE), np.float32)
    bias, params = run(sensor, zero)
    total, _ = run(sensor, one)
    np.testing.assert_array_equal(bias[0], bias[2])
    gain = total[0] - bias[0]
    assert 0.8 <= gain.min() < 0.82 and 1.18 < gain.max() <= 1.2 and np.abs(bias).max() <= 0.05
    assert gain.std() == pytest.approx(0.4 / np.sqrt(12), rel=0.1)
    other, _ = run(sensor, one, jax.random.key(1))
    assert np.abs(other[0] - total[0]).mean() > 0.05


def test_drift_grows_with_the_root_of_time():
    sensor = model(drift=(0.02, 0.02))
    readings, _ = run(sensor, np.zeros((200, *SHAPE), np.float32))
    for step in (50, 200):
        assert readings[step - 1].std() == pytest.approx(0.02 * np.sqrt(step * PERIOD), rel=0.1)
    assert abs(readings[-1].mean()) < 0.01


def test_noise_is_white():
    sensor = model(noise=(0.1, 0.1))
    readings, _ = run(sensor, np.zeros((60, *SHAPE), np.float32))
    assert readings.std() == pytest.approx(0.1, rel=0.02)
    assert abs(np.mean(readings[1:] * readings[:-1])) < 0.1 * 0.1**2


def test_dead_taxels_stay_dead_and_their_share_is_drawn():
    sensor = model(dead=(0.1, 0.1))
    readings, params = run(sensor, np.ones((3, *SHAPE), np.float32))
    dead = readings == 0
    np.testing.assert_array_equal(dead[0], dead[2])
    np.testing.assert_array_equal(dead[0], ~np.asarray(params.alive))
    shares = jax.vmap(lambda key: 1 - jnp.mean(sensor.sample(key).alive))(jax.random.split(KEY, 100))
    assert float(shares.mean()) == pytest.approx(0.1, abs=0.01)


def test_threshold():
    sensor = model(threshold=(0.1, 0.3))
    ramp = np.linspace(0, 0.5, 51, dtype=np.float32)
    readings, params = run(sensor, np.broadcast_to(ramp[:, None, None], (51, *SHAPE)))
    onset = np.where(readings > 0, readings, np.inf).min(0)
    threshold = np.asarray(params.threshold)
    assert threshold.min() >= 0.1 and threshold.max() <= 0.3
    assert np.all(onset >= threshold - 1e-6) and np.all(onset <= threshold + 0.0101)


@pytest.mark.parametrize(("counts", "low", "high"), [("uint8", 0.0, 25.5), ("int8", -12.8, 12.7)])
def test_counts_and_saturation_are_the_hands(counts, low, high):
    force = np.zeros((1, *SHAPE), np.float32)
    force[0, 0, :7] = [0.04, 0.06, 1.234, 25.4, 300.0, -0.3, -300.0]
    reading = run(model(counts=counts), force)[0][0, 0, :7]
    wanted = np.clip(np.round(force[0, 0, :7], 1), low, high)
    np.testing.assert_allclose(reading, wanted, atol=1e-5)


def test_sampling_below_the_control_rate_holds_the_last_reading():
    """20 Hz under 50 Hz control: 2 new readings in 5 steps, the first at once, the others at a random phase."""
    sensor = model(rate=(20.0, 20.0))
    ramp = np.arange(1, 101, dtype=np.float32)
    readings, _ = run(sensor, np.broadcast_to(ramp[:, None, None], (100, *SHAPE)))
    assert readings[0, 0, 0] == 1
    fresh = readings[:, 0, 0] == ramp
    assert fresh[5:].sum() == pytest.approx(0.4 * 95, abs=1)
    age = ramp - readings[:, 0, 0]
    assert age.max() <= 2
    np.testing.assert_array_equal(readings, np.broadcast_to(readings[:, :1, :1], readings.shape))
    phases = jax.vmap(lambda key: sensor.sample(key).phase)(jax.random.split(KEY, 200))
    assert 0.2 < float(phases.std()) < 0.35


def test_a_rate_above_the_control_rate_changes_nothing():
    force = np.stack([forces(seed) for seed in range(5)])
    np.testing.assert_array_equal(run(model(rate=(200.0, 200.0)), force)[0], force)


def test_all_at_once_under_vmap():
    sensor = SensorNoise(rate=(20.0, 40.0)).model(GRID, fingers=FINGERS, control_period=PERIOD)
    keys = jax.random.split(KEY, 3)
    params = jax.vmap(sensor.sample)(keys)
    state = jax.tree.map(lambda x: jnp.stack([x] * 3), sensor.init())
    force = jnp.stack([jnp.asarray(forces(seed)) for seed in range(3)])
    after, reading = jax.jit(jax.vmap(sensor.apply))(params, state, keys, force)
    one, alone = sensor.apply(jax.tree.map(lambda x: x[1], params), sensor.init(), keys[1], force[1])
    np.testing.assert_allclose(reading[1], alone, atol=1e-5)
    assert jax.tree.structure(after) == jax.tree.structure(state)
    counts = np.asarray(reading) / 0.1
    np.testing.assert_allclose(counts, np.round(counts), atol=1e-4)


def test_settings_survive_the_round_trip_and_bad_ones_are_refused():
    config = dataclasses.replace(SensorNoise(), rate=(20.0, 30.0), dead=None)
    assert from_dict(SensorNoise, to_dict(config)) == config
    for fields, words in (
        ({"gain": (1.2, 0.8)}, r"SensorNoise\.gain"),
        ({"dead": (0.0, 1.5)}, r"SensorNoise\.dead"),
        ({"counts": "int4"}, r"SensorNoise\.counts"),
        ({"gain": (0.05, 1.0), "scale": 2.0}, "reaches below 0"),
        ({"hysteresis": (0.0, 0.9), "scale": 2.0}, "exceeds 1"),
    ):
        with pytest.raises(ConfigError, match=words):
            SensorNoise(**fields)
