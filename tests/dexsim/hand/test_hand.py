"""The hand: published kinematics, masses and taxels; C MuJoCo; a second, different hand; broken files."""

import dataclasses
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from dexsim.core.errors import AssetError
from dexsim.hand.kinematics import flexion_joints, forward_kinematics, taxel_normals, taxel_positions
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


def test_flexion_joints_run_from_root_to_tip(hand):
    assert flexion_joints(hand, range(1, 1)).dtype == int  # of a hand of one finger: none, to index with
    assert flexion_joints(hand, range(1, 5)).tolist() == [4, 5, 6, 7, 8, 9, 10, 11]
    assert flexion_joints(hand, range(0, 1)).tolist() == [1, 2]


def test_masses(hand):
    model = mujoco.MjModel.from_xml_path(str(hand.model_path))
    assert np.sum(model.body_mass) == pytest.approx(1.101, abs=1e-3)
    mass = {name: model.body(name).mass[0] for name in hand.body_names}
    assert mass["right_hand_link"] == pytest.approx(0.538515)
    assert mass["right_hand_thumb_rota_link1"] == pytest.approx(0.132285)
    assert mass["right_hand_index_bend_link"] == pytest.approx(0.068721)
    assert mass["right_hand_ring_link2"] == pytest.approx(0.0158240)
    # A real body's principal inertias obey the triangle inequality.
    inertia = np.sort(model.body_inertia[1:], axis=1)
    assert np.all(inertia > 0) and np.all(inertia[:, 2] <= inertia[:, 0] + inertia[:, 1])


def relative_to_palm(model, data, palm, position, matrix):
    """World poses [n, 3], [n, 9] from C MuJoCo, in the palm's frame."""
    body = model.body(palm).id
    turn = data.xmat[body].reshape(3, 3)
    return (position - data.xpos[body]) @ turn, turn.T @ matrix.reshape(-1, 3, 3)


def check_against_mujoco(hand, kinematics, count=50):
    """Every body and tip site at random joint angles within the limits, to 1e-6."""
    model = mujoco.MjModel.from_xml_path(str(hand.model_path))
    data = mujoco.MjData(model)
    bodies = [model.body(name).id for name in hand.body_names]
    rng = np.random.default_rng(1)
    for _ in range(count):
        joints = rng.uniform(hand.joint_lower, hand.joint_upper).astype(np.float32)
        for name, angle in zip(hand.joint_names, joints, strict=True):
            data.qpos[model.joint(name).qposadr[0]] = angle
        mujoco.mj_forward(model, data)
        ours = kinematics(joints)
        position, matrix = relative_to_palm(model, data, hand.palm, data.xpos[bodies], data.xmat[bodies])
        np.testing.assert_allclose(ours.body_position, position, atol=1e-6)
        np.testing.assert_allclose(ours.body_rotation, matrix, atol=2e-6)
        tips = [model.site(name).id for name in TIP_SITES[hand.name]]
        position, _ = relative_to_palm(model, data, hand.palm, data.site_xpos[tips], data.site_xmat[tips])
        np.testing.assert_allclose(ours.tip_position, position, atol=1e-6)
        owners = matrix[[bodies.index(int(model.site_bodyid[tip])) for tip in tips]]
        np.testing.assert_allclose(ours.tip_rotation, owners, atol=2e-6)


TIP_SITES = {
    "xhand_right": ("thumb_tip", "index_tip", "mid_tip", "ring_tip", "pinky_tip"),
    "pinch": ("left_tip", "right_tip"),
}


def test_kinematics_equal_mujoco(hand, kinematics):
    check_against_mujoco(hand, kinematics)


def test_kinematics_are_differentiable(hand, kinematics):
    """The Jacobian of the index tip against central differences."""
    joints = jnp.asarray((hand.joint_lower + hand.joint_upper) / 2)
    exact = np.asarray(jax.jacfwd(lambda q: kinematics(q).tip_position[1])(joints))
    step = 1e-2
    numeric = np.stack(
        [
            (
                np.asarray(kinematics(joints.at[j].add(step)).tip_position[1])
                - np.asarray(kinematics(joints.at[j].add(-step)).tip_position[1])
            )
            / (2 * step)
            for j in range(12)
        ],
        1,
    )
    np.testing.assert_allclose(exact, numeric, atol=2e-5)
    assert np.all(exact[:, [0, 1, 2, 6, 7, 8, 9, 10, 11]] == 0)  # other fingers' joints
    assert np.all(np.linalg.norm(exact[:, 3:6], axis=0) > 0.01)


