"""The hand: published kinematics, masses and taxels; C MuJoCo; a second, different hand; broken files."""

import jax
import mujoco
import numpy as np
import pytest

from dexsim.check_hand import check_kinematics
from dexsim.core.errors import AssetError
from dexsim.hand.kinematics import fingertip_strength, forward_kinematics
from dexsim.hand.load import load_hand

# --- the shipped hand against published figures ------------------------------------------------

# Tip positions (m) in the palm frame, computed from the published joint table.
TIPS_AT_ZERO = {
    "thumb": (0.02211, 0.15684, 0.02872),
    "index": (0.0065, 0.0265, 0.20575),
    "middle": (0.0065, 0.004, 0.20625),
    "ring": (0.0065, -0.016, 0.20325),
    "pinky": (0.0065, -0.036, 0.20025),
}
TIPS_AT_HALF = {  # all joints 0.5 rad, but index_bend 0.1
    "thumb": (0.08472, 0.09962, 0.09515),
    "index": (0.0688, 0.03544, 0.17905),
    "middle": (0.0688, 0.004, 0.18),
    "ring": (0.0688, -0.016, 0.177),
    "pinky": (0.0688, -0.036, 0.174),
}
# id: name, lower, upper (rad), stall torque (Nm), no-load speed (rad/s)
JOINTS = (
    ("thumb_bend", 0, 1.832, 1.1, 8.63),
    ("thumb_rota1", -0.698, 1.57, 1.1, 8.63),
    ("thumb_rota2", 0, 1.57, 0.4, 14.38),
    ("index_bend", -0.174, 0.174, 0.4, 14.38),
    ("index_joint1", 0, 1.919, 1.1, 8.63),
    ("index_joint2", 0, 1.919, 0.4, 14.38),
    ("mid_joint1", 0, 1.919, 1.1, 8.63),
    ("mid_joint2", 0, 1.919, 0.4, 14.38),
    ("ring_joint1", 0, 1.919, 1.1, 8.63),
    ("ring_joint2", 0, 1.919, 0.4, 14.38),
    ("pinky_joint1", 0, 1.919, 1.1, 8.63),
    ("pinky_joint2", 0, 1.919, 0.4, 14.38),
)
# (column, row) counted from 1 as published: position in mm, tip link frame.
FINGER_TAXELS = {
    (1, 1): (0.40, -8.32, 18.09),
    (1, 12): (-1.20, -5.66, 40.11),
    (2, 7): (2.79, -7.90, 31.49),
    (3, 4): (8.34, -6.69, 25.77),
    (4, 10): (5.29, -4.03, 39.58),
    (5, 1): (10.94, -1.30, 18.94),
    (5, 12): (1.35, -0.89, 42.08),
    (6, 12): (1.35, 0.89, 42.08),
    (8, 4): (8.34, 6.69, 25.77),
    (10, 1): (0.40, 8.32, 18.09),
}
THUMB_TAXELS = {
    (1, 1): (-14.88, 19.84, -1.34),
    (1, 12): (-12.45, 41.64, -2.91),
    (2, 9): (-12.51, 39.76, 0.39),
    (3, 6): (-10.32, 34.98, 6.37),
    (4, 11): (-3.95, 49.69, 0.01),
    (5, 12): (-0.86, 50.87, -2.71),
    (6, 12): (0.86, 50.87, -2.71),
    (9, 9): (12.51, 39.76, 0.39),
    (10, 1): (14.88, 19.84, -1.34),
}


@pytest.fixture(scope="module")
def kinematics(hand):
    return jax.jit(lambda joints: forward_kinematics(hand, joints))


@pytest.mark.parametrize(("angle", "bend", "tips"), [(0.0, 0.0, TIPS_AT_ZERO), (0.5, 0.1, TIPS_AT_HALF)])
def test_tips_are_where_the_joint_table_puts_them(hand, kinematics, angle, bend, tips):
    joints = np.full(12, angle, np.float32)
    joints[3] = bend
    ours = kinematics(joints).tip_position
    np.testing.assert_allclose(ours, [tips[name] for name in hand.finger_names], atol=1e-5)


def test_finger_and_joint_tables(hand):
    assert hand.finger_names == ("thumb", "index", "middle", "ring", "pinky")
    assert hand.joint_names == tuple(row[0] for row in JOINTS)
    table = np.array([row[1:] for row in JOINTS])
    ours = np.stack([hand.joint_lower, hand.joint_upper, hand.torque_limit, hand.speed_limit], 1)
    np.testing.assert_allclose(ours, table, rtol=1e-6)
    assert [hand.joint_names[j] for j in hand.root_joint] == [
        "thumb_rota1",
        "index_joint1",
        "mid_joint1",
        "ring_joint1",
        "pinky_joint1",
    ]
    assert (hand.num_joints, hand.num_fingers, hand.num_taxels) == (12, 5, 120)


