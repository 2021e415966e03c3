"""Coupled joints: one motor, two joints; against C MuJoCo, and what is refused."""

import dataclasses

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from dexsim.core.errors import AssetError
from dexsim.hand.kinematics import flexion_joints, forward_kinematics, hinge_angles
from dexsim.hand.load import load_hand
from dexsim.physics.config import PhysicsConfig
from dexsim.physics.interface import ContactParams, PhysicsState
from dexsim.physics.law import implicit
from dexsim.physics.model import build_scene

# References, an anchor beside the body's origin, and a ratio and an offset of their own.
MJCF = """
<mujoco>
  <compiler angle="radian"/>
  <default><joint type="hinge" damping="0.01" armature="0.0005" actuatorfrcrange="-.5 .5"/></default>
  <worldbody>
    <body name="base"><geom name="base" type="box" size=".02 .04 .05" mass=".2"/>
      <body name="a1" pos=".03 .02 .05">
        <joint name="a" axis="0 1 0" range="-0.5 1.2"/>
        <geom name="a1" type="capsule" fromto="0 0 0 0 0 .04" size=".006" mass=".02"/>
        <body name="a2" pos="0 0 .04">
          <joint name="a_next" axis="0 1 .2" pos="0 .001 .002" range="-1 3" ref="0.2"/>
          <geom name="a2" type="capsule" fromto="0 0 .005 0 0 .03" size=".006" mass=".02"/>
          <site name="a_tip" pos="0 0 .04"/>
        </body>
      </body>
      <body name="b1" pos=".03 -.02 .05">
        <joint name="b" axis="0 1 0" range="-0.5 1.2" ref="-0.1"/>
        <geom name="b1" type="capsule" fromto="0 0 0 0 0 .04" size=".006" mass=".02"/>
        <body name="b2" pos="0 0 .04">
          <joint name="b_next" axis="0 1 0" range="-2 2"/>
          <geom name="b2" type="capsule" fromto="0 0 .005 0 0 .03" size=".006" mass=".02"/>
          <site name="b_tip" pos="0 0 .04"/>
        </body>
      </body>
    </body>
  </worldbody>
  <equality>
    <joint name="couple_a" joint1="a_next" joint2="a" polycoef="0.05 1.3 0 0 0"/>
    <joint name="couple_b" joint1="b_next" joint2="b" polycoef="-0.1 0.7 0 0 0"/>
  </equality>
</mujoco>
"""
TOML = """
model = "two.xml"
taxels = "two.csv"
taxel_grid = [1, 1]
palm = "base"
joints = ["b", "a"]
speed_limits = [8, 8]
[[fingers]]
name = "b"
tip = "b_tip"
root_joint = "b"
[[fingers]]
name = "a"
tip = "a_tip"
root_joint = "a"
"""
CSV = "finger,column,row,x,y,z,nx,ny,nz,area\na,0,0,0.006,0,0.02,1,0,0,1e-5\nb,0,0,0.006,0,0.02,1,0,0,1e-5\n"


def write(folder, mjcf=MJCF):
    for name, text in (("two.xml", mjcf), ("two.csv", CSV), ("two.toml", TOML)):
        (folder / name).write_text(text)
    return folder / "two.toml"


@pytest.fixture(scope="module")
def coupled(tmp_path_factory):
    return load_hand(write(tmp_path_factory.mktemp("coupled")))


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
    assert (coupled.num_joints, coupled.num_hinges) == (2, 4)
    bodies = [model.body(name).id for name in coupled.body_names]
    kinematics = jax.jit(lambda joints: forward_kinematics(coupled, joints))
    for _ in range(20):
        joints = random.uniform(coupled.joint_lower, coupled.joint_upper).astype(np.float32)
        satisfied(model, data, dict(zip(coupled.joint_names, joints, strict=True)))
        ours = kinematics(joints)
        np.testing.assert_allclose(ours.body_position, data.xpos[bodies], atol=1e-6)
        np.testing.assert_allclose(
            ours.tip_position, data.site_xpos[[model.site("b_tip").id, model.site("a_tip").id]], atol=1e-6
        )
        np.testing.assert_allclose(hinge_angles(coupled, joints), data.qpos, atol=1e-6)


def test_followers_are_no_joints(coupled):
    assert coupled.joint_names == ("b", "a")
    assert flexion_joints(coupled, range(2)).tolist() == [0, 1]


def test_shipped_hand_has_none(hand):
    assert hand.num_hinges == hand.num_joints
    joints = np.linspace(0.1, 1, 12, dtype=np.float32)
    np.testing.assert_array_equal(hinge_angles(hand, joints), joints)


