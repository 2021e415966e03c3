"""A plant model of a user's own: what fits is found, the rest is refused in one line; its physics is the file's."""

import mujoco
import numpy as np
import pytest
from emulated_plant import QUIET, free, motors

from dexsim.core.assets import asset_path
from dexsim_real.core.errors import HandError
from dexsim_real.twin import __main__ as twin_command
from dexsim_real.twin.options import TwinArguments
from dexsim_real.twin.plant.assistant import POSTURES, Stage
from dexsim_real.twin.plant.foreign.hand import ForeignHand
from dexsim_real.twin.plant.foreign.model import read_model
from dexsim_real.twin.plant.foreign.taxels import ContactTaxels
from dexsim_real.twin.plant.mount import GRAVITY
from dexsim_real.twin.plant.parameters import sample_trial
from dexsim_real.wire.frames import Mode

EXACT = QUIET | {"encoder_bias": 0.0, "encoder_noise": 0.0, "current_noise": 0.0, "current_gain": 1.0, "latency": 0.0}
FINGERS = ("thumb", "index", "middle", "ring", "little")
STILL = {"push_rate": 0.0, "sensing_latency": 0.0}


@pytest.fixture(scope="module")
def text():
    return asset_path("plants/foreign_right.xml").read_text()


@pytest.fixture
def write(tmp_path):
    def write(content, name="hand.xml"):
        (tmp_path / name).write_text(content)
        return tmp_path / name

    return write


def plant(hand, path=None, task="rotate", **overrides):
    path = path or asset_path("plants/foreign_right.xml")
    return ForeignHand(path, hand, task, 0, kind="nominal", overrides=EXACT | STILL | overrides)


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
        mujoco.mj_kinematics(ours._scene.model, ours._data)
        for site, body in zip(ours._scene.tip_site, hand.tip_body, strict=True):
            wanted = data.body(hand.body_names[body])
            assert ours._data.site_xpos[site] == pytest.approx(wanted.xpos, abs=1e-4)
            assert ours._data.site_xmat[site] == pytest.approx(wanted.xmat, abs=2e-3)


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ('<position class="weak" joint="little_curl"/>', "", "11 actuated joints, the hand has 12"),
        ('name="ring_curl" class="weak" axis="0 1 0" range="0 109.95"', 'name="ring_curl" axis="0 1 0" range="0 90"',
         "joint ring_curl has a range of 0.000 to 1.571 rad, ring_joint2 of the hand 0.000 to 1.919"),
        ('name="ring_curl" class="weak" axis="0 1 0" range="0 109.95"', 'name="ring_curl" axis="0 1 0"', "-inf to inf"),
        ('<site name="middle_tip" pos="-0.0422483 0 0"/>', "", "no fingertip sites of middle: put one site with 'tip'"),
        ('name="index_spread" class="weak" axis="-1', 'name="index_spread" class="weak" axis="1',
         "with index_spread at 0.17 rad the tip of index is 40 mm from where the hand has it"),
        ('pos="0.0095 0.0228 0.0305"', 'pos="0.0095 -0.0228 0.0305"', "with all joints at 0 the tip of thumb is 46 mm"),
        ('timestep="0.001"', 'timestep="0.01"', "a timestep of 10 ms; 0.1 to 5 ms are possible"),
        ('<body name="hand">', '<body name="hand"><freejoint/>', "MuJoCo cannot read it"),
        ('<geom type="cylinder"', '<joint axis="0 0 1"/><geom type="cylinder"', "(hand) moves: fix it to the world"),
        ('joint="thumb_swing"/>', 'joint="thumb_swing" dyntype="integrator"/>', "MuJoCo cannot read it"),
        ("<mujoco model", "<mujoko model", "MuJoCo cannot read it"),
        ('<position class="strong" joint="thumb_swing"/>', '<motor joint="thumb_swing" gear="0"/>',
         "the actuator of thumb_swing has a gear of 0 and moves nothing"),
        ('joint="thumb_swing"/>', 'joint="thumb_swing" gear="0"/>', "thumb_swing has a gear of 0"),
        ('<position class="strong" joint="thumb_swing"/>', '<general joint="thumb_swing" gainprm="0"/>',
         "the actuator of thumb_swing has a gain of 0 and moves nothing"),
        ('<position class="strong" joint="thumb_swing"/>', '<velocity joint="thumb_swing" kv="1"/>',
         "actuator 0: a hinge takes one motor or position servo"),
        ('<position class="strong" joint="thumb_swing"/>', '<damper joint="thumb_swing" kv="1" ctrlrange="0 1"/>',
         "actuator 0: a hinge takes one motor or position servo"),
        ("<option ", '<option actuatorgroupdisable="0" ', "actuatorgroupdisable turns off the actuator of thumb_swing"),
        ("<option ", '<option><flag contact="disable"/></option><option ', '<flag contact="disable"/>: a trial needs'),
        ("<option ", '<option><flag actuation="disable"/></option><option ', "a trial needs actuation"),
        pytest.param("<compiler ", '<compiler settotalmass="2" ', "<compiler settotalmass> is not supported",
                     marks=pytest.mark.filterwarnings("ignore:compiler attribute")),
        ("<worldbody>", '<worldbody><flexcomp name="skin" type="grid" count="2 2 1" radius="0.001" rigid="true"/>',
         "flex skin: the taxels do not feel what is soft"),
        ('name="middle_tip" pos="-0.0422483', 'name="middle_tip" pos="nan', "MuJoCo has it in site_pos"),
        ('joint damping="0.035"', 'joint damping="inf"', "nan or infinite: MuJoCo has it in dof_damping"),
    ],
)  # fmt: skip
def test_what_does_not_fit_is_refused_in_one_line(hand, text, write, old, new, says):
    assert old in text
    path = write(text.replace(old, new))
    with pytest.raises(HandError) as error:
        twin_command.make_plant(TwinArguments(plant_model=path), hand)
    assert says in str(error.value) and str(path) in str(error.value) and "\n" not in str(error.value)


