"""The two example hands: against the published chains, multiplied out here, and what any hand must pass."""

import jax
import numpy as np
import pytest

from dexsim import check_hand
from dexsim.hand.kinematics import flexion_joints, forward_kinematics
from dexsim.hand.load import load_hand

HANDS = ("leap_like", "inspire_like")

# LEAP Hand, MuJoCo Menagerie's right_hand.xml: place and quaternion of each body in its parent; all hinges turn about
# -z. The tips are the ends of its fingertip meshes. Motors in the order of the chain.
HALF = 0.5**0.5
FINGER = [
    ((-0.0122, 0.0381, 0.0145), (0.5, -0.5, -0.5, 0.5)),
    ((0.015, 0.0143, -0.013), (0.5, 0.5, -0.5, 0.5)),
    ((0, -0.0361, 0.0002), (1, 0, 0, 0)),
]
LEAP = {
    "thumb": [
        ((-0.0693, -0.0012, -0.0216), (HALF, 0, HALF, 0)),
        ((0, 0.0143, -0.013), (0.5, 0.5, -0.5, 0.5)),
        ((0, 0.0145, -0.017), (HALF, -HALF, 0, 0)),
        ((0, 0.0466, 0.0002), (0, 0, 0, 1)),
    ],
    "index": [((-0.007, 0.023, -0.0187), (0.5, 0.5, 0.5, -0.5)), *FINGER],
    "middle": [((-0.0071, -0.0224, -0.0187), (0.5, 0.5, 0.5, -0.5)), *FINGER],
    "ring": [((-0.00709, -0.0678, -0.0187), (0.5, 0.5, 0.5, -0.5)), *FINGER],
}
LEAP_TIPS = {"thumb": (0, -0.062, -0.0146), "index": (0, -0.05, 0.0146), "middle": (0, -0.05, 0.0146)}
LEAP_TIPS["ring"] = LEAP_TIPS["middle"]
LEAP_AXES = np.array([[0, 0, -1], [0, 1, 0], [1, 0, 0]])  # rows: our axes in its palm's frame

# Inspire RH56, dexsuite/dex-urdf: place, roll-pitch-yaw, sign of the hinge about z, motor, ratio and offset.
INSPIRE = {
    "thumb": [
        ((-0.01696, -0.0691, -0.02045), (1.5708, -1.5708, 0), -1, "thumb_yaw", 1, 0),
        ((-0.0088099, 0.010892, -0.00925), (1.5708, 0, 2.8587), 1, "thumb_pitch", 1, 0),
        ((0.04407, 0.034553, -0.0008), (0, 0, 0), 1, "thumb_pitch", 1.334, 0),
        ((0.020248, 0.010156, -0.0012), (0, 0, 0), 1, "thumb_pitch", 0.667, 0),
    ]
}
ROOTS = {
    "index": ((0.00028533, -0.13653, -0.032268), -3.1067, (-0.0026138, 0.032026, -0.001)),
    "middle": ((0.00028533, -0.1371, -0.01295), -3.1416, (-0.0024229, 0.032041, -0.001)),
    "ring": ((0.00028533, -0.13691, 0.0062872), 3.0892, (-0.0024229, 0.032041, -0.001)),
    "pinky": ((0.00028533, -0.13571, 0.025488), 3.0369, (-0.0024229, 0.032041, -0.001)),
}
for _name, (_root, _roll, _knuckle) in ROOTS.items():
    INSPIRE[_name] = [
        (_root, (_roll, 0, 0), 1, _name, 1, 0),
        (_knuckle, (0, 0, 0), 1, _name, 1.06399, -0.04545),
    ]
INSPIRE_TIPS = {
    "thumb": (0.0202, 0.0140, -0.006),
    "index": (-0.0008, 0.045, -0.005),
    "middle": (-0.001, 0.048, -0.005),
    "ring": (-0.0008, 0.045, -0.005),
    "pinky": (-0.0008, 0.037, -0.005),
}
INSPIRE_AXES = np.array([[-1, 0, 0], [0, 0, -1], [0, -1, 0]])


