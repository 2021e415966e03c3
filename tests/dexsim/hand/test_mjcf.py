"""The hand in the scene: at the palm, however its file places that; names that the scene adds or needs."""

import shutil

import mujoco
import numpy as np
import pytest

from dexsim.hand.kinematics import forward_kinematics
from dexsim.hand.load import find_hand, load_hand
from dexsim.objects.config import ObjectConfig
from dexsim.physics import contact
from dexsim.physics.config import PhysicsConfig
from dexsim.physics.model import build_scene
from dexsim_real.twin.plant.hand_model import PREFIX, own_model

PALM, END = '<body name="right_hand_link">', "  </worldbody>"
SKEW = 'pos="0.1 0.2 0.3" euler="0.3 1.5 -0.4"'


def rewrite(folder, *changes):
    """The shipped hand with its MJCF changed."""
    path = find_hand(None)
    for file in path.parent.iterdir():
        if file.is_file():
            shutil.copy(file, folder)
    mjcf = folder / "xhand_right.xml"
    text = mjcf.read_text()
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    mjcf.write_text(text)
    return folder / path.name


def scene(hand):
    return build_scene(hand, ("box",), ObjectConfig().largest[:1], PhysicsConfig(), (0.0, 0.0, -9.81), "c").model


@pytest.mark.parametrize(
    "changes",
    [
        [],
        [(PALM, f'<body name="right_hand_link" {SKEW}>')],
        [
            (PALM, f'<frame {SKEW}><body name="arm" xyaxes="0 1 0 0 0 1">{PALM[:-1]} {SKEW}>'),
            (END, "</body></frame></worldbody>"),
        ],
    ],
    ids=["as it is", "euler", "on an arm in a frame"],
)
def test_links_are_in_the_palm_frame_however_the_file_places_the_palm(tmp_path, changes):
    hand = load_hand(rewrite(tmp_path, *changes))
    model = scene(hand)
    data = mujoco.MjData(model)
    angle = np.random.default_rng(0).uniform(hand.joint_lower, hand.joint_upper).astype(np.float32)
    data.qpos[[model.joint(name).qposadr[0] for name in hand.joint_names]] = angle
    mujoco.mj_kinematics(model, data)
    bodies, found = [model.body(name).id for name in hand.body_names], forward_kinematics(hand, angle)
    np.testing.assert_allclose(found.body_position, data.xpos[bodies], atol=1e-6)
    np.testing.assert_allclose(found.body_rotation, data.xmat[bodies].reshape(-1, 3, 3), atol=1e-5)
    # The emulated hand, which shares no code with this one.
    other = own_model(hand).spec.compile()
    data = mujoco.MjData(other)
    mujoco.mj_kinematics(other, data)
    palm = data.body(PREFIX + hand.palm)
    np.testing.assert_allclose(np.append(palm.xpos, palm.xmat), [0, 0, 0, *np.eye(3).flat], atol=1e-9)


@pytest.mark.filterwarnings("ignore:compiler attribute")
@pytest.mark.parametrize("setting", ["", 'inertiafromgeom="true"', 'settotalmass="1"'])
def test_neither_rubber_nor_object_change_the_links_masses(tmp_path, monkeypatch, setting):
    """A fingertip is as heavy as the file has it, though its geoms grow and masses come from them or from a total."""
    monkeypatch.chdir(tmp_path)  # MuJoCo logs its warnings in the working directory
    hand = load_hand(rewrite(tmp_path, ('autolimits="true"', f'autolimits="true" {setting}')))
    alone, placed = mujoco.MjModel.from_xml_path(str(hand.model_path)), scene(hand)
    for name in hand.body_names:
        for field in ("mass", "inertia", "ipos", "iquat"):
            wanted, found = (getattr(model.body(name), field) for model in (alone, placed))
            np.testing.assert_allclose(found, wanted, rtol=1e-9, atol=1e-15, err_msg=f"{name} {field}")


def test_defaults_of_the_file_are_not_for_the_objects_contacts(tmp_path):
    """A margin would have them begin in the air, on a spring made for a depth."""
    defaults = '<default><pair margin="0.01" gap="0.002" solreffriction="0.01 1"/><geom density="2" quat="1 1 0 0"/>'
    model = scene(load_hand(rewrite(tmp_path, ("<default>", defaults))))
    of_object = contact.pairs_with(model, np.array([model.geom("object_0").id]))
    assert len(of_object) > 20 and model.npair > len(of_object)
    assert not model.pair_margin[of_object].any() and not model.pair_gap[of_object].any()
    assert not model.pair_solreffriction[of_object].any()
    assert model.geom("object_0").quat.tolist() == [1, 0, 0, 0]
    assert np.delete(model.pair_margin, of_object).tolist() == [0.01] * (model.npair - len(of_object))
