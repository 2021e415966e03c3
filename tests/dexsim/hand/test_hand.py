"""The shipped hands: published kinematics and taxels; C MuJoCo; broken files."""

import shutil
import tomllib

import jax
import mujoco
import numpy as np
import pytest
from paths import DATA

from dexsim import check_hand
from dexsim.calibration.press import fingertip_strength
from dexsim.core.assets import asset_path
from dexsim.errors import AssetError
from dexsim.hand.kinematics import forward_kinematics
from dexsim.hand.load import load_hand

PUBLISHED = tomllib.loads((DATA / "published_hands.toml").read_text())


@pytest.mark.parametrize("entry", PUBLISHED["tips"], ids=lambda entry: entry["hand"])
def test_tips_are_where_the_published_chains_put_them(entry):
    hand = load_hand(entry["hand"])
    joints = np.broadcast_to(np.float32(entry["joints"]), hand.num_joints)
    tips = jax.jit(forward_kinematics, static_argnums=0)(hand, joints).tip_position
    np.testing.assert_allclose(tips, [entry[name] for name in hand.finger_names], atol=entry["within"])


def test_finger_and_joint_tables(hand):
    assert hand.finger_names == ("thumb", "index", "middle", "ring", "pinky")
    assert hand.joint_names == tuple(PUBLISHED["joints"])
    ours = np.stack([hand.joint_lower, hand.joint_upper, hand.torque_limit, hand.speed_limit], 1)
    np.testing.assert_allclose(ours, list(PUBLISHED["joints"].values()), rtol=1e-6)
    roots = ["thumb_rota1", "index_joint1", "mid_joint1", "ring_joint1", "pinky_joint1"]
    assert [hand.joint_names[j] for j in hand.root_joint] == roots
    assert (hand.num_joints, hand.num_fingers, hand.num_taxels) == (12, 5, 120)


def test_a_fingertips_strength_takes_one_joint_to_its_stall_torque(hand):
    """In C MuJoCo, which turns a force at the pad into joint torques."""
    model = mujoco.MjModel.from_xml_path(str(hand.model_path))
    data, joints = mujoco.MjData(model), [model.joint(joint) for joint in hand.joint_names]
    data.qpos[[joint.qposadr[0] for joint in joints]] = hand.grasp_posture
    mujoco.mj_fwdPosition(model, data)
    for finger, force in enumerate(fingertip_strength(hand, np.asarray(hand.grasp_posture))):
        body = model.body(hand.body_names[hand.tip_body[finger]]).id
        frame = data.xmat[body].reshape(3, 3)
        normal = frame @ hand.taxel_normal[finger].mean(0)
        place = data.xpos[body] + frame @ hand.taxel_position[finger].mean(0)
        torque = np.zeros(model.nv)
        push = force * normal / np.linalg.norm(normal)
        mujoco.mj_applyFT(model, data, push, np.zeros(3), place, body, torque)
        share = np.abs(torque[[joint.dofadr[0] for joint in joints]]) / hand.torque_limit
        np.testing.assert_allclose(share.max(), 1.0, rtol=1e-4)


def test_taxels_are_the_published_lattice(hand):
    assert hand.taxel_grid == (10, 12) and hand.taxel_position.shape == (5, 120, 3)
    for name, taxels in PUBLISHED["taxels"].items():
        for column, row, *millimetres in taxels:
            place = hand.taxel_position[hand.finger_names.index(name), (column - 1) * 12 + row - 1]
            np.testing.assert_allclose(1e3 * place, millimetres, atol=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["leap_like", "inspire_like"])
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
