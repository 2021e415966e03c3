"""The kernel of the `cuda` engine in an emulated warp, against C MuJoCo in double precision."""

import mujoco
import numpy as np
import pytest
import warp_emulation
from paths import DATA
from physics_states import mujoco_substeps, scene_of_model, tumble
from warp_emulation import Emulation

from dexsim.errors import AssetError
from dexsim.hand.load import load_hand
from dexsim.physics.config import PhysicsConfig
from dexsim.physics.cuda import scene as cuda_scene
from dexsim.physics.interface import PhysicsScene
from dexsim.physics.model import build_scene

pytestmark = pytest.mark.skipif(warp_emulation.compiler is None, reason="the emulation of a warp needs g++")

BOX = ("box",), np.array([[0.03, 0.03, 0.03]])
ALL = ("box", "capsule", "cylinder"), np.array([[0.03, 0.03, 0.03], [0.025, 0.03, 0], [0.03, 0.03, 0]])
MESH = ("box", "box"), np.full((2, 3), 0.03)
EGG = ("ellipsoid", "box"), np.array([[0.03, 0.025, 0.035], [0.03, 0.03, 0.03]])


def scene_of(hand: str, slots, largest, gravity=(-9.81, 0.0, 0.0)) -> PhysicsScene:
    loaded = load_hand() if hand == "xhand" else load_hand(hand)
    return build_scene(loaded, slots, largest, PhysicsConfig(), gravity, "c")


def near_palm(random: np.random.Generator) -> np.ndarray:
    """A pose over the palm: a place in front of it, any orientation."""
    quat = random.normal(size=4)
    place = [random.uniform(0.05, 0.09), random.uniform(-0.03, 0.03), random.uniform(0.05, 0.14)]
    return np.array([*place, *quat / np.linalg.norm(quat)])


def compare(scene: PhysicsScene, states, substeps: int, **options):
    """Outputs of the kernel, and its errors by world: finger forces N, accelerations of joints rad/s^2."""
    expected = mujoco_substeps(scene, states, substeps)
    outputs = Emulation(scene).run(states | {"law_0": states["target"]}, substeps=substeps, **options)
    force = outputs["finger_force"].reshape(expected["finger_force"].shape) - expected["finger_force"]
    error = {
        "force": np.linalg.norm(force, axis=-1).max(-1),
        "acceleration": np.abs(outputs["warmstart_out"] - expected["acceleration"])[:, :-6].max(-1),
        "qpos": np.abs(outputs["qpos_out"] - expected["qpos"]).max(-1),
        "qvel": np.abs(outputs["qvel_out"] - expected["qvel"]).max(-1),
    }
    return expected, outputs, error


@pytest.mark.parametrize(
    ("task", "slots", "largest", "gravity"),
    [("rotate", *BOX, (-9.42, -1.95, 1.91)), ("grasp", *ALL, (9.81, 0.0, 0.0))],
    ids=["rotate", "grasp"],
)
def test_states_of_the_shipped_policies(task, slots, largest, gravity):
    """64 states of 16 episodes of each task's policy on C MuJoCo, from reset to 100 (rotate) and 140 ticks (grasp)."""
    scene = scene_of("xhand", slots, largest, gravity)
    states = dict(np.load(DATA / f"{task}_states.npz"))
    for substeps, factor in ((1, 1.0), (5, 10.0)):
        expected, outputs, error = compare(scene, states, substeps)
        if substeps == 1:
            np.testing.assert_array_equal(outputs["stats"][:, 2], expected["contacts"])
        assert np.percentile(error["force"], 90) < 0.001 * factor and np.percentile(error["force"], 99) < 0.1 * factor
        assert np.percentile(error["acceleration"], 90) < 0.01 * factor


@pytest.mark.filterwarnings("ignore:.*QACC")
@pytest.mark.parametrize(("hand", "object"), [("leap_like", ALL), ("inspire_like", MESH), ("inspire_like", EGG)])
def test_example_hands(hand, object, tmp_path, monkeypatch):
    """Sphere, capsule, box and plane of the hand on all kinds of primitives. Boxes of a mesh also meet boxes."""
    monkeypatch.chdir(tmp_path)  # MuJoCo logs its warnings in the working directory
    scene = scene_of(hand, *object)
    states = tumble(scene, 64, near_palm)
    expected, outputs, error = compare(scene, states, 1)
    assert (expected["contacts"] > 0).mean() > 0.4 and np.linalg.norm(expected["finger_force"], axis=-1).max() > 1
    np.testing.assert_array_equal(outputs["stats"][:, 2], expected["contacts"])
    assert np.percentile(error["force"], 90) < 0.001 and np.percentile(error["force"], 99) < 0.01
    assert np.percentile(error["acceleration"], 90) < 0.01
    assert np.percentile(error["qpos"], 90) < 2e-6 and np.percentile(error["qvel"], 90) < 2e-4


