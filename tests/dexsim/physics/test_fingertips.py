"""Fingertips as thick as their episode has them, and fingers that do not pass through each other."""

import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from c_scene import GRAVITY, row, rows_of, squeeze

from dexsim.objects.config import SLOTS, ObjectConfig
from dexsim.physics.config import PhysicsConfig
from dexsim.physics.interface import PhysicsState
from dexsim.physics.model import build_scene
from dexsim.physics.physics import Physics

THICK, THIN = 0.003, 0.001


@pytest.fixture(scope="module")
def scenes(hand):
    """{thickness compiled in: scene} on C MuJoCo."""
    return {
        cover: Physics(
            hand, SLOTS, ObjectConfig().largest, PhysicsConfig(pad_thickness=cover), gravity=GRAVITY, backend="c"
        )
        for cover in (THICK, THIN, 0.0)
    }


@pytest.fixture(scope="module")
def grip(hand, grasp_env):
    """(object, state) of a squeezed box."""
    start = row(grasp_env.pool, rows_of(grasp_env.pool, "box")[0])
    _, qpos, qvel, warmstart, torque = squeeze(hand, start, np.random.default_rng(0))
    return start.object, PhysicsState(jnp.asarray(qpos), jnp.asarray(qvel), jnp.asarray(warmstart)), torque


@pytest.mark.parametrize(("change", "compiled"), [(THIN - THICK, THIN), (-THICK, 0.0), (-0.01, 0.0)])
def test_a_thickness_drawn_is_a_thickness_compiled(scenes, grip, change, compiled):
    """Less than no rubber is no rubber."""
    object, state, torque = grip
    motors = lambda *_: jnp.asarray(torque)  # noqa: E731
    drawn, force = scenes[THICK].advance(motors, object, state, jnp.zeros(3), pad_thickness_delta=change)
    expected, pressed = scenes[compiled].advance(motors, object, state, jnp.zeros(3))
    np.testing.assert_allclose(force, pressed, atol=2e-3)
    np.testing.assert_allclose(drawn.qpos, expected.qpos, atol=1e-5)
    plain = scenes[THICK].advance(motors, object, state, jnp.zeros(3))[1]
    assert np.abs(plain - force).max() > 0.5, "the rubber makes no difference: the test tests nothing"


def test_the_model_is_given_the_drawn_sizes(hand, scenes, grip):
    thick, thin = scenes[THICK].mj_model, scenes[THIN].mj_model
    names = [thick.geom(g).name for g in range(thick.ngeom)]
    tips = [g for g, name in enumerate(names) if "_pad" in name and name[-1].isdigit()]
    assert len(tips) == 6 * 3
    size = np.asarray(scenes[THICK].configure(grip[0], pad_thickness_delta=THIN - THICK)["geom_size"])
    np.testing.assert_allclose(size[tips], thin.geom_size[tips], atol=1e-8)
    links = [thick.geom(name).id for name in ("index_link1", "palm_face", "thumb_link1")]
    np.testing.assert_allclose(size[links], thick.geom_size[links], atol=1e-7)


def test_thick_rubber_is_not_beyond_the_broad_phase(scenes, grip):
    """C MuJoCo leaves out contacts of geoms whose bounding spheres are apart."""
    model, given = scenes[THIN].mj_model, scenes[THIN].configure(grip[0], pad_thickness_delta=THICK - THIN)
    size, around = np.asarray(given["geom_size"]), np.asarray(given["geom_rbound"])
    tips = [g for g in range(model.ngeom) if "_pad" in model.geom(g).name and model.geom(g).name[-1].isdigit()]
    assert len(tips) == 6 * 3 and np.all(size[tips, 0] > model.geom_size[tips, 0] + 1e-3)
    np.testing.assert_allclose(around[tips], size[tips, 0], atol=1e-8)


def test_index_and_middle_finger_stop_each_other(hand):
    """The index finger swings into the middle one at full torque, and then rests on it."""
    model = build_scene(hand, SLOTS, ObjectConfig().largest, PhysicsConfig(), (0.0, 0.0, 0.0), "c").model
    model.opt.timestep = 0.005  # s; the motors below are explicit
    data = mujoco.MjData(model)
    names = list(hand.joint_names)
    bend, angle = names.index("index_bend"), np.where(np.arange(12) < 3, 0.0, 0.3)
    angle[bend] = hand.joint_lower[bend]
    data.qpos[:12], data.qpos[12:15] = angle, (0.0, 0.0, 2.0)
    data.qpos[bend] = 0.0
    data.qpos[15] = 1.0
    depth = []
    for _ in range(300):
        torque = 3.0 * (angle - data.qpos[:12]) - 0.1 * data.qvel[:12]
        torque[bend] = -hand.torque_limit[bend]
        data.qfrc_applied[:12] = torque
        mujoco.mj_step(model, data)
        depth.append(
            min(
                mujoco.mj_geomDistance(model, data, model.geom(a).id, model.geom(b).id, 0.05, np.zeros(6))
                for a in ("index_link1", "index_core")
                for b in ("mid_link1", "mid_core")
            )
        )
    assert data.qpos[bend] > hand.joint_lower[bend] + 0.02, "it passes through"
    assert -2e-3 < min(depth) < 0.0
    assert min(depth[10:]) > -1e-3
