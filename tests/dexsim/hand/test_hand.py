"""The shipped hands: published kinematics and taxels; C MuJoCo; broken files."""

import shutil

import jax
import mujoco
import numpy as np
import pytest

from dexsim import check_hand
from dexsim.core.assets import asset_path
from dexsim.core.errors import AssetError
from dexsim.hand.kinematics import fingertip_strength, forward_kinematics
from dexsim.hand.load import load_hand

# --- the shipped hand against published figures ------------------------------------------------

# Tip positions (m) in the palm frame, computed from the published joint table.
TIPS_AT_HALF = {  # all joints 0.5 rad, but index_bend 0.1
    "thumb": (0.08472, 0.09962, 0.09515),
    "index": (0.0688, 0.03544, 0.17905),
    "middle": (0.0688, 0.004, 0.18),
    "ring": (0.0688, -0.016, 0.177),
    "pinky": (0.0688, -0.036, 0.174),
}
# name: lower, upper (rad), stall torque (Nm), no-load speed (rad/s)
STRONG, WEAK = (1.1, 8.63), (0.4, 14.38)
JOINTS = {
    "thumb_bend": (0, 1.832, *STRONG),
    "thumb_rota1": (-0.698, 1.57, *STRONG),
    "thumb_rota2": (0, 1.57, *WEAK),
    "index_bend": (-0.174, 0.174, *WEAK),
}
for finger in ("index", "mid", "ring", "pinky"):
    JOINTS |= {f"{finger}_joint1": (0, 1.919, *STRONG), f"{finger}_joint2": (0, 1.919, *WEAK)}
# (column, row) counted from 1 as published: position in mm, tip link frame.
FINGER_TAXELS = {(1, 1): (0.40, -8.32, 18.09), (4, 10): (5.29, -4.03, 39.58), (8, 4): (8.34, 6.69, 25.77)}
THUMB_TAXELS = {(1, 12): (-12.45, 41.64, -2.91), (3, 6): (-10.32, 34.98, 6.37), (9, 9): (12.51, 39.76, 0.39)}


def test_tips_are_where_the_joint_table_puts_them(hand):
    joints = np.full(12, 0.5, np.float32)
    joints[3] = 0.1
    ours = jax.jit(forward_kinematics, static_argnums=0)(hand, joints).tip_position
    np.testing.assert_allclose(ours, [TIPS_AT_HALF[name] for name in hand.finger_names], atol=1e-5)


def test_finger_and_joint_tables(hand):
    assert hand.finger_names == ("thumb", "index", "middle", "ring", "pinky")
    assert hand.joint_names == tuple(JOINTS)
    ours = np.stack([hand.joint_lower, hand.joint_upper, hand.torque_limit, hand.speed_limit], 1)
    np.testing.assert_allclose(ours, list(JOINTS.values()), rtol=1e-6)
    roots = ["thumb_rota1", "index_joint1", "mid_joint1", "ring_joint1", "pinky_joint1"]
    assert [hand.joint_names[j] for j in hand.root_joint] == roots
    assert (hand.num_joints, hand.num_fingers, hand.num_taxels) == (12, 5, 120)


def test_a_fingertips_strength_takes_one_joint_to_its_stall_torque(hand):
    """In C MuJoCo, which turns a force at the pad into joint torques."""
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


@pytest.mark.parametrize(("finger", "table"), [(0, THUMB_TAXELS), (4, FINGER_TAXELS)])
def test_taxels_are_the_published_lattice(hand, finger, table):
    assert hand.taxel_grid == (10, 12) and hand.taxel_position.shape == (5, 120, 3)
    for (column, row), millimetres in table.items():
        np.testing.assert_allclose(
            hand.taxel_position[finger, (column - 1) * 12 + row - 1] * 1e3, millimetres, atol=1e-3
        )


# --- the example hands ---------------------------------------------------------------------------

# Tips (m, palm frame) by finger with all motors at 0 and at 0.4 rad, multiplied out from the published chains: LEAP
# Hand of MuJoCo Menagerie (right_hand.xml; ends of its fingertip meshes), Inspire RH56 of dexsuite/dex-urdf.
TIPS = {
    "leap_like": {
        "thumb": [(0.0215, 0.1387, -0.0823), (0.0897, 0.0975, -0.0246)],
        "index": [(0.0195, 0.0080, 0.1322), (0.1100, -0.0243, 0.0786)],
        "middle": [(0.0195, -0.0374, 0.1321), (0.1100, -0.0697, 0.0785)],
        "ring": [(0.0195, -0.0828, 0.1321), (0.1100, -0.1151, 0.0786)],
    },
    "inspire_like": {
        "thumb": [(0.0438, 0.1127, 0.1186), (0.0402, 0.0490, 0.1551)],
        "index": [(0.0011, 0.0290, 0.2137), (0.0468, 0.0284, 0.1966)],
        "middle": [(0.0010, 0.0069, 0.2171), (0.0489, 0.0069, 0.1991)],
        "ring": [(0.0009, -0.0163, 0.2135), (0.0466, -0.0154, 0.1965)],
        "pinky": [(0.0013, -0.0387, 0.2037), (0.0410, -0.0371, 0.1891)],
    },
}