@pytest.mark.parametrize("name", ["xhand_right", "leap_like"])
def test_a_fingertips_strength_takes_one_joint_to_its_stall_torque(name):
    """In C MuJoCo, which turns a force at the pad into joint torques."""
    hand = load_hand(name)
    model = mujoco.MjModel.from_xml_path(str(hand.model_path))
    data, joints = mujoco.MjData(model), [model.joint(joint) for joint in hand.joint_names]
    data.qpos[[joint.qposadr[0] for joint in joints]] = hand.grasp_posture
    mujoco.mj_fwdPosition(model, data)
    for finger, force in enumerate(fingertip_strength(hand, np.asarray(hand.grasp_posture, np.float32))):
        body = model.body(hand.body_names[hand.tip_body[finger]]).id
        frame = data.xmat[body].reshape(3, 3)
        normal = frame @ hand.taxel_normal[finger].mean(0)
        place = data.xpos[body] + frame @ hand.taxel_position[finger].mean(0)
        torque = np.zeros(model.nv)
        push = force * normal / np.linalg.norm(normal)
        mujoco.mj_applyFT(model, data, push, np.zeros(3), place, body, torque)
        share = np.abs(torque[[joint.dofadr[0] for joint in joints]]) / hand.torque_limit
        np.testing.assert_allclose(share.max(), 1.0, rtol=1e-4)


# --- taxels ------------------------------------------------------------------------------------


@pytest.mark.parametrize("finger", [0, 4])
def test_taxels_are_the_published_lattice(hand, finger):
    table = THUMB_TAXELS if finger == 0 else FINGER_TAXELS
    assert hand.taxel_grid == (10, 12) and hand.taxel_position.shape == (5, 120, 3)
    for (column, row), millimetres in table.items():
        np.testing.assert_allclose(
            hand.taxel_position[finger, (column - 1) * 12 + row - 1] * 1e3, millimetres, atol=1e-3
        )


def test_taxels_lie_on_the_collision_pads(hand):
    """Solver and taxels must feel one surface: 0.3 mm rms apart, and nowhere 1.2 mm."""
    for finger in range(5):
        gap = np.full(120, np.inf)
        for geom in hand.geoms:
            if geom.body == hand.tip_body[finger] and geom.touches:
                assert geom.kind == "capsule"
                local = (hand.taxel_position[finger] - geom.position) @ geom.rotation
                local[:, 2] -= np.clip(local[:, 2], -geom.size[1], geom.size[1])
                gap = np.minimum(gap, np.linalg.norm(local, axis=1) - geom.size[0])
        assert np.sqrt(np.mean(gap**2)) < 5e-4 and np.abs(gap).max() < 2e-3, hand.finger_names[finger]


# --- a second hand through the same door -------------------------------------------------------

# The palm stands askew in the world, joints turn about skew axes away from the body origins, one is
# drawn at an angle of 15 degrees, one fingertip hangs rigidly on its link, and a stand is no part of it.
PINCH_MJCF = """
<mujoco model="pinch">
  <compiler angle="degree" eulerseq="zyx"/>
  <default><joint range="-60 60" actuatorfrcrange="-.5 .5"/></default>
  <worldbody>
    <body name="base" pos=".1 -.2 .3" euler="20 30 -40">
      <geom name="base" type="box" size=".02 .02 .01" mass=".2"/>
      <body name="right1" pos=".01 -.02 .03" euler="0 10 5">
        <joint name="right_a" axis="1 1 0" pos=".002 -.003 .004"/>
        <geom type="capsule" size=".005 .01" mass=".02" contype="0" conaffinity="0"/>
        <body name="right2" pos="0 .001 .04">
          <joint name="right_b" axis="0 1 .2" pos="0 .002 -.001" range="-10 80" ref="15" actuatorfrcrange="-.3 .3"/>
          <geom type="capsule" size=".005 .01" mass=".02" contype="0" conaffinity="0"/>
          <body name="right_pad" pos=".003 0 .02" euler="0 90 0">
            <geom name="right_pad" type="sphere" size=".006" mass=".01"/>
            <site name="right_tip" pos="0 0 .01"/>
          </body>
        </body>
      </body>
      <body name="left1" pos=".01 .02 .03">
        <joint name="left_a" axis="0 0 1"/>
        <geom type="capsule" size=".005 .01" mass=".02" contype="0" conaffinity="0"/>
        <body name="left2" pos="0 0 .03">
          <joint name="left_b" axis="0 1 0" pos="0 0 .001" range="-10 80" actuatorfrcrange="-.3 .3"/>
          <geom name="left_pad" type="sphere" size=".006" mass=".02"/>
          <site name="left_tip" pos="0 0 .01"/>
        </body>
      </body>
    </body>
    <body name="stand" pos="1 0 0"><geom name="stand" type="sphere" size=".01"/><site name="foot"/></body>
  </worldbody>
</mujoco>
"""
PINCH_TOML = """
name = "pinch"
model = "pinch.xml"
taxels = "pinch.csv"
taxel_grid = [3, 4]
palm = "base"
joints = ["left_a", "right_a", "right_b", "left_b"]
speed_limits = [1, 2, 3, 4]
[[fingers]]
name = "left"
tip = "left_tip"
root_joint = "left_a"
[[fingers]]
name = "right"
tip = "right_tip"
root_joint = "right_b"
"""
PINCH_CSV = "finger,column,row,x,y,z,nx,ny,nz,area\n" + "".join(
    f"{finger},{column},{row},{0.001 * column},{0.002 * row},0.01,0,0,1,2e-06\n"
    for finger in ("right", "left")
    for row in range(4)
    for column in range(3)
)


