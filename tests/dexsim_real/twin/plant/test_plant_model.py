"""A plant model of a user's own: what fits is found, the rest is an error in one line; its body is the file's."""

import mujoco
import numpy as np
import pytest
from emulated_plant import IDEAL, QUIET, free, motors

from dexsim.core.assets import asset_path
from dexsim_real.core.errors import HandError
from dexsim_real.twin.plant.emulated_hand import EmulatedHand, Stage
from dexsim_real.twin.plant.hand_model import read_model
from dexsim_real.twin.plant.parameters import GRAVITY, sample_trial
from dexsim_real.twin.plant.scene import TipContact
from dexsim_real.twin.plant.taxel_array import EmulatedTaxels


@pytest.fixture(scope="module")
def text():
    return asset_path("plants/foreign_right.xml").read_text()


@pytest.fixture
def write(tmp_path):
    def write(content, name="hand.xml"):
        (tmp_path / name).write_text(content)
        return tmp_path / name

    return write


def plant(hand, path=None, task="rotate", shape=None, **overrides):
    path, values = path or asset_path("plants/foreign_right.xml"), QUIET | IDEAL | overrides
    values |= {"push_rate": 0.0, "sensing_latency": 0.0}
    return EmulatedHand(hand, task, 0, kind="nominal", overrides=values, shape_name=shape, plant_model=path)


def test_palm_fingertips_and_lattices_are_where_the_hand_has_them(hand):
    """Against C MuJoCo on the hand's own MJCF, at random postures; names, frames and mount differ."""
    ours, reference = plant(hand), mujoco.MjModel.from_xml_path(str(hand.model_path))
    rng, data = np.random.default_rng(0), mujoco.MjData(reference)
    for _ in range(5):
        posture = rng.uniform(hand.joint_lower, hand.joint_upper)
        for name, angle in zip(hand.joint_names, posture, strict=True):
            data.joint(name).qpos[0] = angle
        mujoco.mj_kinematics(reference, data)
        ours._data.qpos[ours._scene.drive_qpos] = posture
        ours._data.qpos[ours._scene.play_qpos] = 0.0
        mujoco.mj_kinematics(ours._scene.model, ours._data)
        for site, body in zip(ours._scene.tip_site, hand.tip_body, strict=True):
            expected = data.body(hand.body_names[body])
            assert ours._data.site_xpos[site] == pytest.approx(expected.xpos, abs=1e-4)
            assert ours._data.site_xmat[site] == pytest.approx(expected.xmat, abs=2e-3)


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ('<position class="weak" joint="little_curl"/>', "", "11 joints, the hand has 12"),
        ('name="ring_curl" class="weak" axis="0 1 0" range="0 109.95"', 'name="ring_curl" axis="0 1 0" range="0 90"',
         "joint ring_curl has a range of 0.000 to 1.571 rad, ring_joint2 of the hand 0.000 to 1.919"),
        ('<site name="middle_tip" pos="-0.0422483 0 0"/>', "", "0 fingertip sites of middle: put one site with 'tip'"),
        ('name="index_spread" class="weak" axis="-1', 'name="index_spread" class="weak" axis="1',
         "with index_spread at 0.17 rad the tip of index is 40 mm from where the hand has it"),
        ('pos="0.0095 0.0228 0.0305"', 'pos="0.0095 -0.0228 0.0305"', "with all joints at 0 the tip of thumb is 46 mm"),
        ('<geom type="cylinder"', '<joint axis="0 0 1"/><geom type="cylinder"', "(hand) moves: fix it to the world"),
        ("<mujoco model", "<mujoko model", "XML"),
        ('<body name="hand">', '<body name="hand"><site name="palm" pos="0 0 .1"/>', " is 100 mm from"),
        ("<option ", '<option><flag contact="disable"/></option><option ', "its <option> disables contact: remove the"),
    ],
)  # fmt: skip
def test_what_does_not_fit_is_an_error_in_one_line(hand, text, write, old, new, says):
    assert old in text
    path = write(text.replace(old, new))
    with pytest.raises(HandError) as error:
        read_model(path, hand)
    assert says in str(error.value) and str(path) in str(error.value) and "\n" not in str(error.value)


@pytest.mark.parametrize(("slope", "priority"), [(0.45, 0), (0.7, -1)])
def test_friction_is_that_of_the_file(hand, text, write, slope, priority):
    """A cube on the palm, 0.55 in the file: it sticks, or slides with g (sin - 0.55 cos)."""
    ours = plant(hand, write(text.replace('friction="0.55 ', f'priority="{priority}" solmix="0" friction="0.55 ')))
    model, data, at = ours._scene.model, ours._data, ours._scene.object_qpos
    angle = np.arctan(slope)
    model.opt.gravity[:] = GRAVITY * np.array([-np.cos(angle), 0.0, -np.sin(angle)])
    assert ours._palm_face == pytest.approx(0.0192, abs=1e-5)
    free(ours, (ours._palm_face + 0.0275, -0.002, 0.075))
    ours.drive(motors(np.zeros(12)))
    ours.advance(0.05)
    before = data.qvel[ours._scene.object_dof + 2]
    ours.advance(0.1)
    rate = (data.qvel[ours._scene.object_dof + 2] - before) / 0.1
    expected = -max(GRAVITY * (np.sin(angle) - 0.55 * np.cos(angle)), 0.0)
    assert rate == pytest.approx(expected, abs=0.1) and data.qpos[at] == pytest.approx(0.0467, abs=5e-4)