def test_a_file_that_is_not_there_and_geoms_that_touch_nothing(hand, text, write, tmp_path):
    with pytest.raises(HandError, match="MuJoCo cannot read it"):
        read_model(tmp_path / "none.xml", hand)
    mute = text.replace(' contype="0" conaffinity="0"', "").replace("<geom ", '<geom contype="0" conaffinity="0" ')
    with pytest.raises(HandError, match="no geom can touch anything"):
        read_model(write(mute), hand)
    with pytest.raises(HandError, match="friction is not a parameter of a plant model"):
        plant(hand, friction=0.5)


def test_a_toml_names_what_cannot_be_found(hand, text, write):
    """Actuators in another order, tips without a name to find them by, a palm frame that is a site."""
    words = text.replace('<position class="strong" joint="thumb_swing"/>', "").replace(
        "</actuator>", '<position class="strong" joint="thumb_swing"/></actuator>'
    )
    for name in FINGERS:
        words = words.replace(f'site name="{name}_tip"', f'site name="{name}_x"')
    words = words.replace('<body name="hand">', '<body name="hand"><site name="palm"/>')
    words = words.replace('<site name="middle_x"', '<site name="screw" pos="0 0 0"/><site name="middle_x"')
    path = write(words)
    with pytest.raises(HandError, match="has a range of"):  # By order the joints are wrong.
        read_model(path, hand)
    joints = [n for n in words.split('"') if n.endswith(("_swing", "_flex", "_curl", "_spread"))][:12]
    names = f"joints = {joints}\n"
    tips = f"tips = {[f'{name}_x' for name in FINGERS]}\n"
    found = read_model(write(f'model = "hand.xml"\npalm = "palm"\n{names}{tips}', "hand.toml"), hand)
    assert [name.removeprefix("plant/") for name in found.joints] == joints and found.actuators[0] == 11
    for lines, says in (
        (f'{names}{tips}palm = "q"', "neither a body nor a site 'q'"),
        (f'{names}tips = ["a"]', "give 5 sites"),
        (f"{names}", "2 fingertip sites of middle|no fingertip sites of middle"),
        (f'joints = ["a"]\n{tips}', "joints: 'a' is not one of them"),
        (f"{names}tip = 1", "field 'tip'"),
        ('joints = [["a"]]', r"field 'joints': \['a'\] is not a name in quotes"),
        (f"{names}tips = [1, 2, 3, 4, 5]", "field 'tips': 1 is not a name in quotes"),
    ):
        with pytest.raises(HandError, match=says):
            read_model(write(f'model = "hand.xml"\n{lines}\n', "bad.toml"), hand)