def write_pinch(folder, layout=PINCH_CSV):
    for name, text in (("pinch.xml", PINCH_MJCF), ("pinch.csv", layout), ("pinch.toml", PINCH_TOML)):
        (folder / name).write_bytes(text.encode())
    return folder / "pinch.toml"


def test_another_hand_loads_and_its_kinematics_equal_mujoco(tmp_path):
    """Its layout is written row by row, right first, with a spreadsheet's byte order mark and Windows' line ends."""
    hand = load_hand(write_pinch(tmp_path, layout="\ufeff" + PINCH_CSV.replace("\n", "\r\n")))
    check_kinematics(hand)
    assert hand.joint_names == ("left_a", "right_a", "right_b", "left_b") and hand.root_joint.tolist() == [0, 2]
    np.testing.assert_allclose(hand.joint_upper, np.radians([60, 60, 80, 80]), rtol=1e-6)
    np.testing.assert_allclose(hand.torque_limit, [0.5, 0.5, 0.3, 0.3])
    np.testing.assert_allclose(hand.speed_limit, [1, 2, 3, 4])
    assert "stand" not in hand.body_names and hand.taxel_position.shape == (2, 12, 3)
    np.testing.assert_allclose(hand.taxel_position[1, 2 * 4 + 3], [0.002, 0.006, 0.01], rtol=1e-6)
    assert {g.name for g in hand.geoms if g.touches} == {"base", "right_pad", "left_pad"}


# --- broken files ------------------------------------------------------------------------------

LEFT_B = '<joint name="left_b" axis="0 1 0" pos="0 0 .001" range="-10 80" actuatorfrcrange="-.3 .3"/>'
GRASP = "[grasp]\nposture = [0.1, 0.2, {}, 0.4]\n[[fingers]]"
# What is replaced, in the MJCF, the TOML or the CSV, and a word that must appear beside the file's name.
BAD_MODELS = {
    "slide joint": ('"left_b"', '"left_b" type="slide"', "hinge"),
    "no range": ('range="-10 80" actuatorfrcrange="-.3 .3"/>\n          <geom name="left_pad"',
                 'limited="false"/>\n          <geom name="left_pad"', "left_b"),
    "no torque limit": (LEFT_B, LEFT_B.replace("-.3 .3", "0 0"), "actuatorfrcrange"),
}  # fmt: skip
BAD_TABLES = {
    "unknown joint": ('"left_b"]', '"left_x"]', "no joint 'left_x'"),
    "root joint of another finger": ('root_joint = "right_b"', 'root_joint = "left_a"', "does not move"),
    "misspelt entry": ("palm = ", "taxel_pich = 1\npalm = ", "'taxel_pich'"),
    "posture in degrees": ("[[fingers]]", GRASP.format(17), "17 rad of 'right_b'"),
}
BAD_LAYOUTS = {
    "column outside": ("right,2,3", "right,3,3", ":13: column 3"),
    "not a number": ("right,1,0,0.001", "right,1,0,nan", "'right' has 11"),
    "normal of length zero": ("0,0,1,2e-06", "0,0,0,2e-06", ":2: the normal"),
}  # fmt: skip
BROKEN = {"xml": BAD_MODELS, "toml": BAD_TABLES, "csv": BAD_LAYOUTS}


@pytest.mark.parametrize(
    ("name", "case"),
    [(name, case) for name in BROKEN for case in BROKEN[name]],
)
def test_a_broken_file_is_an_error_that_names_it(tmp_path, monkeypatch, name, case):
    monkeypatch.chdir(tmp_path)  # MuJoCo logs its warnings in the working directory
    old, new, word = BROKEN[name][case]
    path = write_pinch(tmp_path)
    file = path.with_suffix(f".{name}")
    assert old in file.read_text()
    file.write_text(file.read_text().replace(old, new, 1))
    with pytest.raises(AssetError) as caught:
        load_hand(path)
    message = str(caught.value)
    assert "\n" not in message and str(tmp_path / "pinch.") in message and word in message, message