# --- taxels ------------------------------------------------------------------------------------


@pytest.mark.parametrize("finger", range(5))
def test_taxels_are_the_published_lattice(hand, finger):
    table = THUMB_TAXELS if finger == 0 else FINGER_TAXELS
    assert hand.taxel_grid == (10, 12) and hand.taxel_position.shape == (5, 120, 3)
    for (column, row), millimetres in table.items():
        np.testing.assert_allclose(
            hand.taxel_position[finger, (column - 1) * 12 + row - 1] * 1e3, millimetres, atol=1e-3
        )


@pytest.mark.parametrize("finger", range(5))
def test_taxels_mirror(hand, finger):
    """Columns 6-10 mirror 5-1: the thumb's in x, the fingers' in y. Normals and areas too."""
    flip = np.array([-1, 1, 1]) if finger == 0 else np.array([1, -1, 1])
    for values, tolerance in ((hand.taxel_position, 1e-7), (hand.taxel_normal, 2e-5)):
        grid = values[finger].reshape(10, 12, 3)
        np.testing.assert_allclose(grid[::-1] * flip, grid, atol=tolerance)
    area = hand.taxel_area[finger].reshape(10, 12)
    np.testing.assert_allclose(area[::-1], area, rtol=1e-4)


def test_normals_are_unit_and_point_out_of_the_finger(hand):
    np.testing.assert_allclose(np.linalg.norm(hand.taxel_normal, axis=-1), 1.0, atol=2e-5)
    for finger in range(5):
        # Away from a segment along the middle of the distal link, fitted by eye.
        start, end = (
            (np.array([0, 0.015, -0.004]), np.array([0, 0.038, -0.004]))
            if finger == 0
            else (np.array([0.002, 0, 0.010]), np.array([0.001, 0, 0.033]))
        )
        along = np.clip((hand.taxel_position[finger] - start) @ (end - start) / np.sum((end - start) ** 2), 0, 1)
        away = hand.taxel_position[finger] - (start + along[:, None] * (end - start))
        away /= np.linalg.norm(away, axis=-1, keepdims=True)
        # A fingertip is no capsule, so the two directions agree only roughly, at the rims least.
        agreement = np.sum(away * hand.taxel_normal[finger], -1)
        assert agreement.min() > 0.4 and np.median(agreement) > 0.9


def test_areas_add_up_to_the_lattice(hand):
    """719 mm^2 on a finger and 1244 on the thumb; here from two triangles a cell."""
    for finger, wanted in ((0, 1244e-6), (1, 719e-6), (2, 719e-6), (3, 719e-6), (4, 719e-6)):
        grid = hand.taxel_position[finger].reshape(10, 12, 3).astype(float)
        a, b, c, d = grid[:-1, :-1], grid[1:, :-1], grid[1:, 1:], grid[:-1, 1:]
        triangles = (
            np.linalg.norm(np.cross(b - a, c - a), axis=-1) + np.linalg.norm(np.cross(c - a, d - a), axis=-1)
        ) / 2
        assert triangles.sum() == pytest.approx(wanted, rel=0.005)
        assert hand.taxel_area[finger].sum() == pytest.approx(wanted, rel=0.005)
        assert np.all(hand.taxel_area[finger] > 0)


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


def test_taxels_move_with_their_link(hand, kinematics):
    joints = np.linspace(0.1, 0.6, 12).astype(np.float32) * np.where(np.arange(12) == 3, 0.2, 1)
    pose = kinematics(joints)
    where, out = taxel_positions(hand, pose), taxel_normals(hand, pose)
    for finger, taxel in ((0, 0), (1, 37), (4, 119)):
        turn = np.asarray(pose.body_rotation[hand.tip_body[finger]], float)
        origin = np.asarray(pose.body_position[hand.tip_body[finger]], float)
        np.testing.assert_allclose(where[finger, taxel], origin + turn @ hand.taxel_position[finger, taxel], atol=1e-6)
        np.testing.assert_allclose(out[finger, taxel], turn @ hand.taxel_normal[finger, taxel], atol=1e-6)


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


