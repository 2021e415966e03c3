"""The contract of a hand's files."""

import re
import shutil

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dexsim import check_hand
from dexsim.core.assets import asset_path
from dexsim.core.errors import AssetError
from dexsim.hand.load import load_hand


@pytest.fixture
def folder(tmp_path):
    shutil.copytree(asset_path("hand/xhand_right.toml").parent, tmp_path, dirs_exist_ok=True)
    return tmp_path


def test_shipped_hand_passes(capsys):
    assert check_hand.main([str(asset_path("hand/xhand_right.toml"))]) == 0
    out = capsys.readouterr().out
    assert "thumb_bend        0.00 to  1.83         1.10             8.63" in out  # of the published table
    assert "self-collision: 8 pairs" in out
    assert "12 joints, 5 fingers of 120 taxels" in out and out.count("ok  ") == 5 and "FAIL" not in out


@pytest.mark.parametrize("says", ["is 0.001 m from", "is 0.01 rad turned"])
def test_a_link_that_is_elsewhere_or_turned_is_named(folder, says):
    """The last link: no other is displaced by it."""
    hand = load_hand(folder / "xhand_right.toml")
    if "turned" in says:
        hand.body_rotation[-1] = hand.body_rotation[-1] @ Rotation.from_euler("x", 0.01).as_matrix()
    else:
        hand.body_position[-1, 0] += np.float32(0.001)
    with pytest.raises(AssetError, match=f"right_hand_pinky_link2.* {says}"):
        check_hand.check_kinematics(hand)


def scaled(factor):
    """Positions of another unit."""
    return lambda line: [*line[:3], *(f"{factor * float(x):.6g}" for x in line[3:6]), *line[6:]]


def lifted(line):
    """Positions in a frame whose origin is elsewhere."""
    return [*line[:5], f"{float(line[5]) + 0.18:.6g}", *line[6:]]


def inward(line):
    return [*line[:6], *(f"{-float(x):.6g}" for x in line[6:9]), line[9]]


# What is changed in the MJCF, the TOML or the lines of the taxel file; the check that fails, and what it says.
BROKEN = {
    "no inertia": ("xml", '<inertial mass="0.0158240"', '<inertial mass="0"', "files load", "mass"),
    "tip twice": ("toml", 'tip = "ring_tip"', 'tip = "mid_tip"', "files load", "'mid_tip' is on .* as another"),
    "millimetres": ("csv", scaled(1e3), None, "taxels are on the skin", r"mm away from its link: metres, in"),
    "frame": ("csv", lifted, None, "taxels are on the skin", r"'thumb': taxel .* mm away from its link"),
    "normals": ("csv", inward, None, "taxels are on the skin", r"faces into its link: .*120 of 120"),
}  # fmt: skip


@pytest.mark.parametrize("name", BROKEN)
def test_broken_files_are_one_clear_line(name, folder, capsys, monkeypatch):
    monkeypatch.delitem(check_hand.CHECKS, "random actions stay finite")  # it takes seconds
    kind, old, new, check, said = BROKEN[name]
    path = folder / {"xml": "xhand_right.xml", "toml": "xhand_right.toml", "csv": "taxels.csv"}[kind]
    lines = path.read_text().splitlines()
    if kind == "csv":
        lines = [lines[0], *(",".join(old(line.split(","))) for line in lines[1:])]
    else:
        assert any(old in line for line in lines)
        lines = [line.replace(old, new) for line in lines]
    path.write_text("\n".join(lines))
    assert check_hand.main([str(folder / "xhand_right.toml")]) == 1
    failed = [line for line in capsys.readouterr().out.splitlines() if line.startswith("FAIL")]
    assert len(failed) == 1 and failed[0].startswith(f"FAIL  {check}: ") and re.search(said, failed[0]), failed


def test_mesh_that_touches_is_refused(folder, capsys, monkeypatch):
    monkeypatch.delitem(check_hand.CHECKS, "random actions stay finite")  # takes seconds
    model, corners = folder / "xhand_right.xml", "0 0 0  0.01 0 0  0 0.01 0  0 0 0.01"
    text = model.read_text().replace("<worldbody>", f'<asset><mesh name="hull" vertex="{corners}"/></asset><worldbody>')
    site, mesh = '<site name="index_tip"', '<geom name="index_hull" class="{}" type="mesh" mesh="hull"/>'
    for kind, code in (("shell", 0), ("pad", 1)):
        model.write_text(text.replace(site, mesh.format(kind) + site))
        assert check_hand.main([str(folder / "xhand_right.toml")]) == code
    out = capsys.readouterr().out
    assert "FAIL  files load" in out and "geom 'index_hull' of 'right_hand_index_rota_link2' is no primitive" in out
