"""Taring refuses a load, and taxels that are stuck are masked: at the start, and when they get stuck in a run."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dexsim_real.core.errors import HandError
from dexsim_real.sensors.hand import HandSensing, HardwareConfig
from dexsim_real.wire import frames

PATCH = [40, 41, 42, 52, 53, 54, 64, 65, 66]  # three columns of three rows


def state(counts=0):
    block = frames.empty_state()
    block["tip"]["taxel"]["z"] = counts
    return block


@pytest.fixture
def sensing(hand):
    return HandSensing(hand, HardwareConfig())


def test_a_load_spread_over_many_taxels_is_not_tared(sensing):
    """12 N: no taxel reads more than 14 counts, a third of what one may have at rest."""
    loaded = state()
    loaded["tip"]["taxel"]["z"][1, PATCH] = 14
    with pytest.raises(
        HandError, match="those of the index read 126 counts together, limit 50: .* free the fingertips"
    ):
        sensing.set_tare([loaded] * 5)
    assert not sensing.tare.any()
    loaded["tip"]["taxel"]["z"][1, PATCH] = 5
    assert sensing.set_tare([loaded] * 5) == [] and sensing.tare.sum() == 45


@given(st.lists(st.integers(0, 119), min_size=1, max_size=40, unique=True), st.integers(1, 40), st.integers(0, 4))
def test_taring_hides_no_more_than_the_limit(hand, taxels, count, finger):
    """Whatever patch is loaded, with whatever force: what is tared away is at most 5 N, single taxels apart."""
    sensing, loaded = HandSensing(hand, HardwareConfig()), state()
    patch = np.unique(np.clip(np.add.outer(taxels, [0, 1, 12]), 0, 119))  # Nobody touches a single taxel.
    loaded["tip"]["taxel"]["z"][finger, patch] = count
    try:
        sensing.set_tare([loaded])
    except HandError:
        assert not sensing.tare.any()
    else:
        assert sensing.tare.sum() <= 50


def test_a_taxel_that_is_stuck_at_the_start_is_masked_by_name(sensing):
    stuck = state()
    stuck["tip"]["taxel"]["z"][2, 17] = 255
    stuck["tip"]["taxel"]["z"][4, [0, 60]] = 200
    assert sensing.set_tare([stuck] * 5) == [
        "middle: stuck and read as 0 from now on: taxel column 1 row 5",
        "pinky: stuck and read as 0 from now on: taxel column 0 row 0, column 5 row 0",
    ]
    stuck["tip"]["taxel"]["z"][2, PATCH] = 10
    measured = sensing.measure(stuck)
    np.testing.assert_allclose(measured.finger_force, [0, 0, 9, 0, 0], atol=1e-5)
    assert measured.finite()


def test_a_fingertip_of_stuck_taxels_is_refused(sensing):
    stuck = state()
    stuck["tip"]["taxel"]["z"][2, 0:120:16] = 255
    with pytest.raises(HandError, match="middle: 8 taxels are stuck: column 0 row 0, .* and 2 more; power-cycle"):
        sensing.set_tare([stuck])


def follow(sensing, blocks, limit=15.0):
    """The number of answers until something is masked, and the lines about it."""
    for number, block in enumerate(blocks):
        if lines := sensing.mask_stuck(block, limit):
            return number, lines
    return None, []


def test_a_taxel_that_gets_stuck_is_masked_within_a_third_of_a_second(sensing):
    rng, blocks = np.random.default_rng(0), []
    for _ in range(40):
        block = state(rng.integers(0, 2, (5, 120)))
        block["tip"]["taxel"]["z"][3, 77] = 255 - rng.integers(0, 2)
        block["tip"]["taxel"]["z"][0, PATCH] = 12
        blocks.append(block)
    number, lines = follow(sensing, blocks)
    assert number < 0.33 * 83 and lines == ["ring: stuck and read as 0 from now on: taxel column 6 row 5"]
    force = sensing.measure(blocks[-1]).finger_force
    assert force[0] > 10 and force[3] < 10


@pytest.mark.parametrize(
    "what", ["a press", "a changing load", "a load that eases a count at a time", "below the limit", "for a moment"]
)
def test_what_is_not_stuck_is_not_masked(sensing, what):
    blocks = []
    for k in range(60):
        block = state()
        taxel = block["tip"]["taxel"]["z"]
        loads = {"a changing load": 160 + 3 * (k % 30), "a load that eases a count at a time": 220 - k}
        taxel[3, 77] = (loads | {"below the limit": 149}).get(what, 200)
        if what == "a press":
            taxel[3, [76, 78, 65, 89]] = 40
        if what == "for a moment" and k % 15 == 0:
            taxel[3, 77] = 0
        blocks.append(block)
    assert follow(sensing, blocks) == (None, [])
