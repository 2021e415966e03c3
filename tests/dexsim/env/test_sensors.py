"""From what sensors see to what the host reads: latency, biases, steps and filters in closed form, without physics."""

import dataclasses
import functools
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dexsim.env.config import Sensing
from dexsim.env.sensors import SensorInput, SensorSuite
from dexsim.sensing.imu import ImuConfig, ImuParams
from dexsim.tasks.grasp.config import GraspConfig
from dexsim.tasks.grasp.task import Grasp

QUIET = Sensing(
    joint_noise=0.0,
    joint_resolution=0.0,
    torque_noise=0.0,
    object_noise=0.0,
    object_axes=(True, False, True),
    orientation=ImuConfig(noise=0.0),
)
LEVEL = jnp.array([1.0, 0.0, 0.0, 0.0])
GOAL = jnp.float32(0.25), jnp.array([0.6, 0.8, 0.0, 0.0])
AGE = 0.25  # of a tick


@pytest.fixture(scope="module")
def read(hand):
    """`read(sensing, now, last)` gives the readings of an episode whose hand has an error of every kind; `last` are
    the readings before, and what sensors saw then."""

    @functools.cache
    def suite_of(sensing):
        config = GraspConfig(sensing=sensing)
        return SensorSuite(config, hand, Grasp(config, hand))

    @functools.partial(jax.jit, static_argnums=0)
    def run(suite, now, last, key, age, bias):
        zero = jnp.zeros(())
        errors = SimpleNamespace(
            sensing_latency=age,
            actuator=SimpleNamespace(encoder_bias=jnp.linspace(-0.01, 0.01, 12)),
            torque_gain=jnp.full(12, 1.5),
            taxel_gain=jnp.ones(hand.taxel_area.shape),
            tilt=jnp.array([0.1, 0.0]),
        )
        imu = ImuParams(**{f.name: zero for f in dataclasses.fields(ImuParams)})
        imu = dataclasses.replace(imu, bias=bias, drift=jnp.float32(0.5))
        episode = SimpleNamespace(hand=errors, imu=imu, taxels=suite.taxels.sample(jax.random.key(0), 0.0))
        readings, then = last or (None, now)
        before = SimpleNamespace(readings=readings, length=jnp.int32(3), taxel_memory=suite.taxels.init())
        return suite.read(jax.random.key(key), episode, now, then, GOAL, jnp.full(12, 0.5), last and before)[0]

    def plain(sensing, now, last=None, key=0, age=AGE, bias=(0.0, 0.0, 0.0)):
        return run(suite_of(sensing), now, last, key, jnp.float32(age), jnp.asarray(bias))

    return plain


def seen(hand, joint, torque, place):
    return SensorInput(
        joint_position=jnp.full(12, joint),
        joint_torque=jnp.full(12, torque),
        taxel_force=jnp.zeros(hand.taxel_area.shape),
        object_position=jnp.asarray(place, jnp.float32),
        object_quat=LEVEL,
    )


def test_readings_are_a_quarter_tick_old_and_have_the_hands_own_errors(hand, read):
    then, now = seen(hand, 0.2, 0.1, (0.05, 0, 0.1)), seen(hand, 0.6, 0.3, (0.09, 0.01, 0.2))
    first = read(QUIET, then)
    np.testing.assert_allclose(first.joint_position, 0.2 + np.linspace(-0.01, 0.01, 12), rtol=1e-5)
    found = read(QUIET, now, (first, then))
    np.testing.assert_allclose(found.joint_position, 0.5 + np.linspace(-0.01, 0.01, 12), rtol=1e-5)
    np.testing.assert_allclose(found.joint_torque, 1.5 * 0.25, rtol=1e-5)
    assert float(found.command) == 0.25 and np.all(np.asarray(found.last_action) == 0.5)
    np.testing.assert_array_equal(found.goal_quat, GOAL[1])
    # The heading drifts about the vertical, which is -x for a palm that faces down; the fourth tick.
    turn = Rotation.from_quat(found.object_quat, scalar_first=True).as_rotvec()
    np.testing.assert_allclose(turn, [-0.5 * 4 * GraspConfig().physics.control_period, 0.0, 0.0], atol=1e-5)


def test_only_the_measured_coordinates_move_and_their_velocity_is_filtered(hand, read):
    """The others rest at the reference, as a camera that gives only the height leaves them."""
    period, reference = GraspConfig().physics.control_period, hand.grasp_centre
    heights, velocity = (0.05, 0.06, 0.09), 0.0
    last = None
    for k, height in enumerate(heights):
        now = seen(hand, 0.0, 0.0, (height, 0.5, 2 * height))
        found = read(QUIET, now, last, age=0.0)
        np.testing.assert_allclose(found.object_position, [height, reference[1], 2 * height], rtol=1e-5)
        if k:
            velocity += 0.5 * ((height - heights[k - 1]) / period - velocity)
        np.testing.assert_allclose(found.object_velocity, [velocity, 0.0, 2 * velocity], rtol=1e-4, atol=1e-6)
        last = found, now


def test_angles_come_in_steps_and_each_reading_has_its_own_noise(hand, read):
    now = seen(hand, 0.2, 0.1, (0.05, 0, 0.1))
    stepped = np.asarray(read(dataclasses.replace(QUIET, joint_resolution=0.004), now).joint_position)
    np.testing.assert_allclose(stepped / 0.004, np.round(stepped / 0.004), atol=1e-3)
    assert np.abs(stepped - (0.2 + np.linspace(-0.01, 0.01, 12))).max() <= 0.002 + 1e-6
    noisy = dataclasses.replace(QUIET, joint_noise=0.01, torque_noise=0.02, object_noise=0.03, object_axes=(True,) * 3)
    plain = read(QUIET, now)
    reads = [read(noisy, now, key=key) for key in range(40)]
    offs = []
    for name, size in (("joint_position", 0.01), ("joint_torque", 0.02)):
        off = np.array([getattr(r, name) - getattr(plain, name) for r in reads])
        offs.append(off[:, 0])
        assert off.std() == pytest.approx(size, rel=0.15) and abs(np.corrcoef(off[:, 0], off[:, 1])[0, 1]) < 0.5
    assert abs(np.corrcoef(offs)[0, 1]) < 0.5, "the torque's noise is not the angle's"
    place = np.array([r.object_position for r in reads]) - np.array([0.05, 0, 0.1])
    assert place.std() == pytest.approx(0.03, rel=0.25)


def test_gravity_in_the_palm_frame_has_the_mounts_lean_and_the_alignments_error(hand, read):
    """The grasp's palm faces down (gravity +x); a pitch of 0.1 rad is about y. A wrong alignment turns it too."""
    now = seen(hand, 0.2, 0.1, (0.05, 0, 0.1))
    level = np.array([np.cos(0.1), 0.0, np.sin(0.1)])
    np.testing.assert_allclose(read(QUIET, now).palm_gravity, level, atol=1e-6)
    bias = np.array([0.02, -0.03, 0.01])
    expected = Rotation.from_rotvec(bias).apply(level)
    np.testing.assert_allclose(read(QUIET, now, bias=bias).palm_gravity, expected, atol=1e-6)
