"""From the hand's counts to SI units: signs, scales, tare; taxels that are stuck, and zeros that wander."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given, strategies as st

from dexsim.observation import GRASP, ROTATE, ROTATE_CRITIC
from dexsim_real.control.controller import sources_of
from dexsim_real.core.errors import HandError
from dexsim_real.sensors.hand import HandSensing, HardwareConfig
from dexsim_real.twin.virtual import ideal_calibration
from dexsim_real.wire import frames
from dexsim_real.wire.frames import Mode


def state(counts=0, **joint):
    block = frames.empty_state()
    block["tip"]["taxel"]["z"] = counts
    for name, value in joint.items():
        block["joint"][name] = value
    return block


def test_a_relaxed_command_carries_no_gain(hand):
    block = HandSensing(hand, HardwareConfig()).command(np.zeros(12), Mode.PASSIVE)
    for name in ("kp", "ki", "kd", "torque_max", "mode"):
        assert not block[name].any()
    on = HandSensing(hand, HardwareConfig(torque_max=250)).command(np.zeros(12), Mode.POSITION)
    assert set(on["torque_max"].tolist()) == {250} and set(on["kp"].tolist()) == {100}


def test_taxels_are_tared_and_scaled(hand):
    sensing = HandSensing(hand, HardwareConfig(force_per_count=0.1, taxel_floor=1.0, tare_sum=1000.0))
    rest = state()
    rest["tip"]["taxel"]["z"] = np.arange(120) % 7
    other = rest.copy()
    other["tip"]["taxel"]["z"] += 2
    sensing.set_tare([rest, other])  # Mean: 1 above rest.
    pressed = rest.copy()
    pressed["tip"]["taxel"]["z"][2, 17] += 31
    pressed["tip"]["taxel"]["x"][2, 17] = -100  # Does not count with "z".
    force = sensing.measure(pressed).taxel_force
    expected = np.zeros((5, 120))
    expected[2, 17] = 3.0
    np.testing.assert_allclose(force, expected, atol=1e-6)
    np.testing.assert_allclose(sensing.measure(pressed).finger_force, expected.sum(1), atol=1e-6)
    norm = HandSensing(hand, HardwareConfig(taxel_axes="norm"))
    block = state()
    block["tip"]["taxel"][4, 119] = (-3, 4, 12)
    assert norm.measure(block).taxel_force[4, 119] == pytest.approx(1.3)


def test_current_without_and_with_a_calibration(hand):
    counts = np.linspace(-900, 900, 12).astype(np.int16)
    plain = HandSensing(hand, HardwareConfig(current_scale=1500.0))  # A positive current opens.
    np.testing.assert_allclose(plain.measure(state(current=counts)).joint_torque, counts / -1500.0, atol=1e-6)
    np.testing.assert_allclose(plain.measure(state(current=counts)).current, np.abs(counts) / 1000.0, atol=1e-6)

    # current = -0.05 F - 0.02 A and torque = 0.04 F Nm, so torque = -0.8 (current + 0.02).
    calibration, pair = ideal_calibration(hand), np.ones((2, 12))
    real = dataclasses.replace(calibration.real, gain=-0.05 * pair, offset=-0.02 * pair)
    sim = dataclasses.replace(calibration.sim, gain=0.04 * pair)
    calibration = dataclasses.replace(calibration, real=real, sim=sim, force_per_count=np.full(5, 0.2))
    sensing = HandSensing(hand, HardwareConfig(), calibration)
    block = state(current=counts)
    block["tip"]["taxel"]["z"][0, 0] = 10
    measured = sensing.measure(block)
    np.testing.assert_allclose(measured.joint_torque, -0.8 * (counts / 1000 + 0.02) / hand.torque_limit, atol=2e-6)
    assert measured.taxel_force[0, 0] == pytest.approx(2.0)


def test_who_measures_what():
    assert sources_of(GRASP) == {"hand", "camera", "user"}
    assert sources_of(ROTATE) == {"hand", "imu", "policy"}
    assert "imu" not in sources_of(("palm_gravity",)), "without one the mount's nominal direction counts"
    with pytest.raises(HandError, match="no sensor measures"):
        sources_of(ROTATE_CRITIC)


PATCH = np.array([40, 41, 42, 52, 53, 54, 64, 65, 66])  # three columns of three rows
RING = [64, 65, 66, 76, 78, 88, 89, 90]  # around taxel 77
LIMIT = 15.0  # N of a fingertip
PERIOD = 0.5  # s between two answers


@pytest.fixture
def sensing(hand):
    return HandSensing(hand, HardwareConfig())


def follow(sensing, blocks, period=PERIOD):
    """Number of the first answer that changes the tare, None if none does, and all lines."""
    first, told = None, []
    for number, block in enumerate(blocks):
        changed, lines = sensing.follow_taxels(number * period, block, LIMIT)
        first = number if changed and first is None else first
        told += lines
    return first, told


# --- taring ----------------------------------------------------------------------------------------


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
    stuck["tip"]["taxel"]["z"][4, [0, 1, 60]] = 200  # Two are adjacent; three would be a touch.
    assert sensing.set_tare([stuck] * 5) == [
        "middle: stuck and read as 0 from now on: taxel column 1 row 5",
        "pinky: stuck and read as 0 from now on: taxel column 0 row 0, column 0 row 1, column 5 row 0",
    ]
    follow(sensing, [stuck] * 100)
    assert np.isinf(sensing.tare[2, 17]) and np.isinf(sensing.tare).sum() == 4, "also while zeros are followed"
    stuck["tip"]["taxel"]["z"][2, PATCH] = 10
    measured = sensing.measure(stuck)
    np.testing.assert_allclose(measured.finger_force, [0, 0, 9, 0, 0], atol=1e-5)
    stuck["tip"]["taxel"]["z"][2] = np.where(np.arange(120) % 16 == 0, 255, 0)
    with pytest.raises(HandError, match="middle: 8 taxels are stuck: column 0 row 0, .* and 2 more; power-cycle"):
        sensing.set_tare([stuck])


# --- taxels that get stuck -------------------------------------------------------------------------


def test_a_taxel_that_gets_stuck_is_masked_within_a_third_of_a_second(sensing):
    rng, blocks = np.random.default_rng(0), []
    for _ in range(40):
        block = state(rng.integers(0, 2, (5, 120)))
        block["tip"]["taxel"]["z"][3, 77] = 255 - rng.integers(0, 2)
        block["tip"]["taxel"]["z"][0, PATCH] = 12
        blocks.append(block)
    number, lines = follow(sensing, blocks, 0.012)
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
    assert follow(sensing, blocks, 0.012) == (None, [])


def test_a_taxel_that_stays_when_the_load_goes_is_stuck(sensing):
    pressed, free = state(), state()
    pressed["tip"]["taxel"]["z"][3, RING] = 24
    for block in (pressed, free):
        block["tip"]["taxel"]["z"][3, 77] = 255
    number, lines = follow(sensing, [pressed] * 40 + [free] * 40, 0.012)
    assert 40 <= number < 65 and lines == ["ring: stuck and read as 0 from now on: taxel column 6 row 5"]


def test_a_saturated_fingertip_is_not_masked_but_ends_the_run(sensing):
    blind = state()
    blind["tip"]["taxel"]["z"][1] = 255
    with pytest.raises(HandError, match="index: 120 taxels are stuck: .* and 114 more; power-cycle the hand"):
        follow(sensing, [blind] * 40, 0.012)


# --- zeros that wander -----------------------------------------------------------------------------


@pytest.mark.parametrize(("held", "free"), [(120.0, 12.0), (8.0, 4.0)])
def test_half_an_hour_of_warming_leaves_next_to_nothing(sensing, held, free):
    """Holding 8 N in between: what is held must neither be followed nor stop all following."""
    rng, load = np.random.default_rng(3), np.zeros((5, 120))
    wander, load[1:4, PATCH] = rng.normal(0, 0.5, (5, 120)), 80 / len(PATCH)

    def answer(seconds, pressed):
        zero = wander * (1 - np.exp(-seconds / 600)) + 0.15 * rng.standard_normal(wander.shape)
        return state(np.clip(np.round(zero + load * pressed), 0, 255))

    def read(seconds):
        return np.mean([sensing.measure(answer(seconds, pressed)).finger_force for pressed in (0, 1) * 15], 0)

    fresh = read(0.0)
    for time in np.arange(0.0, 1800.0, 2 * PERIOD):
        sensing.follow_taxels(time, answer(time, time % (held + free) < held), LIMIT)
    assert np.abs(read(1800.0) - fresh).max() <= 0.5
    sensing.tare = 0 * sensing.tare
    assert np.abs(read(1800.0) - fresh).min() > 1.0


def test_a_zero_that_has_moved_far_is_told_once(sensing):
    sensing.set_tare([state()])
    _, told = follow(sensing, [state(np.arange(120) < 35)] * 1200)
    assert len(told) == 5 and all("its zero has moved by 3" in line for line in told)


@given(st.integers(0, 4), st.integers(1, 40), st.integers(1, 400), st.lists(st.integers(0, 119), min_size=1))
def test_a_held_load_is_hidden_no_faster_than_zeros_wander(hand, finger, count, answers, taxels):
    """However light, long and spread a touch is: of 2 counts and 0.06 counts more each second."""
    sensing, loaded = HandSensing(hand, HardwareConfig()), state()
    loaded["tip"]["taxel"]["z"][finger, np.unique(np.clip(np.add.outer(taxels, [0, 1, 12]), 0, 119))] = count
    before = sensing.measure(loaded).finger_force
    for number in range(answers):
        sensing.follow_taxels(number * PERIOD, loaded, LIMIT)
        assert sensing.tare.sum() <= 2.0 + 0.06 * number * PERIOD + 1e-3
    if count > 1:
        np.testing.assert_array_equal(sensing.measure(loaded).finger_force, before)


def test_zeros_stay_within_the_limit_of_taring(hand):
    """A load that grows as slowly as a zero is hidden up to that limit, and no further."""
    sensing, reached = HandSensing(hand, HardwareConfig(tare_sum=10.0)), []
    for number in range(40 * 60):  # one more taxel every twenty seconds
        sensing.follow_taxels(number * PERIOD, state(np.arange(120) < number // 40), LIMIT)
        reached.append(sensing.tare.sum(1).max())
    assert max(reached) == pytest.approx(10.0, abs=0.1)
    assert np.all(sensing.measure(state(1)).finger_force >= 5.0)


def test_zeros_that_were_too_high_come_down(sensing):
    """A fingertip that was tared with a load on it, and let go."""
    loaded = state()
    loaded["tip"]["taxel"]["z"][2, PATCH] = 3
    sensing.set_tare([loaded])
    changed = [sensing.follow_taxels(number * PERIOD, state(), LIMIT)[0] for number in range(41)]
    assert sum(changed) == 1 and not sensing.tare.any()
