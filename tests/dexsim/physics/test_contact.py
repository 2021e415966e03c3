"""Contact parameters against what C MuJoCo makes of them: weight at rest, bounce, rubber."""

import c_scene
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from episodes import ground_truth

from dexsim.objects.config import SHAPES
from dexsim.objects.params import damping_ratio
from dexsim.physics import contact
from dexsim.physics.interface import PhysicsState, configured
from dexsim.touch.skin import Skin

BALL = """
<mujoco>
  <option timestep="{step}" iterations="50" cone="elliptic" impratio="20"/>
  <worldbody>
    <geom name="floor" type="plane" size="1 1 1" contype="0" conaffinity="0"/>
    <body name="ball" pos="0 0 {height}">
      <freejoint/>
      <inertial pos="0 0 0" mass="{mass}" diaginertia="5e-5 5e-5 5e-5"/>
      <geom name="ball" size="0.03" contype="0" conaffinity="0"/>
    </body>
  </worldbody>
  <contact><pair geom1="floor" geom2="ball" condim="3" friction="{mu} {mu} .005 .0001 .0001"/></contact>
</mujoco>
"""


def ball(*, stiffness=2000.0, ratio=1.0, mu=0.9, mass=0.1, step=0.002, height=0.03):
    """A ball of 30 mm over a floor; its mass, as in the hand's scene, is not what the contact was set up for."""
    model = mujoco.MjModel.from_xml_string(BALL.format(step=step, height=height, mass=mass, mu=mu))
    model.body_invweight0[1] = 10.0, 2e4
    pairs = contact.pairs_with(model, np.array([model.geom("ball").id]))
    compliance, *_ = contact.pair_constants(model, pairs, np.array([0]))
    np.testing.assert_array_equal(compliance, [10.0])
    model.pair_solref[:], model.pair_solimp[:] = contact.spring(compliance, np.array([stiffness]), ratio)
    return model, mujoco.MjData(model)


@pytest.mark.parametrize("mu, stiffness", [(0.3, 500.0), (0.6, 2000.0), (1.2, 2000.0), (0.9, 20000.0)])
def test_depth_at_rest_is_weight_over_stiffness(mu, stiffness):
    """Whatever the friction; MuJoCo's own parameters would give depths that differ by 7 and more."""
    model, data = ball(mu=mu, stiffness=stiffness, mass=0.5)
    mujoco.mj_step(model, data, 1500)
    assert np.abs(data.qvel).max() < 1e-6
    assert 0.03 - data.qpos[2] == pytest.approx(0.5 * 9.81 / stiffness, rel=1e-3)


@pytest.mark.parametrize(("restitution", "mass"), [(0.03, 0.05), (0.3, 0.2), (0.6, 0.05)])
def test_a_ball_bounces_as_configured(restitution, mass):
    """Within a tenth: the contact's own inertia, 2 to 3 kg, stands for the ball's."""
    model, data = ball(ratio=float(damping_ratio(restitution)), mass=mass, step=5e-4, height=0.0301)
    model.opt.gravity[:] = 0
    data.qvel[2] = -0.5
    while data.qvel[2] <= 0 or data.ncon and data.contact[0].dist < 0:
        mujoco.mj_step(model, data)
    assert data.qvel[2] / 0.5 == pytest.approx(restitution, rel=0.1)


def test_springs_follow_the_skin(hand, grasp_env):
    """In squeezed hands every pair gets the spring that the second scene works out from C MuJoCo's own contacts."""
    law, rng = c_scene.skin_law(hand, Skin()), np.random.default_rng(4)
    physics, pool = grasp_env.physics, grasp_env.pool

    @jax.jit
    def configure(target, qpos):
        state = PhysicsState(qpos, jnp.zeros(18), jnp.zeros(18))
        stiffness = ground_truth(grasp_env, target, state, jnp.zeros((5, 3))).tip_stiffness
        model = configured(physics.scene, physics.fields(target, stiffness))
        return model["pair_solref"], model["pair_solimp"]

    first, second = (
        [physics.mj_model.geom(g).name for g in side[physics.scene.object_pairs]]
        for side in (physics.mj_model.pair_geom1, physics.mj_model.pair_geom2)
    )
    changed = dict.fromkeys(SHAPES, 0)
    for index in np.concatenate([c_scene.rows_of(pool, shape)[:3] for shape in SHAPES]):
        start = c_scene.row(pool, index)
        model, qpos, qvel, *_ = c_scene.squeeze(hand, start, rng)
        nominal = model.pair_solref.copy()
        felt = law(qpos[None], jax.tree.map(lambda leaf: leaf[None], start.object))
        c_scene.follow_skin(model, c_scene.start(model, qpos, qvel), hand, start.object, np.asarray(felt)[0])
        changed[SHAPES[start.object.shape_index]] += np.sum(model.pair_solref[:, 0] != nominal[:, 0])
        solref, solimp = configure(start.object, jnp.asarray(qpos))
        there = {
            (model.geom(a).name, model.geom(b).name): pair
            for pair, (a, b) in enumerate(zip(model.pair_geom1, model.pair_geom2, strict=True))
        }
        for pair, link, other in zip(physics.scene.object_pairs, first, second, strict=True):
            slot = int(other.removeprefix("object_"))
            if start.object.active[slot]:
                at = there[link, c_scene.KINDS[slot]]
                np.testing.assert_allclose(solref[pair], model.pair_solref[at], rtol=2e-3)
                np.testing.assert_allclose(solimp[pair], model.pair_solimp[at], rtol=2e-3)
    assert min(changed.values()) >= 10, changed