def test_a_scene_of_its_own_is_left_out_and_its_time_step_is_kept(hand, text, write):
    """Its object would be in the way of the trial's; a camera may look at it. Gravity is the trial's; a fingertip is
    found by its site's name."""
    scene = """<worldbody><body name="cube" pos="0 0 .46"><freejoint/><geom name="c" type="box" size="1 1 1"/></body>
        <camera mode="targetbody" target="cube" pos="0 0 1"/><light mode="targetbody" target="cube" pos="0 0 1"/>"""
    words = text.replace('timestep="0.001"', 'timestep="0.002"').replace("<worldbody>", scene)
    words = words.replace('<site name="middle_tip"', '<site name="screw"/><site name="middle_tip"')
    words = words.replace("<option ", '<option><flag gravity="disable" sleep="enable"/></option><option ')
    words = words.replace("<contact>", '<contact><pair geom1="c" geom2="floor"/><exclude body1="cube" body2="hand"/>')
    ours = plant(hand, write(words), "grasp")
    assert "plant/cube" not in [ours._scene.model.body(b).name for b in range(ours._scene.model.nbody)]
    free(ours, (0.5, 0.0, 0.0))
    ours.advance(0.2)
    fallen = ours._data.qpos[ours._scene.object_qpos] - 0.5
    assert ours.time == pytest.approx(0.2, abs=0.002) and fallen == pytest.approx(0.5 * GRAVITY * 0.04, rel=0.03)


def test_contacts_may_be_explicit_pairs(hand, text, write):
    """A cube rests on a palm that its file lets touch by a pair alone; what has no pair touches nothing."""
    spec = mujoco.MjSpec.from_string(text)
    for k, geom in enumerate(spec.geoms):
        geom.name, geom.contype, geom.conaffinity = f"g{k}", 0, 0
    with pytest.raises(HandError, match="no geom can touch anything"):
        plant(hand, write(spec.to_xml()))
    cube = spec.worldbody.add_body(name="cube", pos=[0, 0, 1])
    cube.add_freejoint()
    cube.add_geom(name="cube", size=[0.03, 0, 0], contype=0, conaffinity=0)
    palm = spec.body("hand").first_geom().name
    spec.add_pair(geomname1=palm, geomname2="cube")
    ours = plant(hand, write(spec.to_xml()))
    model, data, at = ours._scene.model, ours._data, ours._scene.object_qpos
    model.opt.gravity[:] = (-GRAVITY, 0.0, 0.0)
    free(ours, (ours._palm_face + 0.0275, -0.002, 0.075))
    ours.drive(motors(np.full(12, 0.8)))
    ours.advance(0.5)
    assert data.qpos[at] == pytest.approx(0.0467, abs=5e-4) and data.ncon > 0
    touching = {model.geom(int(geom)).name for geom in data.contact.geom.flat}
    assert touching == {f"plant/{palm}", "object_0"}


def test_a_contact_loads_the_nearest_taxels_with_all_of_its_force(hand):
    skin, rng = EmulatedTaxels(hand, by_point=True), np.random.default_rng(1)
    skin.configure(sample_trial("grasp", rng, "nominal", QUIET), rng)
    turn = np.linalg.qr(rng.standard_normal((3, 3)))[0]
    turn *= np.sign(np.linalg.det(turn))
    tips = rng.standard_normal((5, 3)), np.broadcast_to(turn, (5, 3, 3))
    finger, taxel = 2, 65
    point = tips[0][finger] + turn @ hand.taxel_position[finger, taxel]
    outward = turn @ hand.taxel_normal[finger, taxel]
    outward /= np.linalg.norm(outward)
    tangent = 0.5 * np.cross(outward, turn[:, 0])

    def load(height):
        contact = TipContact(finger, point + height * outward, -3.0 * outward, tangent)
        return skin.load(None, None, None, tips, [contact])

    force = load(0.0)
    assert force[..., 2].sum() == pytest.approx(3.0) and np.all(force[[0, 1, 3, 4]] == 0)
    assert force[finger, :, 2].argmax() == taxel
    centre = force[finger, :, 2] @ hand.taxel_position[finger] / 3.0
    assert np.linalg.norm(centre - hand.taxel_position[finger, taxel]) < 0.0015
    share = force[finger, taxel, 2] / 3.0
    assert np.linalg.norm(force[finger, taxel, :2]) == pytest.approx(np.linalg.norm(tangent) * share, rel=1e-3)
    assert load(0.009)[..., 2].sum() == pytest.approx(1.5, rel=0.02) and load(0.012).sum() == 0.0


def test_an_object_between_the_fingers_is_felt_by_the_fingers_that_hold_it(hand):
    ours = plant(hand, task="grasp", shape="box", reaction=0.3)
    posture = np.array(hand.grasp_posture)
    ours.drive(motors(posture))
    ours.advance(0.6)
    assert ours.stage is Stage.HOLD
    ours.drive(motors(posture + np.array([0, 0.35, 0.3, 0] + [0.25] * 8)))
    ours.advance(0.5)
    report, felt = ours.results()[0], ours.measure().taxel_force[..., 2].sum(-1)
    assert report["plant"] == "foreign_right.xml" and "friction" not in report["parameters"]
    with pytest.raises(HandError, match="friction is not a parameter of a plant model"):
        plant(hand, friction=0.5)
    strength = np.zeros(5)
    for contact in ours._touches:
        strength[contact.finger] += np.linalg.norm(contact.normal)
    assert strength.sum() > 2.0 and ours.stage is Stage.FREE
    assert np.all(felt[strength == 0] < 0.2) and felt.sum() > 0.5 * strength.sum()