def scene_of(hand, backend):
    return build_scene(hand, ("box",), np.full((1, 3), 0.02), PhysicsConfig(), (0.0, 0.0, 0.0), backend)


def driven(hand, backend):
    """Angles [4] of the hinges after 0.5 s under a spring at each motor, and the largest error of a ratio."""
    from dexsim.physics.physics import BACKENDS

    scene = scene_of(hand, backend)
    engine, goal = BACKENDS[backend](scene), jnp.array([0.8, 1.0])
    model, pairs = scene.model, scene.object_pairs
    contacts = ContactParams(
        jnp.asarray(model.pair_friction[pairs, 0]),
        jnp.asarray(model.pair_solref[pairs]),
        jnp.asarray(model.pair_solimp[pairs]),
        jnp.zeros(()),
    )
    from dexsim.objects import params
    from dexsim.objects.config import ObjectConfig

    object = params.sample_object(jax.random.key(0), ObjectConfig(shapes=("box",)), jnp.int32(1))
    object = dataclasses.replace(object, size=object.size[:1], position=object.position[:1], active=object.active[:1])
    start = hinge_angles(hand, jnp.zeros(2))
    qpos = jnp.concatenate([start, jnp.array([0.5, 0, 0, 1, 0, 0, 0.0])])
    state = PhysicsState(qpos, jnp.zeros(10), jnp.zeros(10))

    def law(index, position, velocity):
        return 1.0 * (goal - position) - 0.05 * velocity

    @jax.jit
    def tick(state):
        return engine.advance(object, contacts, state, implicit(law, PhysicsConfig().timestep), jnp.zeros(3)).state

    worst = 0.0
    for _ in range(17):
        state = tick(state)
        follower = hinge_angles(hand, state.qpos[scene.joint_qpos])
        worst = max(worst, float(jnp.abs(state.qpos[:4] - follower).max()))
    return np.asarray(state.qpos[:4]), worst


def test_driven_hinges_keep_their_ratio(coupled):
    angles, worst = driven(coupled, "c")
    assert worst < 0.02
    np.testing.assert_allclose(angles, hinge_angles(coupled, np.array([0.8, 1.0], np.float32)), atol=0.01)


COUPLE_A = '<joint name="couple_a" joint1="a_next" joint2="a" polycoef="0.05 1.3 0 0 0"/>'
COUPLE_B = '<joint name="couple_b" joint1="b_next" joint2="b" polycoef="-0.1 0.7 0 0 0"/>'
REFUSED = {
    "not linear": (COUPLE_A, COUPLE_A.replace("1.3 0 ", "1.3 0.2 "), "couple_a.*polycoef"),
    "no ratio": (COUPLE_A, COUPLE_A.replace("1.3", "0"), "couple_a.*polycoef"),
    "one joint": (COUPLE_A, COUPLE_A.replace('joint2="a" ', ""), "couple_a.*two joints"),
    "switched off": (COUPLE_A, COUPLE_A.replace("/>", ' active="false"/>'), "couple_a.*active"),
    "another kind": (COUPLE_A, '<weld name="glue" body1="a2" body2="b2"/>', "glue.*two joints"),
    "chain": (COUPLE_A, COUPLE_A.replace('joint2="a"', 'joint2="b_next"'), "follows 'b_next'.*no motor"),
    "motor follows": (COUPLE_A, COUPLE_A.replace('joint1="a_next"', 'joint1="b"'), "joint 'b' has a motor"),
    "follows twice": (COUPLE_B, COUPLE_B.replace('joint1="b_next"', 'joint1="a_next"'), "'a_next' .*follows another"),
    "beyond its range": ('range="-2 2"', 'range="-2 0.5"', "'b_next' has the range -2 to 0.5 rad.*to 0.81"),
    "none": (COUPLE_A, "", "lists 2 of the 3 joints"),
    "tendon": (
        "<equality>",
        '<tendon><fixed name="string"><joint joint="a" coef="1"/></fixed></tendon><equality>',
        "tendon 'string'",
    ),
}


@pytest.mark.parametrize("case", REFUSED)
def test_refused_in_one_line(tmp_path, monkeypatch, case):
    monkeypatch.chdir(tmp_path)  # MuJoCo logs its warnings in the working directory
    old, new, words = REFUSED[case]
    assert MJCF.count(old) == 1
    with pytest.raises(AssetError, match=words) as error:
        load_hand(write(tmp_path, MJCF.replace(old, new)))
    assert "\n" not in str(error.value)
