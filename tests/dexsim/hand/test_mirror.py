"""The mirror image of a hand: its files, its kinematics, and what a policy sees of it."""

import dataclasses
import shutil
from xml.etree import ElementTree

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from paths import DATA
from random_readings import random_readings

from dexsim import import_hand
from dexsim.core.assets import asset_path
from dexsim.errors import AssetError
from dexsim.geometry import rotations
from dexsim.hand import mirror
from dexsim.hand.description import Hand
from dexsim.hand.kinematics import forward_kinematics
from dexsim.hand.load import find_hand, load_hand
from dexsim.hand.mirror import AXIAL, MATRIX, POLAR, is_mirror_image, mirror_hand, mirror_mjcf, write_mirror
from dexsim.observation import GRASP, ROTATE_CRITIC, Motion, ObservationConfig, mirror_readings, observe

HANDS = ("xhand_right", "leap_like", "inspire_like")


def same(one: Hand, other: Hand, *apart: str) -> None:
    """Whether two hands agree in all that is a number."""
    for field in dataclasses.fields(Hand):
        a, b = getattr(one, field.name), getattr(other, field.name)
        if isinstance(a, np.ndarray) and field.name not in apart:
            np.testing.assert_array_equal(a, b, err_msg=field.name)
    for name in ("side", "grasp_centre", "rotate_reference"):
        assert getattr(one, name) == getattr(other, name)
    for a, b in zip(one.geoms, other.geoms, strict=True):
        for name in ("size", "position", "rotation"):
            np.testing.assert_allclose(getattr(a, name), getattr(b, name), atol=1e-7)


def test_the_shipped_left_hand_is_what_the_command_writes(tmp_path, capsys):
    """Its origins, axes and taxels were compared with the maker's description of the left hand (URDF 1.3)."""
    assert import_hand.main(["xhand_right", "--mirror", "--out", str(tmp_path)]) == 0
    assert capsys.readouterr().out.strip() == f"wrote {tmp_path / 'xhand_left.toml'}"
    shipped = asset_path("hand/xhand_left")
    assert sorted(path.name for path in shipped.iterdir()) == sorted(path.name for path in tmp_path.iterdir())
    for path in tmp_path.iterdir():
        assert path.read_bytes() == (shipped / path.name).read_bytes(), path.name


@pytest.mark.parametrize("name", HANDS)
def test_a_mirror_image_moves_in_the_mirror_and_mirrored_twice_is_the_hand(tmp_path, name):
    hand = load_hand(name)
    image = load_hand(write_mirror(find_hand(name), tmp_path))
    assert (image.side, image.name) == ("left", "xhand_left" if name == "xhand_right" else f"{name}_left")
    # Taxels of a symmetric lattice keep their order, in which those of `mirror_hand` are reversed.
    same(mirror_hand(hand), image, "taxel_position", "taxel_normal", "taxel_area")
    for finger in range(hand.num_fingers):
        mirrored = np.concatenate([hand.taxel_position[finger] * POLAR, hand.taxel_normal[finger] * POLAR], -1)
        there = np.concatenate([image.taxel_position[finger], image.taxel_normal[finger]], -1)
        assert np.abs(mirrored[:, None] - there).max(-1).min(1).max() < 1e-5
    posture = np.random.default_rng(0).uniform(hand.joint_lower, hand.joint_upper).astype(np.float32)
    pose, mirrored = (jax.jit(forward_kinematics, static_argnums=0)(one, posture) for one in (hand, image))
    np.testing.assert_allclose(mirrored.tip_position, np.asarray(pose.tip_position) * POLAR, atol=1e-6)
    np.testing.assert_allclose(mirrored.body_rotation, np.asarray(pose.body_rotation) * MATRIX, atol=1e-6)
    again = load_hand(write_mirror(tmp_path / f"{image.name}.toml", tmp_path / "again"))
    same(again, hand)
    same(mirror_hand(mirror_hand(hand)), hand)
    assert is_mirror_image(image, hand) and is_mirror_image(hand, image) and not is_mirror_image(hand, hand)


