"""The contract of a hand's files."""

import shutil

import numpy as np
import pytest

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


def test_wrong_link_is_named(folder):
    hand = load_hand(folder / "xhand_right.toml")
    hand.body_position[-1, 0] += np.float32(0.001)
    with pytest.raises(AssetError, match=r"right_hand_pinky_link2.* is 1 mm"):
        check_hand.check_kinematics(hand)


def test_tip_without_primitive_fails(folder, capsys):
    model = folder / "xhand_right.xml"
    model.write_text(model.read_text().replace('name="index_pad" class="pad"', 'name="index_pad" class="shell"'))
    assert check_hand.main([str(folder / "xhand_right.toml")]) == 1
    out = capsys.readouterr().out
    assert "FAIL  fingertips touch" in out and "finger 'index'" in out


def test_hand_without_a_grasp_fails(folder, capsys):
    table = folder / "xhand_right.toml"
    text = table.read_text()
    table.write_text(text[: text.index("[grasp]")] + text[text.index("[[fingers]]") :])
    assert check_hand.main([str(table)]) == 1
    out = capsys.readouterr().out
    assert "FAIL  random actions stay finite: hand 'xhand_right' has no grasp" in out


def test_missing_file_is_one_line(tmp_path, capsys):
    assert check_hand.main([str(tmp_path / "none.toml")]) == 1
    assert capsys.readouterr().out.count("\n") == 1


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
