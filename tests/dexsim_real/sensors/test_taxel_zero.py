"""The zero of the taxels is followed where nothing touches, and no load is taken for it."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dexsim_real.sensors.hand import HandSensing, HardwareConfig
from dexsim_real.twin.plant.parameters import sample_trial
from dexsim_real.twin.plant.taxel_array import EmulatedTaxels
from dexsim_real.wire import frames

PATCH = np.array([40, 41, 42, 52, 53, 54, 64, 65, 66])  # three columns of three rows
RANGE = 15.0  # N of a fingertip
PERIOD = 0.5  # s between two answers


def state(counts=0):
    block = frames.empty_state()
    block["tip"]["taxel"]["z"] = counts
    return block


class WarmingHand:
    """The emulated hand's taxels and their wire in virtual time, with forces as asked for instead of contacts."""

    def __init__(self, hand):
        self.taxels, self._rng = EmulatedTaxels(hand), np.random.default_rng(3)
        self.taxels.configure(sample_trial("grasp", self._rng, "nominal"), self._rng)

    def answer(self, seconds, press):
        """A state with `press` N on the patch of the index, the middle and the ring."""
        force = np.zeros((5, 120, 3))
        force[1:4, PATCH, 2] = press / len(PATCH)
        shown = self.taxels.report(force, self._rng, seconds)[..., 2]
        return state(np.clip(np.round(shown / 0.1), 0, 255))


@pytest.mark.parametrize(("held", "free"), [(120.0, 60.0), (8.0, 4.0), (120.0, 12.0)])
def test_half_an_hour_of_warming_leaves_next_to_nothing(hand, held, free):
    """Holding 8 N in between: what is held must neither be followed nor stop all following."""
    errors = {}
    for track in (True, False):
        warming, sensing = WarmingHand(hand), HandSensing(hand, HardwareConfig(track_zero=track))
        sensing.set_tare([warming.answer(0.0, 0.0) for _ in range(30)])

        def read(seconds, press, sensing=sensing, warming=warming):
            return np.mean([sensing.measure(warming.answer(seconds, press)).finger_force for _ in range(30)], 0)

        fresh = np.stack([read(0.0, 8.0), read(0.0, 0.0)], 1)
        for time in np.arange(0.0, 1800.0, PERIOD):
            sensing.track_zero(time, warming.answer(time, 8.0 if time % (held + free) < held else 0.0))
        errors[track] = np.abs(np.stack([read(1800.0, 8.0), read(1800.0, 0.0)], 1) - fresh)
    assert errors[True][:, 1].max() <= 0.3 and errors[True].max() <= 0.05 * RANGE
    assert errors[False].min() > 0.05 * RANGE


def test_a_residue_after_a_release_is_found(hand):
    """20 taxels that read one count after 8 N: a zero that jumped comes back within minutes, not never."""
    sensing, residue = HandSensing(hand, HardwareConfig()), state()
    residue["tip"]["taxel"]["z"][1, 30:50] = 1
    loaded = state()
    loaded["tip"]["taxel"]["z"][1, 30:50] = 4
    for number in range(round(600 / PERIOD)):
        sensing.track_zero(number * PERIOD, loaded if number < 40 else residue)
    assert sensing.measure(residue).finger_force[1] <= 0.3


@given(st.integers(0, 4), st.integers(1, 40), st.integers(1, 400), st.lists(st.integers(0, 119), min_size=1))
def test_a_held_load_is_hidden_no_faster_than_zeros_wander(hand, finger, count, answers, taxels):
    """However light, long and spread a touch is: of 2 counts and 0.06 counts more each second."""
    sensing, loaded = HandSensing(hand, HardwareConfig()), state()
    loaded["tip"]["taxel"]["z"][finger, np.unique(np.clip(np.add.outer(taxels, [0, 1, 12]), 0, 119))] = count
    before = sensing.measure(loaded).finger_force
    for number in range(answers):
        sensing.track_zero(number * PERIOD, loaded)
        assert sensing.tare.sum() <= 2.0 + 0.06 * number * PERIOD + 1e-3
    if count > 1:
        np.testing.assert_array_equal(sensing.measure(loaded).finger_force, before)


def test_zeros_stay_within_the_limit_of_taring(hand):
    """A load that grows as slowly as a zero is hidden up to that limit, and no further."""
    sensing, reached = HandSensing(hand, HardwareConfig(tare_sum=10.0)), []
    for number in range(40 * 60):  # one more taxel every twenty seconds
        sensing.track_zero(number * PERIOD, state(np.arange(120) < number // 40))
        reached.append(sensing.tare.sum(1).max())
    assert max(reached) == pytest.approx(10.0, abs=0.1)
    assert np.all(sensing.measure(state(1)).finger_force >= 5.0)


def test_zeros_that_were_too_high_come_down(hand):
    """A fingertip that was tared with a load on it, and let go."""
    loaded, sensing = state(), HandSensing(hand, HardwareConfig())
    loaded["tip"]["taxel"]["z"][2, PATCH] = 3
    sensing.set_tare([loaded])
    changed = [sensing.track_zero(number * PERIOD, state()) for number in range(41)]
    assert sum(changed) == 1 and not sensing.tare.any()


def test_stuck_taxels_stay_masked(hand):
    stuck, sensing = state(), HandSensing(hand, HardwareConfig())
    stuck["tip"]["taxel"]["z"][2, 17] = 255
    sensing.set_tare([stuck])
    for number in range(100):
        sensing.track_zero(number * PERIOD, stuck)
    assert np.isinf(sensing.tare[2, 17]) and np.isfinite(sensing.tare).sum() == 599