def write_pinch(folder, mjcf=PINCH_MJCF, layout=PINCH_CSV, table=PINCH_TOML):
    for name, text in (("pinch.xml", mjcf), ("pinch.csv", layout), ("pinch.toml", table)):
        if text is not None:
            (folder / name).write_bytes(text if isinstance(text, bytes) else text.encode())
    return folder / "pinch.toml"


def test_another_hand_loads(tmp_path):
    hand = load_hand(write_pinch(tmp_path))
    assert hand.name == "pinch" and hand.finger_names == ("left", "right")
    assert hand.joint_names == ("left_a", "right_a", "right_b", "left_b")
    np.testing.assert_allclose(hand.joint_upper, np.radians([60, 60, 80, 80]), rtol=1e-6)
    np.testing.assert_allclose(hand.torque_limit, [0.5, 0.5, 0.3, 0.3])
    np.testing.assert_allclose(hand.speed_limit, [1, 2, 3, 4])
    assert [hand.body_names[b] for b in hand.tip_body] == ["left2", "right_pad"]
    assert hand.root_joint.tolist() == [0, 2] and "stand" not in hand.body_names
    assert hand.taxel_position.shape == (2, 12, 3)  # written row by row and right first
    np.testing.assert_allclose(hand.taxel_position[1, 2 * 4 + 3], [0.002, 0.006, 0.01], rtol=1e-6)
    assert {(g.name, g.kind) for g in hand.geoms if g.touches} == {
        ("base", "box"),
        ("right_pad", "sphere"),
        ("left_pad", "sphere"),
    }


def test_another_hands_kinematics_equal_mujoco(tmp_path):
    hand = load_hand(write_pinch(tmp_path))
    check_against_mujoco(hand, jax.jit(lambda joints: forward_kinematics(hand, joints)))


def test_hand_is_frozen(hand):
    with pytest.raises(dataclasses.FrozenInstanceError):
        hand.name = "other"


# --- broken files ------------------------------------------------------------------------------

ROWS = PINCH_CSV.splitlines(keepends=True)
LEFT_B = '<joint name="left_b" axis="0 1 0" pos="0 0 .001" range="-10 80" actuatorfrcrange="-.3 .3"/>'


def bad(name, file, words, mjcf=PINCH_MJCF, layout=PINCH_CSV, table=PINCH_TOML):
    """A broken hand: which file the error must name, and what else it must say."""
    words = (words,) if isinstance(words, str) else words
    case = SimpleNamespace(file=file, words=words, mjcf=mjcf, layout=layout, table=table)
    return pytest.param(case, id=name)


def mjcf(old, new):
    assert old in PINCH_MJCF
    return PINCH_MJCF.replace(old, new, 1)


def table(old, new):
    assert old in PINCH_TOML
    return PINCH_TOML.replace(old, new, 1)


def layout(old, new):
    assert old in PINCH_CSV
    return PINCH_CSV.replace(old, new, 1)