BRANCHED = (DATA / "branched.xml").read_text()


def branched_scene(text: str = BRANCHED) -> PhysicsScene:
    """A hand that has what ours lack: a wrist that carries fingers, joints away from their bodies' origins, springs,
    margins of limits, couplings across fingers that are no straight lines, contacts between links of one branch."""
    model = mujoco.MjModel.from_xml_string(text)
    joints = np.flatnonzero(model.jnt_type == mujoco.mjtJoint.mjJNT_HINGE)
    tips = np.array([model.body(name).id for name in ("a2", "b2", "c1")])
    # Joints in another order than the model's, and not all.
    return scene_of_model(model, ("capsule",), joints[::-1][1:], tips, np.flatnonzero(np.isin(model.geom_bodyid, tips)))


def in_branches(random: np.random.Generator) -> np.ndarray:
    quat = random.normal(size=4)
    return np.array([*random.uniform([0.03, -0.04, 0.0], [0.07, 0.04, 0.12]), *quat / np.linalg.norm(quat)])


def test_any_tree_of_hinges():
    scene = branched_scene()
    states = tumble(scene, 64, in_branches)
    for substeps, factor in ((1, 1.0), (5, 10.0)):
        expected, outputs, error = compare(scene, states, substeps, iterations=30)
        assert expected["contacts"].max() >= 4
        assert np.percentile(error["force"], 90) < 0.001 * factor and np.percentile(error["force"], 99) < 0.1 * factor
        assert np.percentile(error["acceleration"], 90) < 0.02 * factor


def test_lost_contacts_and_diverged_worlds_have_no_forces():
    # Forty more spheres where the link a2 is: all of them touch what it touches.
    names = [f"more{k}" for k in range(40)]
    text = BRANCHED.replace(
        '<geom name="a2"',
        "".join(f'<geom name="{name}" type="sphere" size="0.009" pos="0.005 0 0.015"/>' for name in names)
        + '<geom name="a2"',
    )
    text = text.replace(
        "</contact>", "".join(f'<pair geom1="{n}" geom2="object_0" condim="3"/>' for n in names) + "</contact>"
    )
    scene = branched_scene(text)
    states = tumble(scene, 24, in_branches)
    states["qvel"][1, 2], states["qpos"][2, -7] = np.inf, np.nan
    inputs = states | {"law_0": states["target"]}
    outputs = Emulation(scene).run(inputs, substeps=2)
    lost = outputs["stats"][:, 2] > cuda_scene.MAX_CONTACTS
    assert 0 < lost.sum() < 20
    np.testing.assert_array_equal(outputs["stats"][:, 3], lost)
    lost[1:3] = True
    np.testing.assert_array_equal(np.isnan(outputs["finger_force"]).all(1), lost)
    np.testing.assert_array_equal(np.isnan(outputs["finger_force"]).any(1), lost)

    alone = Emulation(scene).run({name: values[3:4] for name, values in inputs.items()}, substeps=2)
    for name, values in alone.items():  # worlds do not depend on each other: equal to the bit
        np.testing.assert_array_equal(values, outputs[name][3:4])


@pytest.mark.parametrize(
    ("before", "after", "message"),
    [
        ('name="c1" axis', 'name="c1" frictionloss="0.1" axis', "dry friction.*backend mjx may"),
        ('condim="3"', 'condim="4"', "dimension"),
        ('friction="0.4 0.4"', 'friction="0.4 0.5"', "depends on the direction"),
        ('<geom name="c1"', '<geom name="c1" type="cylinder"', "no contacts of .*cylinder 'c1' on capsule 'object_0'"),
    ],
)
def test_what_does_not_fit_is_named(before, after, message):
    assert BRANCHED.count(before) >= 1
    with pytest.raises(AssetError, match=f"hand.xml: backend cuda .*{message}"):
        cuda_scene.kernel_constants(branched_scene(BRANCHED.replace(before, after, 1)))
