"""What a taxel array does to the force, one effect at a time, against closed forms and their statistics."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dexsim.hand.load import load_hand
from dexsim.sensing.taxels import TaxelArray, TaxelSensor, neighbour_difference

HAND, PERIOD = load_hand(), 0.02
GRID, SHAPE = HAND.taxel_grid, HAND.taxel_area.shape
KEY = jax.random.key(0)
IDEAL = TaxelSensor(noise=0.0, threshold=0.0, resolution=0.0, saturation=1000.0)
BASE = 5.0  # N on every taxel, so that errors of both signs are read


def model(**effects):
    return TaxelArray(dataclasses.replace(IDEAL, **effects), HAND, PERIOD)


def forces(seed=0):
    rng = np.random.default_rng(seed)
    return (rng.uniform(0, 3, SHAPE) * (rng.random(SHAPE) < 0.2)).astype(np.float32)


def run(sensor, force, key=KEY, finger_gain=1.0):
    """Readings [T, F, N] of forces [T, F, N], and the episode's draw."""
    params = sensor.sample(key)

    def step(state, inputs):
        return sensor.apply(params, state, *inputs, finger_gain)

    keys = jax.random.split(jax.random.fold_in(key, 1), len(force))
    return np.asarray(jax.jit(lambda: jax.lax.scan(step, sensor.init(), (keys, jnp.asarray(force))))()[1]), params


def test_an_ideal_sensor_reads_the_truth_and_has_no_arrays():
    force = np.stack([forces(seed) for seed in range(5)])
    readings, params = run(model(), force)
    np.testing.assert_array_equal(readings, force)
    assert not jax.tree.leaves((params, model().init()))


def test_threshold_counts_and_saturation():
    force = np.zeros((1, *SHAPE), np.float32)
    force[0, 0, :10] = [0.0, 0.1, 0.24, 0.26, 0.31, 0.36, 1.04, 25.46, 25.7, 300.0]
    readings, _ = run(model(threshold=0.25, resolution=0.1, saturation=25.5), force)
    wanted = [0.0, 0.0, 0.0, 0.3, 0.3, 0.4, 1.0, 25.5, 25.5, 25.5]
    np.testing.assert_allclose(readings[0, 0, :10], wanted, atol=1e-5)


def test_noise_has_its_width_and_gain_is_the_fingers_own():
    gain = np.float32([[0.8], [0.9], [1.0], [1.1], [1.2]])
    readings, _ = run(model(noise=0.2), np.full((50, *SHAPE), 10, np.float32), finger_gain=gain)
    np.testing.assert_allclose(readings.mean((0, 2)), 10 * gain[:, 0], atol=0.02)
    np.testing.assert_allclose(readings.std((0, 2)), 0.2, rtol=0.05)
    assert np.mean(readings[1:] == readings[:-1]) < 0.01, "of every reading its own"


def test_hysteresis_is_an_exponential_creep_to_the_force_times_the_fingers_gain():
    """After a step to 2 N a finger of gain g reads 2 g (1 - a exp(-t / tau)); after the release a share lingers."""
    sensor = model(hysteresis=(0.4, 0.4), hysteresis_time=(0.1, 0.1))
    gain, force = np.float32([[0.8], [0.9], [1.0], [1.1], [1.2]]), np.zeros((40, *SHAPE), np.float32)
    force[:20, :, 7] = 2.0
    readings, _ = run(sensor, force, finger_gain=gain)
    time = PERIOD * np.arange(1, 21)[:, None]
    np.testing.assert_allclose(readings[:20, :, 7], 2 * gain.T * (1 - 0.4 * np.exp(-time / 0.1)), rtol=1e-5)
    left = 2 * gain.T * (1 - np.exp(-20 * PERIOD / 0.1))
    np.testing.assert_allclose(readings[20:, :, 7], 0.4 * left * np.exp(-time / 0.1), rtol=1e-4)
    np.testing.assert_array_equal(readings[..., 8], 0)


def test_crosstalk_by_loops_and_keeps_the_total():
    sensor = model(crosstalk=(0.2, 0.2))
    force = forces()
    map_ = force.reshape(-1, *GRID)
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
    one = np.ones((3, *SHAPE), np.float32)
    total, _ = run(sensor, one)
    double, _ = run(sensor, 2 * one)
    np.testing.assert_array_equal(total[0], total[2])
    gain = double[0] - total[0]
    bias = total[0] - gain
    assert 0.8 <= gain.min() < 0.82 and 1.18 < gain.max() <= 1.2 and np.abs(bias).max() <= 0.05
    assert gain.std() == pytest.approx(0.4 / np.sqrt(12), rel=0.1)
    other, _ = run(sensor, one, jax.random.key(1))
    assert np.abs(other[0] - total[0]).mean() > 0.05


def test_drift_grows_with_the_root_of_time():
    sensor = model(drift=(0.02, 0.02))
    readings = run(sensor, np.full((200, *SHAPE), BASE, np.float32))[0] - BASE
    for step in (50, 200):
        assert readings[step - 1].std() == pytest.approx(0.02 * np.sqrt(step * PERIOD), rel=0.1)
    assert abs(readings[-1].mean()) < 0.01


def test_dead_taxels_stay_dead_and_their_share_is_drawn():
    sensor = model(dead=(0.1, 0.1))
    readings, params = run(sensor, np.ones((3, *SHAPE), np.float32))
    dead = readings == 0
    np.testing.assert_array_equal(dead[0], dead[2])
    np.testing.assert_array_equal(dead[0], ~np.asarray(params["alive"]))
    shares = jax.jit(jax.vmap(lambda key: 1 - jnp.mean(sensor.sample(key)["alive"])))(jax.random.split(KEY, 100))
    assert float(shares.mean()) == pytest.approx(0.1, abs=0.01)


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
    phases = jax.jit(jax.vmap(lambda key: sensor.sample(key)["phase"]))(jax.random.split(KEY, 200))
    assert 0.2 < float(phases.std()) < 0.35