@pytest.mark.parametrize("name", TIPS)
def test_tips_are_where_the_published_chains_put_them(name):
    hand = load_hand(name)
    kinematics = jax.jit(lambda joints: forward_kinematics(hand, joints).tip_position)
    for row, angle in enumerate((0.0, 0.4)):
        tips = kinematics(np.full(hand.num_joints, angle, np.float32))
        wanted = [TIPS[name][finger][row] for finger in hand.finger_names]
        np.testing.assert_allclose(tips, wanted, atol=6e-4)  # places are rounded to 0.1 mm


@pytest.mark.slow
@pytest.mark.parametrize("name", TIPS)
def test_passes_the_checks(name, capsys):
    assert check_hand.main([name]) == 0
    out = capsys.readouterr().out
    assert out.count("ok  ") == 9 and "pairs" in out
    assert ("index_intermediate (x 1.064)" in out) == (name == "inspire_like")


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # MuJoCo logs its warnings in the working directory
    for name in ("xhand_right.xml", "xhand_right.toml", "taxels.csv", "leap_like/leap_like.toml"):
        shutil.copy(asset_path(f"hand/{name}"), tmp_path)
    shutil.copy(asset_path("hand/leap_like/leap_like.xml"), tmp_path)
    return tmp_path


def test_taxels_may_come_in_any_order_and_from_a_spreadsheet(hand, folder):
    """With its byte order mark and Windows' line ends."""
    path = folder / "taxels.csv"
    head, *rows = path.read_text().splitlines()
    path.write_bytes("\r\n".join(["\ufeff" + head, *rows[::-1]]).encode())
    again = load_hand(folder / "xhand_right.toml")
    for name in ("taxel_position", "taxel_normal", "taxel_area"):
        np.testing.assert_array_equal(getattr(again, name), getattr(hand, name))


BEND = 'class="distal" axis="-1 0 0" range="-0.174 0.174"'
# What is replaced in the MJCF, the TOML or the taxels' CSV, and a word that must appear beside the file's name.
BROKEN = {
    "slide joint": ("xml", BEND, f'type="slide" {BEND}', "hinge"),
    "no range": ("xml", BEND, 'axis="-1 0 0" range="0 0" limited="false" actuatorfrcrange="-1 1"', "index_bend"),
    "no torque limit": ("xml", BEND, 'axis="-1 0 0" range="-0.174 0.174"', "actuatorfrcrange"),
    "no inertia": ("xml", '<inertial mass="0.0158240"', '<inertial mass="0"', "mass"),
    "unknown joint": ("toml", '"index_bend",', '"index_bent",', "Invalid name 'index_bent'"),
    "root joint of another finger": ("toml", 'root_joint = "mid_joint1"', 'root_joint = "ring_joint1"', "not move"),
    "misspelt entry": ("toml", "palm = ", "taxel_pich = 1\npalm = ", "'taxel_pich'"),
    "posture in degrees": ("toml", "posture = [1.45", "posture = [83", "83 rad of 'thumb_bend'"),
    "not a number": ("csv", "thumb,0,1,-0.01500", "thumb,0,1,nan", "'thumb' has 119"),
    "no such pad": ("leap", 'pad = "index_pad"', 'pad = "palm"', "finger 'index': pad = 'palm'"),
    "normal of length zero": ("csv", "-0.97944,-0.04477,0.19669", "0,0,0", ":2: the normal"),
}


@pytest.mark.parametrize("case", BROKEN)
def test_a_broken_file_is_an_error_that_names_it(folder, case):
    kind, old, new, word = BROKEN[case]
    path = folder / {"csv": "taxels.csv", "leap": "leap_like.toml"}.get(kind, f"xhand_right.{kind}")
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))
    with pytest.raises(AssetError) as caught:
        load_hand(folder / ("leap_like.toml" if kind == "leap" else "xhand_right.toml"))
    message = str(caught.value)
    assert "\n" not in message and str(folder) in message and word in message, message