@pytest.mark.parametrize(("slope", "priority"), [(0.45, 0), (0.45, -1), (0.7, 0)])
def test_friction_is_that_of_the_file(hand, text, write, slope, priority):
    """A cube on the palm, 0.55 in the file: it sticks, or slides with g (sin - 0.55 cos)."""
    ours = plant(hand, write(text.replace('friction="0.55 ', f'priority="{priority}" solmix="0" friction="0.55 ')))
    model, data, at = ours._scene.model, ours._data, ours._scene.object_qpos
    angle = np.arctan(slope)
    model.opt.gravity[:] = GRAVITY * np.array([-np.cos(angle), 0.0, -np.sin(angle)])
    assert ours._palm_face == pytest.approx(0.0192, abs=1e-5)
    free(ours, (ours._palm_face + 0.0275, -0.002, 0.075))
    ours.drive(motors(np.zeros(12)))
    stiffness = []
    for _ in range(5):
        ours.advance(0.01)
        stiffness += data.contact.solref[ours._scene.is_object[data.contact.geom].any(-1)].tolist()
    assert stiffness and np.all(np.array(stiffness) == [0.007, 1.0])
    before = data.qvel[ours._scene.object_dof + 2]
    ours.advance(0.1)
    rate = (data.qvel[ours._scene.object_dof + 2] - before) / 0.1
    wanted = -max(GRAVITY * (np.sin(angle) - 0.55 * np.cos(angle)), 0.0)
    assert rate == pytest.approx(wanted, abs=0.1) and data.qpos[at] == pytest.approx(0.0467, abs=5e-4)


def test_the_files_time_step_is_kept_and_time_is_time(hand, text, write):
    ours = plant(hand, write(text.replace('timestep="0.001"', 'timestep="0.002"')), "grasp")
    free(ours, (0.5, 0.0, 0.0))
    ours.advance(0.2)
    fallen = ours._data.qpos[ours._scene.object_qpos] - 0.5
    assert ours.time == pytest.approx(0.2, abs=0.002) and fallen == pytest.approx(0.5 * GRAVITY * 0.04, rel=0.03)


def test_servos_are_the_files_and_obey_the_wire(hand):
    """A joint against its end stop: torque = kp (target - angle), up to the limit, and the current reports it."""
    ours, joint = plant(hand), 4  # index_flex: 2.8 Nm/rad, 1.05 Nm; the hand's limit is 1.1 Nm
    ours._scene.model.opt.gravity[:] = 0.0

    def current(target, **command):
        goal = np.full(12, 0.1)
        goal[joint] = target
        ours.drive(motors(goal, **command))
        ours.advance(1.5)
        return -ours.measure().current[joint] * 1.1 / 1000, float(ours._joints()[joint])  # Nm, rad

    torque, angle = current(2.2)
    assert angle > 1.9 and torque == pytest.approx(2.8 * (2.2 - angle), rel=0.02)
    torque, angle = current(2.2, kp=50.0)
    assert torque == pytest.approx(1.4 * (2.2 - angle), rel=0.02)
    assert current(3.0)[0] == pytest.approx(1.05, rel=1e-3) and ours._motors.at_limit()[joint]
    assert current(3.0, torque_max=150.0)[0] == pytest.approx(0.525, rel=1e-3)
    assert current(3.0, mode=Mode.PASSIVE)[0] == 0.0 and not ours._motors.at_limit().any()


def test_torque_motors_get_a_servo_and_their_control_range_as_limit(hand):
    """The hand's own MJCF as a plant model: motors without gain."""
    found = read_model(hand.model_path, hand).spec.compile()
    np.testing.assert_allclose(found.actuator_gainprm[:, 0], 3.0)
    np.testing.assert_allclose(found.actuator_biasprm[:, 1:3], [[-3.0, -0.1]] * 12)
    np.testing.assert_allclose(found.actuator_forcerange[:, 1], hand.torque_limit, rtol=1e-6)


def test_a_contact_loads_the_nearest_taxels_with_all_of_its_force(hand):
    skin, rng = ContactTaxels(hand), np.random.default_rng(1)
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
        return skin.load(None, None, None, tips, [(finger, point + height * outward, -3.0 * outward, tangent)])

    force = load(0.0)
    assert force[..., 2].sum() == pytest.approx(3.0) and np.all(force[[0, 1, 3, 4]] == 0)
    assert force[finger, :, 2].argmax() == taxel
    centre = force[finger, :, 2] @ hand.taxel_position[finger] / 3.0
    assert np.linalg.norm(centre - hand.taxel_position[finger, taxel]) < 0.0015
    assert np.linalg.norm(force[finger, taxel, :2]) == pytest.approx(
        np.linalg.norm(tangent) * force[finger, taxel, 2] / 3.0, rel=1e-3
    )
    assert load(0.006)[..., 2].sum() == pytest.approx(1.5, rel=0.02) and load(0.01).sum() == 0.0