def test_every_way_to_write_an_mjcf_is_mirrored(tmp_path):
    """Orientations, frames, defaults and a mesh: masses, inertias and poses in C MuJoCo."""
    folder = tmp_path / "model"
    folder.mkdir()
    (tmp_path / "meshes").mkdir()
    shutil.copy(DATA / "right_parts.xml", folder / "right.xml")
    (tmp_path / "meshes/right_Wedge.obj").write_text(
        "v 0 0 0\nv .03 0 0\nv 0 .02 0\nv 0 .01 .04\nf 1 3 2\nf 1 2 4\nf 2 3 4\nf 3 1 4\n"
    )
    model = ElementTree.parse(folder / "right.xml").getroot()
    for name, source in dict(mirror._gather_files(model, folder)).items():
        shutil.copyfile(source, tmp_path / name)
    mirror_mjcf(model)
    (tmp_path / "left.xml").write_bytes(ElementTree.tostring(model))
    one, other = (mujoco.MjModel.from_xml_path(str(p)) for p in (folder / "right.xml", tmp_path / "left.xml"))
    np.testing.assert_allclose(other.body_mass, one.body_mass, rtol=1e-9)
    np.testing.assert_allclose(other.body_inertia, one.body_inertia, rtol=1e-6)
    here, there = mujoco.MjData(one), mujoco.MjData(other)
    here.qpos[:] = there.qpos[:] = 0.7, -0.4
    for data, model in ((here, one), (there, other)):
        mujoco.mj_forward(model, data)
    for name in ("xpos", "xipos", "geom_xpos", "site_xpos", "light_xpos", "light_xdir"):
        np.testing.assert_allclose(getattr(there, name), getattr(here, name) * POLAR, atol=1e-9, err_msg=name)
    np.testing.assert_allclose(there.xaxis, here.xaxis * AXIAL, atol=1e-9)
    np.testing.assert_allclose(there.xmat.reshape(-1, 3, 3), here.xmat.reshape(-1, 3, 3) * MATRIX, atol=1e-9)
    np.testing.assert_allclose(there.qfrc_bias, here.qfrc_bias, atol=1e-9)  # gravity has no y
    assert other.body("left_palm").id and other.body("Left_thumb").id and other.site("left_tip").id == 0


def test_an_existing_hand_is_not_overwritten(tmp_path):
    write_mirror(find_hand(None), tmp_path)
    for name in ("xhand_left.toml", "xhand_left.xml", "xhand_left_taxels.csv"):
        with pytest.raises(AssetError, match=f"{name}: exists; give another folder"):
            write_mirror(find_hand(None), tmp_path)
        (tmp_path / name).unlink()


def test_readings_are_mirrored_as_rotations_and_vectors_are(hand):
    readings = random_readings(hand, 0)
    image = mirror_readings(readings)
    for name in ("object_position", "object_velocity"):
        np.testing.assert_array_equal(getattr(image, name), getattr(readings, name) * POLAR)
    both = readings, image
    turned = [rotations.rotate(rotations.quat_to_matrix(jnp.asarray(r.object_quat)), r.palm_gravity) for r in both]
    np.testing.assert_allclose(turned[1], turned[0] * POLAR, atol=1e-6)
    relative = [rotations.quat_multiply(r.goal_quat, rotations.quat_conjugate(r.object_quat)) for r in both]
    np.testing.assert_allclose(relative[1], relative[0] * mirror.QUAT, atol=1e-6)


def test_a_policy_sees_the_right_hand(hand, left):
    """The left hand's own readings: taxels in its own order."""
    names = tuple(dict.fromkeys((*GRASP, *ROTATE_CRITIC, "palm_gravity", "past_actions", "finger_force")))
    readings = random_readings(hand, 1)
    motion = Motion(readings.joint_torque, readings.object_velocity)
    order = [
        np.abs(p[:, None] - q * POLAR).max(-1).argmin(0)
        for p, q in zip(hand.taxel_position, left.taxel_position, strict=True)
    ]
    its_own = mirror_readings(
        dataclasses.replace(
            readings, taxel_force=np.stack([f[o] for f, o in zip(readings.taxel_force, order, strict=True)])
        )
    )
    look, config = jax.jit(observe, static_argnums=(0, 2, 3)), ObservationConfig()
    seen = look(left, its_own, names, config, Motion(motion.joint_velocity, motion.object_spin * AXIAL))
    np.testing.assert_allclose(seen, look(hand, readings, names, config, motion), atol=2e-5)