BAD_MODELS = [
    bad("missing", "pinch.xml", "no such file", mjcf=None),
    bad("cut short", "pinch.xml", "XML", mjcf=PINCH_MJCF[:700]),
    bad("empty", "pinch.xml", "empty", mjcf=""),
    bad(
        "unknown element", "pinch.xml", "fingertip", mjcf=mjcf('<site name="left_tip" pos="0 0 .01"/>', "<fingertip/>")
    ),
    bad(
        "not a number in a position",
        "pinch.xml",
        "left2",
        mjcf=mjcf('name="left2" pos="0 0 .03"', 'name="left2" pos="nan 0 .03"'),
    ),
    bad(
        "not a number in an axis", "pinch.xml", "left_b", mjcf=mjcf('"left_b" axis="0 1 0"', '"left_b" axis="0 nan 0"')
    ),
    bad("not a number in a size", "pinch.xml", "nan size", mjcf=mjcf('size=".02 .02 .01"', 'size="nan .02 .01"')),
    bad("slide joint", "pinch.xml", "hinge", mjcf=mjcf('"left_b"', '"left_b" type="slide"')),
    bad("ball joint", "pinch.toml", "hinge", mjcf=mjcf(LEFT_B, '<joint name="left_b" type="ball" range="0 80"/>')),
    bad(
        "no range",
        "pinch.xml",
        ("left_b", "range"),
        mjcf=mjcf(LEFT_B, LEFT_B.replace('range="-10 80"', 'limited="false"')),
    ),
    bad(
        "no torque limit",
        "pinch.xml",
        ("left_b", "actuatorfrcrange"),
        mjcf=mjcf(LEFT_B, LEFT_B.replace("-.3 .3", "0 0")),
    ),
    bad(
        "torque limit of one direction",
        "pinch.xml",
        ("left_b", "-0.1 to 0.3"),
        mjcf=mjcf(LEFT_B, LEFT_B.replace("-.3 .3", "-.1 .3")),
    ),
    bad(
        "two joints in a body",
        "pinch.xml",
        "left_c",
        mjcf=mjcf(LEFT_B, LEFT_B + '<joint name="left_c" axis="1 0 0"/>'),
        table=PINCH_TOML.replace('"left_b"]', '"left_b", "left_c"]').replace("3, 4]\n[[", "3, 4, 5]\n[["),
    ),
    bad(
        "palm that moves",
        "pinch.xml",
        ("wrist", "base"),
        mjcf=mjcf('<geom name="base"', '<joint name="wrist" axis="1 0 0"/><geom name="base"'),
        table=PINCH_TOML.replace('"left_b"]', '"left_b", "wrist"]').replace("3, 4]\n[[", "3, 4, 5]\n[["),
    ),
    bad(
        "joint outside of the hand",
        "pinch.xml",
        "lever",
        mjcf=mjcf('<geom name="stand"', '<joint name="lever" axis="1 0 0"/><geom name="stand"'),
        table=PINCH_TOML.replace('"left_b"]', '"left_b", "lever"]').replace("3, 4]\n[[", "3, 4, 5]\n[["),
    ),
]
BAD_MODELS += [
    bad("no hand", "pinch.toml", "no joint 'left_a'", mjcf="<mujoco/>"),
    *(
        bad(f"{name} {value}", "pinch.xml", ("left_b", name, said), mjcf=mjcf('"left_b"', f'"left_b" {name}="{value}"'))
        for name in ("damping", "armature", "frictionloss")
        for value, said in (("nan", "not a finite number"), ("-1", "below 0"))
    ),
    bad("not a number in a reference", "pinch.xml", ("right_b", "ref"), mjcf=mjcf('ref="15"', 'ref="nan"')),
    bad("name of the object", "pinch.xml", "body 'object'", mjcf=mjcf('body name="stand"', 'body name="object"')),
    bad("name of its part", "pinch.xml", "geom 'object_1'", mjcf=mjcf('geom name="stand"', 'geom name="object_1"')),
    bad("name of its joint", "pinch.xml", "joint 'object'", mjcf=PINCH_MJCF.replace('"left_b"', '"object"'),
        table=PINCH_TOML.replace('"left_b"', '"object"')),
]  # fmt: skip
GRASP = "[grasp]\nposture = [0.1, 0.2, 0.3, 0.4]\ncentre = [0.1, 0, 0.1]\n"


def grasp(old, new):
    assert old in GRASP
    return table("[[fingers]]", GRASP.replace(old, new) + "[[fingers]]")