def test_an_object_between_the_fingers_is_felt_by_the_fingers_that_hold_it(hand):
    ours = plant(hand, task="grasp")
    posture = np.array(POSTURES["grasp"])
    ours.drive(motors(posture))
    ours.advance(0.6)
    assert ours.stage is Stage.HOLD
    ours.drive(motors(posture + np.array([0, 0.35, 0.3, 0] + [0.25] * 8)))
    ours.advance(0.5)
    report, felt = ours.results()[0], ours.measure().taxel_force[..., 2].sum(-1)
    assert report["plant"] == "foreign_right.xml" and "friction" not in report["parameters"]
    strength = np.linalg.norm(ours._tips, axis=-1)
    assert strength.sum() > 2.0 and ours.stage is Stage.FREE
    assert np.all(felt[strength == 0] < 0.2) and felt.sum() > 0.5 * strength.sum()


def test_a_hand_without_room_for_an_object_is_no_endless_search(hand, text, write, monkeypatch):
    monkeypatch.setattr("dexsim_real.twin.plant.emulated_hand._OBJECTS", 3)
    path = write(text.replace("<worldbody>", '<worldbody><geom type="sphere" size="2"/>'))
    with pytest.raises(HandError, match="trial 0: none of 3 objects had room"):
        plant(hand, path)


def test_a_scene_of_its_own_is_left_out(hand, text, write):
    """Its object would be in the way of the trial's; a camera may look at it. Gravity is the trial's."""
    scene = """<worldbody><body name="cube" pos="0 0 .46"><freejoint/><geom name="c" type="box" size="1 1 1"/></body>
        <camera mode="targetbody" target="cube" pos="0 0 1"/><light mode="targetbody" target="cube" pos="0 0 1"/>"""
    words = text.replace("<worldbody>", scene).replace("<option ", '<option><flag gravity="disable"/></option><option ')
    words = words.replace("<contact>", '<contact><pair geom1="c" geom2="floor"/><exclude body1="cube" body2="hand"/>')
    words = words.replace(
        "<actuator>", '<custom><tuple name="all"><element objtype="body" objname="cube"/></tuple></custom><actuator>'
    )
    ours = plant(hand, write(words), "grasp")
    assert [ours._scene.model.body(b).name for b in range(ours._scene.model.nbody)].count("plant/cube") == 0
    free(ours, (0.5, 0.0, 0.0))
    ours.advance(0.2)
    fallen = ours._data.qpos[ours._scene.object_qpos] - 0.5
    assert fallen == pytest.approx(0.5 * GRAVITY * 0.04, rel=0.03)


def test_an_object_that_was_held_is_awake_when_it_is_let_go(hand, text, write):
    ours = plant(hand, write(text.replace("<option ", '<option><flag sleep="enable"/></option><option ')), "grasp")
    ours.drive(motors(np.array(POSTURES["grasp"])))
    ours.advance(1.0)
    assert ours.stage is Stage.HOLD
    ours.drive(motors(np.array(POSTURES["grasp"]) + 0.01))
    before = ours._data.qpos[ours._scene.object_qpos]
    ours.advance(0.12)
    assert ours.stage is Stage.FREE and ours._data.qpos[ours._scene.object_qpos] - before > 0.03


def test_a_servo_of_another_input_is_driven_by_angles(hand, text, write):
    """As in models whose control is a share of the range: 2.8 Nm/rad, 0 to 255 for 0 to 1.83 rad."""
    servo = (
        '<general joint="thumb_swing" biastype="affine" gainprm="0.0201" biasprm="0.5 -2.8 -.11" ctrlrange="0 255"/>'
    )
    ours = plant(hand, write(text.replace('<position class="strong" joint="thumb_swing"/>', servo)))
    ours._scene.model.opt.gravity[:] = 0.0
    ours.drive(motors(np.full(12, 0.15)))
    ours.advance(1.0)
    assert ours._joints()[0] == pytest.approx(0.15, abs=0.02)
