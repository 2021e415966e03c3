"""Coupled joints: one motor, two joints; against C MuJoCo, and what is refused."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from paths import DATA
from two_fingers import write

from dexsim.errors import AssetError
from dexsim.hand.kinematics import flexion_joints, forward_kinematics, hinge_angles
from dexsim.hand.load import load_hand
from dexsim.objects.config import ObjectConfig
from dexsim.objects.params import sample_object
from dexsim.physics.config import PhysicsConfig
from dexsim.physics.interface import PhysicsState
from dexsim.physics.physics import Physics

MJCF = (DATA / "coupled.xml").read_text()


@pytest.fixture(scope="module")
def coupled(tmp_path_factory):
    return load_hand(write(tmp_path_factory.mktemp("coupled"), MJCF))


def satisfied(model, data, angles):
    """Motors at `angles` by name, and followers where MuJoCo's own residual of the equalities is 0."""
    for name, angle in angles.items():
        data.qpos[model.joint(name).qposadr[0]] = angle
    for name in angles:
        follower = model.joint(f"{name}_next").qposadr[0]
        for _ in range(2):  # linear, so that one step would do
            mujoco.mj_forward(model, data)
            row = list(data.efc_id[: data.ne]).index(model.equality(f"couple_{name}").id)
            data.qpos[follower] -= data.efc_pos[row]
    mujoco.mj_forward(model, data)
    assert np.abs(data.efc_pos[: data.ne]).max() < 1e-12


def test_links_and_tips_are_where_mujoco_satisfies_the_equalities(coupled):
    model = mujoco.MjModel.from_xml_path(str(coupled.model_path))
    data, random = mujoco.MjData(model), np.random.default_rng(0)
    assert (coupled.num_joints, coupled.num_hinges) == (2, 4) and coupled.joint_names == ("a", "b")
    assert flexion_joints(coupled, range(2)).tolist() == [0, 1]
    bodies = [model.body(name).id for name in coupled.body_names]
    kinematics = jax.jit(lambda joints: forward_kinematics(coupled, joints))
    for _ in range(20):
        joints = random.uniform(coupled.joint_lower, coupled.joint_upper).astype(np.float32)
        satisfied(model, data, dict(zip(coupled.joint_names, joints, strict=True)))
        ours = kinematics(joints)
        np.testing.assert_allclose(ours.body_position, data.xpos[bodies], atol=1e-6)
        np.testing.assert_allclose(
            ours.tip_position, data.site_xpos[[model.site("a_tip").id, model.site("b_tip").id]], atol=1e-6
        )
        np.testing.assert_allclose(hinge_angles(coupled, joints), data.qpos, atol=1e-6)


def test_driven_hinges_keep_their_ratio(coupled):
    """Half a second of C MuJoCo under a spring at each motor."""
    size, still = np.full((1, 3), 0.02), (0.0, 0.0, 0.0)
    physics = Physics(coupled, ("box",), size, PhysicsConfig(), gravity=still, backend="c")
    box = jax.jit(lambda key: sample_object(key, ObjectConfig(shapes=("box",))))(jax.random.key(0))
    goal = jnp.array([1.0, 0.8])
    qpos = jnp.concatenate([hinge_angles(coupled, jnp.zeros(2)), jnp.array([0.5, 0, 0, 1, 0, 0, 0.0])])
    state = PhysicsState(qpos, jnp.zeros(10), jnp.zeros(10))

    def law(index, position, velocity):
        return 1.0 * (goal - position) - 0.05 * velocity

    tick = jax.jit(lambda state: physics.advance(law, physics.fields(box), state, jnp.zeros(3)).state)
    for _ in range(17):
        state = tick(state)
        followers = hinge_angles(coupled, state.qpos[physics.joint_qpos])
        np.testing.assert_allclose(state.qpos[:4], followers, atol=0.02)
    np.testing.assert_allclose(state.qpos[:4], hinge_angles(coupled, goal), atol=0.01)


COUPLE_A = '<joint name="couple_a" joint1="a_next" joint2="a" polycoef="0.05 1.3 0 0 0"/>'
REFUSED = {
    "not linear": (COUPLE_A, COUPLE_A.replace("1.3 0 ", "1.3 0.2 "), "'a_next' follows 'a' by the polycoef"),
    "chain": (COUPLE_A, COUPLE_A.replace('joint2="a"', 'joint2="b_next"'), "follows 'b_next'.*no motor"),
    "beyond its range": ('range="-2 2"', 'range="-2 0.5"', "'b_next' has the range -2 to 0.5 rad.*to 0.81"),
    "none": (COUPLE_A, "", "lists 2 of the 3 joints"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_refused_in_one_line(tmp_path, monkeypatch, case):
    monkeypatch.chdir(tmp_path)  # MuJoCo logs its warnings in the working directory
    old, new, words = REFUSED[case]
    assert MJCF.count(old) == 1
    with pytest.raises(AssetError, match=words) as error:
        load_hand(write(tmp_path, MJCF.replace(old, new)))
    assert "\n" not in str(error.value)
