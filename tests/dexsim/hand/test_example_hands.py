"""The two example hands: tips against those of the published chains, and what any hand must pass."""

import jax
import numpy as np
import pytest

from dexsim import check_hand
from dexsim.hand.kinematics import forward_kinematics
from dexsim.hand.load import load_hand

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