BAD_TABLES = [
    bad("missing", "pinch.toml", "no such file", table=None),
    bad("no TOML", "pinch.toml", "Invalid", table="name = 'x'\nmodel = ["),
    bad("no text", "pinch.toml", "", table=b"\xff\xfe\x00\x80"),
    bad("too long a key", "pinch.toml", "16 parts", table=PINCH_TOML + ".".join(["a"] * 10_000) + " = 1"),
    bad("nested too deep", "pinch.toml", "nested", table="a = " + "[" * 50_000),
    bad("too long a file", "pinch.toml", "128 KiB", table=PINCH_TOML + "#" * 200_000),
    bad("a number for a name", "pinch.toml", "string", table=table('name = "pinch"', "name = 7")),
    bad("a fast joint", "pinch.toml", "1000 rad/s", table=table("[1, 2, 3, 4]", "[1, 2, 3, 1e300]")),
    bad("a giant grid", "pinch.toml", "at most 1000", table=table("[3, 4]", "[100000, 100000]")),
    bad("empty", "pinch.toml", "model", table=""),
    bad("unknown joint", "pinch.toml", "left_x", table=table('"left_b"]', '"left_x"]')),
    bad("joint left out", "pinch.toml", "3 of the 4", table=table('"right_b", "left_b"', '"right_b"')),
    bad("joint twice", "pinch.toml", "once", table=table('"right_a", "right_b"', '"left_a", "right_b"')),
    bad("unknown site", "pinch.toml", "left_x", table=table('tip = "left_tip"', 'tip = "left_x"')),
    bad("site outside of the hand", "pinch.toml", ("foot", "base"), table=table('tip = "left_tip"', 'tip = "foot"')),
    bad(
        "two tips on a link",
        "pinch.toml",
        ("'left_end'", "'left2'", "another finger"),
        mjcf=mjcf('<site name="left_tip" pos="0 0 .01"/>', '<site name="left_tip"/><site name="left_end"/>'),
        table=table('tip = "right_tip"\nroot_joint = "right_b"', 'tip = "left_end"\nroot_joint = "left_a"'),
    ),
    bad("a file and a lattice of taxels", "pinch.toml", "give one", table="taxel_pitch = [1e-3, 1e-3]\n" + PINCH_TOML),
    bad("unknown root joint", "pinch.toml", "left_x", table=table('root_joint = "left_a"', 'root_joint = "left_x"')),
    bad("unknown palm", "pinch.toml", "paw", table=table('palm = "base"', 'palm = "paw"')),
    bad("finger without a tip", "pinch.toml", "tip", table=table('tip = "left_tip"\n', "")),
    bad("finger without a name", "pinch.toml", "name", table=table('name = "left"\n', "")),
    bad("finger without a root joint", "pinch.toml", "root_joint", table=table('root_joint = "left_a"\n', "")),
    *(
        bad(
            f"force per torque {value}",
            "pinch.toml",
            "force_per_torque",
            table=f"{PINCH_TOML}force_per_torque = {value}",
        )
        for value in ("-1.0", "nan", '"strong"', "1e9", "true")
    ),
    bad("too few speeds", "pinch.toml", "speed_limits", table=table("[1, 2, 3, 4]", "[1, 2, 3]")),
    bad("speed of zero", "pinch.toml", "speed_limits", table=table("[1, 2, 3, 4]", "[1, 0, 3, 4]")),
    bad("speed not a number", "pinch.toml", "speed_limits", table=table("[1, 2, 3, 4]", "[1, nan, 3, 4]")),
    bad("speed a word", "pinch.toml", "speed_limits", table=table("[1, 2, 3, 4]", '[1, "fast", 3, 4]')),
    bad("the speed that is wrong", "pinch.toml", "-4 in speed_limits", table=table("[1, 2, 3, 4]", "[1, 2, 3, -4]")),
    bad("misspelt entry", "pinch.toml", ("'taxel_pich'", "taxel_pitch"), table="taxel_pich = 1\n" + PINCH_TOML),
    bad(
        "misspelt entry of a finger",
        "pinch.toml",
        ("finger 2", "'force_per_torqe'"),
        table=f"{PINCH_TOML}force_per_torqe = 3",
    ),
    bad("misspelt table", "pinch.toml", "'grsp'", table=grasp("[grasp]", "[grsp]")),
    bad("misspelt entry of a table", "pinch.toml", ("[grasp]", "'center'"), table=grasp("centre", "center")),
    bad(
        "posture in degrees",
        "pinch.toml",
        ("grasp.posture", "17", "'right_b'", "-0.1745 to 1.396"),
        table=grasp("0.3", "17"),
    ),
    bad(
        "posture for ranges in degrees",
        "pinch.toml",
        "grasp.posture",
        mjcf=mjcf('"degree"', '"degree" autolimits="true"').replace('range="-60 60"', 'range="-.06 .06"'),
        table=grasp("0.3", "0.3"),
    ),
    bad("posture too large for a float", "pinch.toml", "grasp.posture", table=grasp("0.3", "9" * 400)),
    bad("grid of one", "pinch.toml", "taxel_grid", table=table("[3, 4]", "[12]")),
    bad("grid a word", "pinch.toml", "taxel_grid", table=table("[3, 4]", '"3x4"')),
    bad("grid negative", "pinch.toml", "taxel_grid", table=table("[3, 4]", "[-3, 4]")),
]
BAD_LAYOUTS = [
    bad("missing", "pinch.csv", "no such file", layout=None),
    bad("empty", "pinch.csv", "first line", layout=""),
    bad("no header", "pinch.csv", "first line", layout="".join(ROWS[1:])),
    bad("no text", "pinch.csv", "", layout=b"\xff\xfe\x00\x80"),
    bad("one too few", "pinch.csv", ("left", "11", "12"), layout="".join(ROWS[:-1])),
    bad("one too many", "pinch.csv", ("25", "24"), layout="".join([*ROWS, ROWS[-1]])),
    bad("one in place of another", "pinch.csv", ("left", "11"), layout="".join([*ROWS[:-1], ROWS[-2]])),
    bad("wrong grid", "pinch.csv", "2 x 4", table=table("taxel_grid = [3, 4]", "taxel_grid = [2, 4]")),
    bad("larger grid", "pinch.csv", ("12", "20"), table=table("taxel_grid = [3, 4]", "taxel_grid = [5, 4]")),
    bad("unknown finger", "pinch.csv:2", "tail", layout=layout("right,0,0", "tail,0,0")),
    bad("column outside", "pinch.csv:13", "column 3", layout=layout("right,2,3", "right,3,3")),
    bad("negative row", "pinch.csv:2", "row -1", layout=layout("right,0,0", "right,0,-1")),
    bad("not a number", "pinch.csv:3", "finite", layout=layout("right,1,0,0.001", "right,1,0,nan")),
    bad("infinite", "pinch.csv:3", "finite", layout=layout("right,1,0,0.001", "right,1,0,inf")),
    bad("a word", "pinch.csv:3", "numbers", layout=layout("right,1,0,0.001", "right,1,0,here")),
    bad("short line", "pinch.csv:25", "ten values", layout=PINCH_CSV[:-7]),
    bad("long line", "pinch.csv:25", "ten values", layout=PINCH_CSV[:-1] + ",7\n"),
    bad("normal of length zero", "pinch.csv:2", "normal", layout=layout("0,0,1,2e-06", "0,0,0,2e-06")),
    bad("area in square millimetres", "pinch.csv:2", ("area", "m^2"), layout=PINCH_CSV.replace("2e-06", "2")),
    bad("area of nothing", "pinch.csv:2", "area", layout=layout("0,0,1,2e-06", "0,0,1,2e-60")),
    bad("too large for a float", "pinch.csv:3", "finite", layout=layout("right,1,0,0.001", "right,1,0,1e39")),
    bad("blank lines before", "pinch.csv:5", "numbers", layout=layout("right,1,0,0.001", "\n\nright,1,0,here")),
    bad("open quote", "pinch.csv:25", "no finger 'right,0,0", layout=layout("right,0,0", '"right,0,0')),
    bad("only a first line", "pinch.csv", "0 taxels", layout=ROWS[0]),
    bad("no path", "", "null byte", table=table("pinch.csv", "\\u0000")),
    bad("negative area", "pinch.csv:2", "area", layout=layout("0,0,1,2e-06", "0,0,1,-2e-06")),
]


