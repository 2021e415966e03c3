"""The frames of what reward and critic see of the object's motion, against C MuJoCo's own integration."""

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from episodes import by_field, ground_truth
from random_readings import random_readings
from scipy.spatial.transform import Rotation

from dexsim import observation
from dexsim.env.sensors import SensorSuite
from dexsim.physics.interface import PhysicsState, StepResult
from dexsim.physics.physics import revert_if_diverged

MOMENT = 1e-6  # s
FREE_BODY = """<mujoco><worldbody><body><freejoint/><geom size="0.02" density="100"/></body></worldbody></mujoco>"""


@pytest.fixture(scope="module")
def observer(grasp_env):
    """Grasp's, whose critic also sees the object's orientation and spin."""
    critic = (*observation.GRASP, "object_orientation", "object_spin")
    task = SimpleNamespace(fields={"actor": observation.GRASP, "critic": critic}, gravity=(9.81, 0.0, 0.0))
    return SensorSuite(grasp_env.config, grasp_env.hand, task)


@pytest.fixture(scope="module")
def seen(grasp_env, observer):
    """The object's velocity and spin as a task sees them, and the critic's observation, from a physics state."""
    object = jax.tree.map(lambda rows: jnp.asarray(rows)[0], grasp_env.pool.object)
    readings = random_readings(grasp_env.hand, 0)

    def look(physics):
        truth = ground_truth(grasp_env, object, physics, jnp.zeros((5, 3)))
        critic = observer.observe(readings, truth, (readings.command, readings.goal_quat))["critic"]
        return (truth.object_velocity, truth.object_spin), critic

    return jax.jit(look)


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_velocity_and_spin_are_the_objects_change_in_the_palm_frame(observer, seen, seed):
    """The engine has the spin in the object's own frame; reward and critic have both in the palm frame."""
    rng = np.random.default_rng(seed)
    quat = rng.normal(size=4)
    place = np.concatenate([rng.normal(0, 0.05, 3), quat / np.linalg.norm(quat)])
    motion = rng.normal(size=6)
    later = place.copy()
    mujoco.mj_integratePos(mujoco.MjModel.from_xml_string(FREE_BODY), later, motion, MOMENT)
    velocity = (later[:3] - place[:3]) / MOMENT
    begun, turned = (Rotation.from_quat(np.roll(pose[3:], -1)) for pose in (place, later))
    spin = (turned * begun.inv()).as_rotvec() / MOMENT
    assert np.linalg.norm(spin - motion[3:]) > 0.3, "the frames agree by chance: the test tests nothing"

    qpos = np.concatenate([np.full(12, 0.3), place])
    physics = PhysicsState(
        *(jnp.asarray(x, jnp.float32) for x in (qpos, np.append(np.zeros(12), motion), np.zeros(18)))
    )
    found, critic = seen(physics)
    critic = by_field(observer.layout["critic"], critic)
    np.testing.assert_allclose(found[0], velocity, atol=1e-5)
    np.testing.assert_allclose(found[1], spin, atol=1e-4)
    np.testing.assert_allclose(critic["object_velocity"], velocity, atol=1e-5)
    np.testing.assert_allclose(critic["object_spin"], spin, atol=1e-4)
    orientation = begun.as_matrix()[:, :2].T.ravel()
    np.testing.assert_allclose(critic["object_orientation"], orientation, atol=1e-5)


@pytest.mark.parametrize(
    ("speed", "sound"), [(999.0, True), (1001.0, False), (-999.0, True), (-1001.0, False), (np.nan, False)]
)
def test_a_world_too_fast_in_either_direction_stays_as_it_was(speed, sound):
    before, after = (PhysicsState(jnp.full(19, x), jnp.zeros(18), jnp.zeros(18)) for x in (1.0, 2.0))
    after = PhysicsState(after.qpos, after.qvel.at[7].set(speed), after.warmstart)
    valid = jnp.ones((), bool)
    (physics, force), finite = revert_if_diverged(StepResult(after, jnp.ones((5, 3))), before, valid)
    assert bool(finite) == sound
    np.testing.assert_array_equal(physics.qpos, 2.0 if sound else 1.0)
    np.testing.assert_array_equal(force, 1.0 if sound else 0.0)
