"""The contract of a hand's files."""

import re
import shutil
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dexsim import check_hand
from dexsim.core.assets import asset_path
from dexsim.hand.load import load_hand


@pytest.fixture
def folder(tmp_path):
    shutil.copytree(asset_path("hand/xhand_right.toml").parent, tmp_path, dirs_exist_ok=True)
    return tmp_path


@pytest.fixture(autouse=True)
def quick(monkeypatch):
    monkeypatch.delitem(check_hand.CHECKS, "random actions stay finite")  # it takes seconds: see test_import_hand


def test_shipped_hand_passes(capsys):
    assert check_hand.main([str(asset_path("hand/xhand_right.toml"))]) == 0
    out = capsys.readouterr().out
    assert "thumb_bend        0.00 to  1.83         1.10             8.63" in out  # of the published table
    assert "self-collision: 8 pairs" in out
    assert "12 joints, 5 fingers of 120 taxels" in out and out.count("ok  ") == 8 and "FAIL" not in out


@pytest.mark.parametrize("says", ["is 0.001 m from", "is 0.01 rad turned"])
def test_a_link_that_is_elsewhere_or_turned_is_named(folder, says):
    """The last link: no other is displaced by it."""
    hand = load_hand(folder / "xhand_right.toml")
    if "turned" in says:
        hand.body_rotation[-1] = hand.body_rotation[-1] @ Rotation.from_euler("x", 0.01).as_matrix()
    else:
        hand.body_position[-1, 0] += np.float32(0.001)
    assert re.search(f"right_hand_pinky_link2.* {says}", check_hand.check_kinematics(hand))


# What is changed of the taxels' positions and normals, and what is said of it.
ONE = np.zeros((5, 120, 1), np.float32)
ONE[1, 17] = 1  # of the index finger
MISPLACED = {
    "sunk": (
        lambda place, normal: (place - 0.004 * ONE * normal, normal),
        r"^finger 'index': taxel column 1, row 5 lies [34](\.\d)? mm inside its link \(1 of 120\)$",
    ),
    "millimetres": (lambda place, normal: (1e3 * place, normal), "mm away from its link: metres, in"),
    "frame": (
        lambda place, normal: (place + np.float32([0, 0, 0.18]), normal),
        "'thumb': taxel .* mm away from its link",
    ),
    "normals": (lambda place, normal: (place, -normal), "faces into its link: .*120 of 120"),
}


@pytest.mark.parametrize("name", MISPLACED)
def test_taxels_that_are_off_the_skin_are_named(hand, name):
    change, said = MISPLACED[name]
    place, normal = change(hand.taxel_position, hand.taxel_normal)
    assert re.search(said, check_hand.check_taxels(replace(hand, taxel_position=place, taxel_normal=normal)))


def test_a_hand_that_nothing_can_touch_gets_its_whole_report(folder, capsys):
    """Some checks cannot be made of it."""
    model = folder / "xhand_right.xml"
    model.write_text(re.sub(r'(contype|conaffinity)="\d"', r'\1="0"', model.read_text()))
    assert check_hand.main([str(folder / "xhand_right.toml")]) == 1
    failed = [line for line in capsys.readouterr().out.splitlines() if line.startswith("FAIL")]
    assert failed[0].startswith("FAIL  fingertips touch: finger 'thumb' has no primitive at its tip that touches")
    assert failed[-1].startswith("FAIL  fingertips reach the object: ") and "contype or conaffinity" in failed[-1]


def test_mesh_that_touches_is_refused(folder, capsys):
    model, corners = folder / "xhand_right.xml", "0 0 0  0.01 0 0  0 0.01 0  0 0 0.01"
    text = model.read_text().replace("<worldbody>", f'<asset><mesh name="hull" vertex="{corners}"/></asset><worldbody>')
    site, mesh = '<site name="index_tip"', '<geom name="index_hull" class="{}" type="mesh" mesh="hull"/>'
    for kind, code in (("shell", 0), ("pad", 1)):
        model.write_text(text.replace(site, mesh.format(kind) + site))
        assert check_hand.main([str(folder / "xhand_right.toml")]) == code
    out = capsys.readouterr().out
    assert "FAIL  files load" in out and "geom 'index_hull' of 'right_hand_index_rota_link2' is no primitive" in out


def negate(axis):
    return f'axis="{" ".join(f"{-float(x):g}" for x in axis[1].split())}"'


CLOSED = [1.2, 0.4, 1.4, 1.4] + 3 * [2.0, 0.0, 1.6, 1.4]
FAR = r"fingertip nearest to centre is \d+ mm away, expected 60 mm at most"
# What is replaced in the MJCF or the TOML, and what which check says of it.
WRONG = {
    "palm in another frame": (  # as makers draw it
        {
            '<body name="palm">': '<body name="base"><body name="palm" euler="0 1.5708 0">',
            "</worldbody>": "</body></worldbody>",
            'palm = "palm"': 'palm = "base"',
        },
        check_hand.check_frame,
        r"'index' points along .* of 'base' .* expected \+z",
    ),
    "other side": (
        {'name = "leap_like"': 'name = "leap_like"\nside = "left"'},
        check_hand.check_frame,
        r"the thumb is on the side of \+y, of a left hand expected -y",
    ),
    "axes reversed": (
        {r'axis="([^"]+)"': negate},
        check_hand.check_signs,
        "positive angles open thumb_mcp.*index_mcp.*negate",
    ),
    "no grasp": ({r"(?s)\[grasp\].*?(?=\[\[)": ""}, check_hand.check_reach, "'leap_like' has no grasp: its TOML needs"),
    "stretched": ({r"posture = \[.*\]": f"posture = {[0.0] * 16}"}, check_hand.check_reach, FAR),
    "closed": (
        {r"posture = \[.*\]": f"posture = {CLOSED}"},
        check_hand.check_reach,
        "mm deep in a ball of 44 mm at centre: open the posture",
    ),
    "torque of the CAD": (
        {'actuatorfrcrange="-0.93 0.93"': 'actuatorfrcrange="-100 100"'},
        check_hand.check_limits,
        "'thumb_cmc' has a stall torque of 100 Nm, expected 0.02 to 5 Nm",
    ),
}


@pytest.mark.parametrize("case", WRONG)
def test_a_convention_that_is_broken_is_named(case, tmp_path):
    """Hands that load, and whose physics runs, but whose grasps cannot be learnt."""
    changes, check, said = WRONG[case]
    for name in ("leap_like.xml", "leap_like.toml"):
        text = asset_path(f"hand/leap_like/{name}").read_text()
        for old, new in changes.items():
            text = re.sub(old, new, text)
        (tmp_path / name).write_text(text)
    assert re.search(said, check(load_hand(tmp_path / "leap_like.toml")))