def test_of_a_giant_layout_no_more_is_read_than_the_grid_asks_for(tmp_path):
    with pytest.raises(AssetError, match="25 taxels or more, expected 24"):
        load_hand(write_pinch(tmp_path, layout=PINCH_CSV + ROWS[1] * 300_000))


def test_a_layout_from_a_spreadsheet_loads(tmp_path):
    """With a byte order mark and Windows' line ends."""
    hand = load_hand(write_pinch(tmp_path, layout="\ufeff" + PINCH_CSV.replace("\n", "\r\n")))
    assert hand.taxel_position.shape == (2, 12, 3)


def check_refused(folder, monkeypatch, case):
    monkeypatch.chdir(folder)  # MuJoCo logs its warnings in the working directory
    path = write_pinch(folder, case.mjcf, case.layout, case.table)
    with pytest.raises(AssetError) as caught:
        load_hand(path)
    message = str(caught.value)
    assert "\n" not in message and message.startswith(str(folder / case.file)), message
    for word in case.words:
        assert word in message, message


@pytest.mark.parametrize("case", BAD_MODELS)
def test_a_bad_model_is_refused(tmp_path, monkeypatch, case):
    check_refused(tmp_path, monkeypatch, case)


@pytest.mark.parametrize("case", BAD_TABLES)
def test_a_bad_description_is_refused(tmp_path, monkeypatch, case):
    check_refused(tmp_path, monkeypatch, case)


@pytest.mark.parametrize("case", BAD_LAYOUTS)
def test_a_bad_taxel_layout_is_refused(tmp_path, monkeypatch, case):
    check_refused(tmp_path, monkeypatch, case)


def test_a_folder_is_no_hand(tmp_path):
    with pytest.raises(AssetError, match=str(tmp_path)):
        load_hand(tmp_path)
