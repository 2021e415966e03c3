"""Observations: sizes, order and content of every field, the ablations, and bitwise sameness."""

import jax
import mujoco
import numpy as np
import pytest
from episodes import by_field
from random_readings import random_readings

from dexsim import observation
from dexsim.env.sensors import SensorSuite
from dexsim.errors import ConfigError
from dexsim.observation import FIELDS, GRASP, ROTATE, LayoutEntry, ObservationConfig, ObservationField, layout
from dexsim.tasks.grasp.config import GraspConfig
from dexsim.tasks.grasp.task import Grasp
from dexsim_real.control.controller import sources_of

TIPS = ("thumb_tip", "index_tip", "mid_tip", "ring_tip", "pinky_tip")
observe = jax.jit(observation.observe, static_argnums=(0, 2, 3))


@pytest.fixture(scope="module")
def readings(hand):
    return random_readings(hand, 0)


@pytest.fixture(scope="module")
def truth(hand, readings):
    """What each field ought to hold, by C MuJoCo and loops."""
    model = mujoco.MjModel.from_xml_path(str(hand.model_path))
    data = mujoco.MjData(model)
    for name, angle in zip(hand.joint_names, readings.joint_position, strict=True):
        data.qpos[model.joint(name).qposadr[0]] = angle
    mujoco.mj_forward(model, data)
    tip, centre, plain = [], [], []
    for finger, site in enumerate(TIPS):
        at = model.site(site).id
        tip.append(data.site_xpos[at])
        body = model.site_bodyid[at]
        taxels = hand.taxel_position[finger] @ data.xmat[body].reshape(3, 3).T + data.xpos[body]
        force = readings.taxel_force[finger].astype(float)
        centre.append(force @ taxels / force.sum() if force.sum() else np.zeros(3))
        plain.append(taxels[force > 0].mean(0) if force.any() else np.zeros(3))
    # The turn that takes the object to its goal: goal = relative * object.
    back, relative, matrix = np.zeros(4), np.zeros(4), np.zeros(9)
    mujoco.mju_negQuat(back, readings.object_quat.astype(float))
    mujoco.mju_mulQuat(relative, readings.goal_quat.astype(float), back)
    mujoco.mju_quat2Mat(matrix, relative)
    matrix = matrix.reshape(3, 3)
    same = "joint_position", "joint_torque", "object_position", "object_velocity", "last_action", "palm_gravity"
    return {name: getattr(readings, name) for name in same} | {
        "contact_force": readings.taxel_force.sum(1),
        "contact_centre": np.ravel(centre),
        "fingertip_position": np.ravel(tip),
        "command": [0.37],
        "relative_orientation": np.concatenate([matrix[:, 0], matrix[:, 1]]),
        "relative_quaternion": relative,
        "plain_centre": np.ravel(plain),
        "past_actions": np.ravel(readings.past_actions),
    }


def check(hand, readings, names, config, wanted):
    """Every field against the truth; returns their names and the size of the whole."""
    vector = np.asarray(observe(hand, readings, names, config))
    fields = layout(hand, names, config)
    assert vector.dtype == np.float32 and vector.shape == (sum(f.size for f in fields),)
    for name, values in by_field(fields, vector).items():
        np.testing.assert_allclose(values, wanted[name], atol=2e-6, rtol=1e-5, err_msg=name)
    return [f.name for f in fields], len(vector)


# In the paper's order.
ORDER = {
    GRASP: "joint_position joint_torque object_position object_velocity contact_force contact_centre "
    "fingertip_position command",
    ROTATE: "joint_position relative_orientation last_action contact_centre contact_force fingertip_position",
}


@pytest.mark.parametrize(
    ("names", "leave_out", "size"),
    [
        (GRASP, (), 66),
        (ROTATE, (), 65),
        (GRASP, ("contact_force", "contact_centre"), 46),
        (ROTATE, ("relative_orientation",), 59),
    ],
)
def test_the_observation_is_the_papers_without_what_an_ablation_leaves_out(
    hand, readings, truth, names, leave_out, size
):
    more = ("past_actions", "palm_gravity")
    found = check(hand, readings, names, ObservationConfig(leave_out=leave_out, add=more), truth)
    assert found == ([*(name for name in ORDER[names].split() if name not in leave_out), *more], size + 27)


def test_touch_commands_and_actions_have_a_scale_of_their_own():
    """In the fields' units. A policy carries them: with others it is refused as one of another version."""
    scale = {name: field.scale for name, field in FIELDS.items() if field.scale is not None}
    fixed = {"joint_torque": 0.3, "contact_force": 5.0, "contact_centre": 0.1, "finger_force": 5.0, "command": 0.5}
    assert scale == fixed | {"last_action": 1.0, "past_actions": 1.0, "palm_gravity": 1.0}


def test_ablations_show_a_quaternion_and_an_unweighted_centre(hand, readings, truth):
    config = ObservationConfig(orientation="quaternion", weighting="none")
    shown = {"relative_orientation": truth["relative_quaternion"], "contact_centre": truth["plain_centre"]}
    assert np.abs(truth["plain_centre"] - truth["contact_centre"]).max() > 1e-3
    assert check(hand, readings, ROTATE, config, truth | shown)[1] == 63


def test_the_critic_keeps_what_the_actor_goes_without(hand):
    """An ablation is of the actor."""
    config = GraspConfig(observation=ObservationConfig(leave_out=("contact_force",), add=("last_action",)))
    layouts = SensorSuite(config, hand, Grasp(config, hand)).layout
    actor, critic = ([field.name for field in layouts[group]] for group in ("actor", "critic"))
    assert actor == [*(name for name in GRASP if name != "contact_force"), "last_action"]
    assert critic == [*GRASP, "last_action"]
    with pytest.raises(ConfigError, match="'object_spin': no sensor measures it"):
        ObservationConfig(add=("object_spin",))


def test_a_field_of_ones_own_is_one_entry(hand, readings, monkeypatch):
    """Named in the configuration, it stands at the observation's end, and the bridge knows who measures it."""
    own = ObservationField(
        name="bending", source="hand", compute=lambda f: f.readings.joint_position.sum()[None], scale=12.0
    )
    monkeypatch.setitem(FIELDS, own.name, own)
    config = ObservationConfig(add=("bending",))
    assert layout(hand, GRASP, config)[-1] == LayoutEntry("bending", 1, 12.0)
    vector = observation.observe(hand, readings, GRASP, config)
    assert vector.shape == (67,) and float(vector[-1]) == pytest.approx(readings.joint_position.sum(), rel=1e-5)
    assert sources_of(("bending",)) == {"hand"}
