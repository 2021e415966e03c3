"""Deadlines: kept, skipped, and in phase with the policy's."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dexsim_real.loop import GRACE, LoopThread, Pace, keep_phase
from dexsim_real.sensors.hand import HandSensing, HardwareConfig

CYCLE = 0.012


@pytest.mark.parametrize(
    ("rate", "policy", "expected"),
    [(83.0, 100 / 3, 250 / 3), (83.0, 25.0, 83.0), (99.5, 25.0, 100.0), (40.0, 1000.0, 40.0), (12.4, 25.0, 12.5)],
)
def test_exchanges_keep_their_phase_with_the_policy(rate, policy, expected):
    kept = keep_phase(rate, policy)
    assert kept == pytest.approx(expected)
    if kept != rate:  # At the policy's deadlines an exchange is in one of at most two phases.
        phases = np.arange(40) / policy * kept % 1
        assert len({round(float(phase), 3) % 1 for phase in phases}) <= 2


@given(st.lists(st.one_of(st.floats(0.0, 0.05), st.floats(0.0119, 0.0132)), min_size=1, max_size=60))
def test_a_cycle_begins_at_a_deadline_or_a_little_after_and_skips_what_is_past(durations):
    clock = [0.0]

    def sleep(seconds):
        clock[0] += seconds

    pace, last, missed = Pace(250 / 3, lambda: clock[0], sleep), 0, 0
    for duration in durations:
        clock[0] += duration
        at = clock[0]
        # The first deadline after the last one that is still to come, or has passed by the grace at most.
        index = last + 1
        while at > index * CYCLE + GRACE:
            index += 1
        if abs(at - index * CYCLE - GRACE) < 1e-9 or abs(at - (index - 1) * CYCLE - GRACE) < 1e-9:
            return  # On the brink: rounding decides.
        pace.wait()
        assert clock[0] == pytest.approx(max(at, index * CYCLE), abs=1e-9)
        missed, last = missed + index - last - 1, index
        assert pace.jitter.missed == missed and pace.jitter.worst <= GRACE + 1e-9
    assert pace.jitter.count == len(durations)


def test_the_policy_begins_while_the_line_is_busy(hand):
    loop = LoopThread(None, HandSensing(hand, HardwareConfig()), None, 250 / 3)
    for now in np.linspace(0, 0.2, 41) + loop.pace.next - 0.05:
        begin = loop.free(now)
        assert now <= begin < now + loop.pace.period + 1e-9
        assert (begin - loop.pace.next) % loop.pace.period == pytest.approx(0.001, abs=1e-6)
