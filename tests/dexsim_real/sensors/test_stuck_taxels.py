"""Taring refuses a load, and taxels that are stuck are masked: at the start, and when they get stuck in a run."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dexsim_real.core.errors import HandError
from dexsim_real.sensors.hand import HandSensing, HardwareConfig
from dexsim_real.wire import frames

PATCH = [40, 41, 42, 52, 53, 54, 64, 65, 66]  # three columns of three rows
RING = [64, 65, 66, 76, 78, 88, 89, 90]  # around taxel 77


def state(counts=0):
    block = frames.empty_state()
    block["tip"]["taxel"]["z"] = counts
    return block


@pytest.fixture
def sensing(hand):
    return HandSensing(hand, HardwareConfig())


@given(st.lists(st.integers(0, 119), min_size=1, max_size=40, unique=True), st.integers(1, 40), st.integers(0, 4))
def test_taring_hides_no_more_than_the_limit(hand, taxels, count, finger):
    """Whatever taxels are loaded, isolated ones too, with whatever force: what is tared away is at most 5 N."""
    sensing, loaded = HandSensing(hand, HardwareConfig()), state()
    loaded["tip"]["taxel"]["z"][finger, taxels] = count
    try:
        sensing.set_tare([loaded])
    except HandError as error:
        assert "counts together, limit 50" in str(error) and not sensing.tare.any()
    else:
        assert sensing.tare.sum() == count * len(taxels) <= 50


def test_stuck_taxels_are_masked_by_name_at_the_start(sensing):
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
    stuck["tip"]["taxel"]["z"][2] = np.where(np.arange(120) % 16 == 0, 255, 0)
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
    "what",
    ["a press", "saturated", "a changing load", "a load that eases a count at a time", "below the limit", "a moment"],
)
def test_what_is_not_stuck_is_not_masked(sensing, what):
    blocks = []
    for k in range(60):
        block = state()
        taxel = block["tip"]["taxel"]["z"]
        loads = {"a changing load": 160 + 3 * (k % 30), "a load that eases a count at a time": 220 - k}
        taxel[3, 77] = (loads | {"below the limit": 149, "saturated": 255}).get(what, 200)
        if what in ("a press", "saturated"):
            taxel[3, RING] = 40 if what == "a press" else 24  # 255 reads as 25.5 N, the ring as 2.4 N each
        if what == "a moment" and k % 15 == 0:
            taxel[3, 77] = 0
        blocks.append(block)
    assert follow(sensing, blocks) == (None, [])


def test_a_taxel_that_stays_when_the_load_goes_is_stuck(sensing):
    pressed, free = state(), state()
    pressed["tip"]["taxel"]["z"][3, RING] = 24
    for block in (pressed, free):
        block["tip"]["taxel"]["z"][3, 77] = 255
    number, lines = follow(sensing, [pressed] * 40 + [free] * 40)
    assert 40 <= number < 65 and lines == ["ring: stuck and read as 0 from now on: taxel column 6 row 5"]
