"""The contract of a hand's files."""

import re
import shutil

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


def scaled(factor):
    """Positions of another unit."""
    return lambda line: [*line[:3], *(f"{factor * float(x):.6g}" for x in line[3:6]), *line[6:]]


def lifted(line):
    """Positions in a frame whose origin is elsewhere."""
    return [*line[:5], f"{float(line[5]) + 0.18:.6g}", *line[6:]]


def inward(line):
    return [*line[:6], *(f"{-float(x):.6g}" for x in line[6:9]), line[9]]


def sunk(line):
    """One taxel of the index finger, 4 mm below its skin."""
    if line[:3] != ["index", "1", "5"]:
        return line
    place = [float(x) - 0.004 * float(normal) for x, normal in zip(line[3:6], line[6:9], strict=True)]
    return [*line[:3], *(f"{x:.6g}" for x in place), *line[6:]]


# What is changed in each line of the taxel file, and what is said of it.
MISPLACED = {
    "sunk": (sunk, r"^finger 'index': taxel column 1, row 5 lies [34](\.\d)? mm inside its link \(1 of 120\)$"),
    "millimetres": (scaled(1e3), "mm away from its link: metres, in"),
    "frame": (lifted, "'thumb': taxel .* mm away from its link"),
    "normals": (inward, "faces into its link: .*120 of 120"),
}


@pytest.mark.parametrize("name", MISPLACED)
def test_taxels_that_are_off_the_skin_are_named(name, folder):
    change, said = MISPLACED[name]
    head, *lines = (folder / "taxels.csv").read_text().splitlines()
    (folder / "taxels.csv").write_text("\n".join([head, *(",".join(change(line.split(","))) for line in lines)]))
    assert re.search(said, check_hand.check_taxels(load_hand(folder / "xhand_right.toml")))


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


def turned_palm(model, table):
    """The palm's body is drawn in another frame, as makers do."""
    model = model.replace('<body name="palm">', '<body name="base"><body name="palm" euler="0 1.5708 0">')
    return model.replace("</worldbody>", "</body></worldbody>"), table.replace('palm = "palm"', 'palm = "base"')


def opening(model, table):
    """Every axis is reversed."""
    numbers = re.compile(r'axis="([^"]+)"')
    negated = numbers.sub(lambda axis: f'axis="{" ".join(f"{-float(x):g}" for x in axis[1].split())}"', model)
    return negated, table


def stretched(model, table):
    return model, re.sub(r"posture = \[.*\]", f"posture = {[0.0] * 16}", table)


def no_grasp(model, table):
    return model, table[: table.index("[grasp]")] + table[table.index("[[fingers]]") :]


def behind(model, table):
    return model, re.sub(r"centre = \[.*\]", "centre = [0, 0, -0.30]", table)


def closed(model, table):
    return model, re.sub(r"posture = \[.*\]", f"posture = {[1.2, 0.4, 1.4, 1.4] + 3 * [2.0, 0.0, 1.6, 1.4]}", table)


def from_the_cad(model, table):
    return model.replace('actuatorfrcrange="-0.93 0.93"', 'actuatorfrcrange="-100 100"'), table


def mirrored(model, table):
    return model, table.replace('name = "leap_like"', 'name = "leap_like"\nside = "left"')


FAR = r"fingertip nearest to centre is \d+ mm away, expected 60 mm at most"
WRONG = {
    turned_palm: (check_hand.check_frame, r"'index' points along .* of 'base' .* expected \+z"),
    mirrored: (check_hand.check_frame, r"the thumb is on the side of \+y, of a left hand expected -y"),
    opening: (check_hand.check_signs, "positive angles open thumb_mcp.*index_mcp.*negate"),
    no_grasp: (check_hand.check_reach, "hand 'leap_like' has no grasp: its TOML needs"),
    stretched: (check_hand.check_reach, FAR),
    behind: (check_hand.check_reach, FAR),
    closed: (check_hand.check_reach, "mm deep in a ball of 44 mm at centre: open the posture"),
    from_the_cad: (check_hand.check_limits, "'thumb_cmc' has a stall torque of 100 Nm, expected 0.02 to 5 Nm"),
}


@pytest.mark.parametrize("change", WRONG)
def test_a_convention_that_is_broken_is_named(change, tmp_path):
    """Hands that load, and whose physics runs, but whose grasps cannot be learnt."""
    source = asset_path("hand/leap_like/leap_like.toml").parent
    files = [tmp_path / "leap_like.xml", tmp_path / "leap_like.toml"]
    for file, text in zip(files, change(*((source / file.name).read_text() for file in files)), strict=True):
        file.write_text(text)
    check, said = WRONG[change]
    assert re.search(said, check(load_hand(files[1])))
