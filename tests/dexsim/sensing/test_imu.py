"""The object's IMU against SciPy's rotations: whose frame its error is in, and from when its heading drifts."""

import dataclasses
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dexsim.env.config import Sensing
from dexsim.env.env import sample_episode
from dexsim.env.sensors import SensorSuite
from dexsim.randomization import Randomization
from dexsim.sensing.imu import ImuConfig, ImuParams, measure_orientation
from dexsim.tasks.rotate.config import RotateConfig
from dexsim.tasks.rotate.task import Rotate

CONFIG = ImuConfig(noise=0.0, bias=0.0, drift=0.0, delay=(0.0, 0.0), rate=10000.0)
TURNED = Rotation.from_rotvec([0.4, -1.1, 0.7])


def quat(rotation):
    return jnp.asarray(np.roll(rotation.as_quat(), 1), jnp.float32)


def rotation(quat):
    return Rotation.from_quat(np.roll(np.asarray(quat, np.float64), -1))


def params(bias=(0.0, 0.0, 0.0), drift=0.0):
    return ImuParams(bias=jnp.asarray(bias), drift=jnp.asarray(drift), delay=jnp.zeros(()), phase=jnp.zeros(()))


@pytest.mark.parametrize(("bias", "ticks", "rate"), [((0.2, 0.0, 0.0), 1.0, 10000.0), ((0.0, -0.15, 0.1), 0.0, 10.0)])
def test_the_error_is_fixed_to_the_palm(bias, ticks, rate):
    """A mount that is turned shows every orientation turned by the same rotation of the palm's axes, also in the first
    reading of a sensor that is slower than the control."""
    config, true, up = dataclasses.replace(CONFIG, rate=rate), quat(TURNED), jnp.array([-1.0, 0.0, 0.0])
    measure = jax.jit(
        lambda imu: measure_orientation(jax.random.key(0), config, imu, jnp.float32(ticks), true, true, true, up, 0.03)
    )
    for phase in (0.0, 0.3, 0.9):
        read = measure(dataclasses.replace(params(bias), phase=jnp.float32(phase)))
        np.testing.assert_allclose((rotation(read) * TURNED.inv()).as_rotvec(), bias, atol=1e-5)


def test_the_heading_drifts_from_the_start_of_the_episode(hand):
    """Also where the clock of the time limit began at random: two ticks after a start it has drifted for two ticks."""
    config = RotateConfig(sensing=Sensing(orientation=CONFIG))
    sensors, true = SensorSuite(config, hand, Rotate(config, hand)), quat(TURNED)
    now = SimpleNamespace(object_quat=true)
    last = SimpleNamespace(length=jnp.int32(1), tick=jnp.int32(500), readings=SimpleNamespace(object_quat=true))
    read = sensors._read_orientation(jax.random.key(0), now, now, SimpleNamespace(imu=params(drift=0.1)), last)
    turn = (rotation(read) * TURNED.inv()).as_rotvec()
    gravity = np.asarray(Rotate(config, hand).gravity)
    np.testing.assert_allclose(turn, -gravity / np.linalg.norm(gravity) * 0.1 * 2 * sensors.period, atol=1e-5)


def test_an_episodes_imu_is_as_wide_as_the_ranges_and_the_curriculum_together(hand):
    """All three errors are proportional to both."""

    def drawn(ranges, curriculum):
        config = RotateConfig(randomization=Randomization(scale=ranges))
        task, keys = Rotate(config, hand), jax.random.split(jax.random.key(1), 3)
        sensors = SensorSuite(config, hand, task)

        def draw(keys, scale):
            return sample_episode(sensors, keys, task.sample_object(keys[0], config), scale).imu

        return jax.jit(draw)(tuple(keys), jnp.float32(curriculum))

    full, part = drawn(1.0, 1.0), drawn(0.5, 0.3)
    for name in ("bias", "drift", "delay"):
        wide, narrow = (np.asarray(getattr(imu, name)) for imu in (full, part))
        assert np.all(wide != 0)
        np.testing.assert_allclose(narrow, 0.15 * wide, rtol=1e-5)
