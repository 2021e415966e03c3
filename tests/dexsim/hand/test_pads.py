"""Taxels laid by the TOML's lattice: on the pad, outward, about the direction that it faces; and what is refused."""

import shutil

import numpy as np
import pytest

from dexsim.core.assets import asset_path
from dexsim.core.errors import AssetError
from dexsim.hand.load import load_hand


@pytest.fixture
def folder(tmp_path):
    shutil.copytree(asset_path("hand/leap_like"), tmp_path, dirs_exist_ok=True)
    return tmp_path


def test_taxels_are_on_the_pads_and_face_as_told():
    hand = load_hand("leap_like")
    assert hand.taxel_position.shape == (4, 48, 3)
    for finger, facing in enumerate([(0, 0, 1), (1, 0, 0), (1, 0, 0), (1, 0, 0)]):
        pad = next(g for g in hand.geoms if g.name == f"{hand.finger_names[finger]}_pad")
        local = (hand.taxel_position[finger] - pad.position) @ pad.rotation
        axis = np.clip(local[:, 2], -pad.size[1], pad.size[1])
        out = local - axis[:, None] * [0, 0, 1]
        np.testing.assert_allclose(np.linalg.norm(out, axis=1), pad.size[0], atol=1e-6)
        np.testing.assert_allclose(hand.taxel_normal[finger] @ pad.rotation, out / pad.size[0], atol=1e-4)
        middle = hand.taxel_normal[finger].mean(0)
        assert middle @ facing / np.linalg.norm(middle) > 0.999
        # 6 x 8 cells of 3.5 mm, of which those over the round end are smaller.
        assert 0.95 < hand.taxel_area[finger].sum() / (48 * 0.0035**2) <= 1 + 1e-6


REFUSED = {
    "no pitch": ("taxel_pitch = [0.0035, 0.0035]\n", "", "either taxels"),
    "no such pad": ('pad = "index_pad"', 'pad = "palm"', "finger 'index': pad = 'palm'"),
    "along the pad": ("facing = [0, 0, 1]", "facing = [0, 1, 0]", "across the pad 'thumb_pad'"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_refused_in_one_line(folder, case):
    old, new, words = REFUSED[case]
    path = folder / "leap_like.toml"
    assert path.read_text().count(old) == 1
    path.write_text(path.read_text().replace(old, new))
    with pytest.raises(AssetError, match=words) as error:
        load_hand(path)
    assert "\n" not in str(error.value) and "leap_like.toml" in str(error.value)
