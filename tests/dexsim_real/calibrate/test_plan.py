"""The plan of the presses."""

import mujoco
import numpy as np
import pytest

from dexsim.hand.load import load_hand
from dexsim_real.calibrate.procedure import placements
from dexsim_real.core.errors import HandError


def test_every_joint_is_pressed_with_and_every_press_goes_outward(hand):
    """Against C MuJoCo: advancing moves the pressed taxels along their normals, from a posture that can be reached."""
    plan = placements(hand)
    assert {joint for placement in plan for joint in placement.joints} == set(range(12))
    model = mujoco.MjModel.from_xml_path(str(hand.model_path))
    data = mujoco.MjData(model)
    dofs = [model.joint(name).qposadr[0] for name in hand.joint_names]
    for placement in plan:
        tip, taxels = hand.body_names[hand.tip_body[placement.finger]], list(placement.taxels)
        places = []
        for advance in (0.0, 0.01):
            data.qpos[dofs] = placement.posture + advance * placement.direction
            mujoco.mj_kinematics(model, data)
            turn = data.body(tip).xmat.reshape(3, 3).T
            places.append(data.body(tip).xpos + hand.taxel_position[placement.finger, taxels] @ turn)
            normal = hand.taxel_normal[placement.finger, taxels] @ turn
        moved = np.mean(np.sum((places[1] - places[0]) * normal, -1))
        assert np.abs(placement.direction).max() == 1.0 and moved > 0.7 * 0.01 * 0.08, placement.name
        assert np.all(placement.posture >= hand.joint_lower) and np.all(placement.posture <= hand.joint_upper)
    assert {p.name for p in placements(hand, ("thumb",), sides=False)} == {"thumb pad"}
    with pytest.raises(HandError, match="no finger 'toe'"):
        placements(hand, ("toe",))


def test_the_left_hand_is_calibrated_by_the_same_presses(hand):
    for one, other in zip(placements(hand), placements(load_hand("xhand_left")), strict=True):
        assert (one.name, one.joints, one.task) == (other.name, other.joints, other.task)
        np.testing.assert_array_equal(other.posture, one.posture)
        np.testing.assert_allclose(other.direction, one.direction, atol=1e-5)
