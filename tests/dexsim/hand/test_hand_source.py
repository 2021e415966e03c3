"""Policies, runs and logs keep to the hand that they are of."""

import dataclasses
import shutil
from pathlib import Path

import mujoco
import pytest

from dexsim.core.assets import asset_path
from dexsim.errors import AssetError, ConfigError, OtherEnvWarning
from dexsim.hand.load import load_hand
from dexsim.hand.mirror import is_mirror_image, write_mirror
from dexsim.hand.source import check_same, record_of, recorded_hand
from dexsim_ppo.checkpoint import Checkpoint
from dexsim_ppo.policy import load_policy
from dexsim_ppo.train import default_arguments, find_hand


@pytest.fixture
def own(tmp_path, monkeypatch):
    shutil.copytree(asset_path("hand/xhand_right.toml").parent, tmp_path / "own")
    monkeypatch.chdir(tmp_path)
    return "own/xhand_right.toml"


def replace(path, old, new):
    text = Path(path).read_text()
    assert old in text
    Path(path).write_text(text.replace(old, new))


def heavier(path):
    replace(path.replace(".toml", ".xml"), 'mass="0.538515"', 'mass="0.6"')


def test_default_hand_has_no_record(hand):
    assert record_of(hand) is None and recorded_hand(None, "", "x") is None
    assert load_hand("xhand_right").source == hand.source == "xhand_right"
    with pytest.raises(AssetError, match="hand 'nohand': no such file, and no shipped hand has that name"):
        load_hand("nohand")


def test_what_a_hand_includes_is_in_its_hash_and_its_mirror_image(own, tmp_path):
    """MuJoCo finds included files beside the model, or beside the file that includes them."""
    own = Path(own).resolve()  # MuJoCo misses the file of a file where the model's path is relative
    folder = own.parent
    (folder / "parts").mkdir()
    replace(folder / "xhand_right.xml", "<worldbody>", "<include file='parts/a.xml'/><worldbody>")
    for place in (folder / "parts/b.xml", folder / "b.xml"):
        (folder / "parts/a.xml").write_text("<mujoco><include file='b.xml'/></mujoco>")
        place.write_text("<mujoco><custom><numeric name='x' data='1'/></custom></mujoco>")
        before = load_hand(own).digest
        place.write_text("<mujoco><custom><numeric name='x' data='2'/></custom></mujoco>")
        assert load_hand(own).digest != before
    replace(own, "name =", "# no <include in a TOML\nname =")
    image = load_hand(write_mirror(own, tmp_path / "left"))
    assert mujoco.MjModel.from_xml_path(str(image.model_path)).numeric("x").data == 2
    assert is_mirror_image(image, load_hand(own))


def test_policy_carries_its_hand(own, tmp_path):
    record = record_of(load_hand(own))
    dataclasses.replace(load_policy("grasp"), hand=record).save("policy.msgpack")
    policy = load_policy("policy.msgpack")
    assert policy.hand == record and policy.find_hand().digest == record["digest"]
    assert load_policy("grasp").hand is None and load_policy("grasp").find_hand() is None
    shutil.move("own", "elsewhere")
    with pytest.raises(ConfigError, match=r"the TOML of its hand 'own/xhand_right.toml' is missing: give --hand"):
        policy.find_hand()
    assert policy.find_hand("elsewhere/xhand_right.toml").digest == record["digest"]


def test_the_record_of_a_hand_opens_no_other_file(tmp_path, monkeypatch):
    """A policy's file may be anybody's: of the files here it may name the TOML of a hand."""
    monkeypatch.setattr("dexsim.hand.source.load_hand", lambda *_: pytest.fail("it was opened"))
    (tmp_path / "secret").write_text("a = 1")
    record = {"digest": "", "joints": [], "fingers": [], "taxels": 1}
    for file in (tmp_path / "secret", tmp_path, tmp_path / "none.toml", "/dev/zero"):
        with pytest.raises(ConfigError, match="is missing: give --hand FILE"):
            recorded_hand(record | {"file": str(file)}, None, "policy.msgpack")


def test_changed_files_are_refused_or_warned_of(own):
    policy = dataclasses.replace(load_policy("grasp"), hand=record_of(load_hand(own)))
    heavier(own)
    with pytest.raises(ConfigError, match="its files have changed since"):
        policy.find_hand()
    with pytest.warns(OtherEnvWarning, match="is used on 'own/xhand_right.toml'"):
        policy.find_hand(own)
    check_same(policy.hand, load_hand(), "the policy")  # of a copy of the same files
    with pytest.raises(ConfigError, match="got 'leap_like'"):
        check_same(policy.hand, load_hand("leap_like"), "the policy")


def test_run_keeps_its_hand(own, tmp_path):
    arguments = dataclasses.replace(default_arguments("grasp", "cpu", None), hand=own)
    hand = find_hand(arguments, None)
    begun = Checkpoint(tmp_path / "run", "grasp", {"hand": record_of(hand)}, {})
    assert find_hand(arguments, begun).digest == hand.digest
    fine = dataclasses.replace(load_policy("grasp"), hand=record_of(hand))
    assert default_arguments(None, "cpu", fine).hand == own
    heavier(own)
    with pytest.warns(OtherEnvWarning), pytest.raises(ConfigError, match="changed since"):
        find_hand(arguments, begun)
    with pytest.raises(ConfigError, match="expected the hand"):
        check_same(None, load_hand(own), "the log")