def turn(axis, angle):
    """Rotation about a coordinate axis."""
    c, s = np.cos(angle), np.sin(angle)
    i, j = [(1, 2), (2, 0), (0, 1)][axis]
    matrix = np.eye(3)
    matrix[i, i] = matrix[j, j] = c
    matrix[i, j], matrix[j, i] = -s, s
    return matrix


def of_quaternion(q):
    w, *v = np.array(q, float) / np.linalg.norm(q)
    x, y, z = v
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + 2 * w * cross + 2 * cross @ cross


def leap_tip(name, angles):
    place, frame = np.zeros(3), np.eye(3)
    for (position, q), angle in zip(LEAP[name], angles, strict=True):
        place, frame = place + frame @ position, frame @ of_quaternion(q) @ turn(2, -angle)
    return LEAP_AXES @ (place + frame @ LEAP_TIPS[name])


def inspire_tip(name, motors):
    place, frame = np.zeros(3), np.eye(3)
    for position, (roll, pitch, yaw), sign, motor, ratio, offset in INSPIRE[name]:
        place = place + frame @ position
        frame = frame @ turn(2, yaw) @ turn(1, pitch) @ turn(0, roll)
        frame = frame @ turn(2, sign * (ratio * motors[motor] + offset))
    return INSPIRE_AXES @ (place + frame @ INSPIRE_TIPS[name])


@pytest.mark.parametrize("name", HANDS)
def test_tips_are_where_the_published_chains_put_them(name):
    hand, random = load_hand(name), np.random.default_rng(0)
    kinematics = jax.jit(lambda joints: forward_kinematics(hand, joints).tip_position)
    for joints in [0 * hand.joint_lower, *random.uniform(hand.joint_lower, hand.joint_upper, (20, hand.num_joints))]:
        motors = dict(zip(hand.joint_names, joints, strict=True))
        for finger, tip in zip(hand.finger_names, kinematics(np.float32(joints)), strict=True):
            if name == "leap_like":
                wanted = leap_tip(finger, [motors[joint] for joint in motors if joint.startswith(finger)])
            else:
                wanted = inspire_tip(finger, motors)
            np.testing.assert_allclose(tip, wanted, atol=6e-4, err_msg=finger)  # places are rounded to 0.1 mm


def test_published_motors():
    leap, inspire = load_hand("leap_like"), load_hand("inspire_like")
    assert (leap.num_joints, leap.num_hinges, leap.num_fingers) == (16, 16, 4)
    assert (inspire.num_joints, inspire.num_hinges, inspire.num_fingers) == (6, 12, 5)
    np.testing.assert_allclose(leap.torque_limit, 0.93)
    np.testing.assert_allclose(leap.speed_limit, 81 * 2 * np.pi / 60, rtol=1e-3)
    np.testing.assert_allclose(inspire.joint_upper, [1.308, 0.6, 1.47, 1.47, 1.47, 1.47], rtol=1e-6)


@pytest.mark.parametrize(("name", "sideways"), [("leap_like", "_rot"), ("inspire_like", "_none")])
def test_joints_that_swing_a_finger_sideways_do_not_curl_it(name, sideways):
    hand = load_hand(name)
    curl = {hand.joint_names[joint] for joint in flexion_joints(hand, range(1, hand.num_fingers))}
    fingers = {joint for joint in hand.joint_names if not joint.startswith("thumb")}
    assert curl == {joint for joint in fingers if not joint.endswith(sideways)}


@pytest.mark.slow
@pytest.mark.parametrize("name", ["leap_like", "inspire_like"])
def test_passes_the_checks(name, capsys):
    assert check_hand.main([name]) == 0
    out = capsys.readouterr().out
    assert out.count("ok  ") == 5 and "pairs" in out
    assert ("index_intermediate (x 1.064)" in out) == (name == "inspire_like")
