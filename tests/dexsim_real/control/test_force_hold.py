"""Holds for too much force, judged by the true angles: the hand eases a little, and its motors go off after seconds."""

import numpy as np
import pytest
from test_safety import CYCLE, MIDDLE, ready, sample
from test_starts import Hands

from dexsim_real.control.limits import SafetyConfig
from dexsim_real.control.safety import Safety

JOINT = np.arange(12) == 4


STEADY = lambda k: 30.0  # noqa: E731
CASES = {  # by how many rad the joint reads too high, and N of each fingertip, by the number of the cycle
    "reads high": (lambda k: 0.02, STEADY),
    "reads low": (lambda k: -0.02, lambda k: 30.0 * (k % 5 > 0)),
    "in pauses": (lambda k: 0.02, lambda k: 30.0 * (k % 40 > 2)),
    "wrong at first": (lambda k: -0.22 * (k < 1), STEADY),
    "wrong twice": (lambda k: 0.22 * (k < 2), STEADY),
    "outside": (lambda k: 9.0 * (k == 3), STEADY),
    "far": (lambda k: 0.2, STEADY),
}


@pytest.fixture(scope="module")
def held(hand):
    """By the name of a case: true angle [T] rad of the joint less its first, whether [T] its motor is on, `Safety`."""
    hands, safeties = Hands(hand, len(CASES)), [Safety(hand, SafetyConfig()) for _ in CASES]
    path, was_on = [], []
    for safety in safeties:
        safety.engage()
    for k in range(-round(2.0 / CYCLE), round(9.0 / CYCLE)):
        decisions = []
        for angle, safety, (error, force) in zip(hands.angle, safeties, CASES.values(), strict=True):
            reading = angle + (error(k) if k >= 0 else 0.0) * JOINT
            safety.update(sample(hands.time, reading, force=force(k) if k >= 0 else 0.0))
            safety.set_target(MIDDLE, hands.time)
            decisions.append(safety.decide(hands.time))
        position, on, stiffness = (
            np.array([getattr(decision, name) for decision in decisions]) for name in ("position", "mode", "stiffness")
        )
        hands.cycle(position, on != 0, stiffness)
        if k >= 0:
            path.append(hands.angle[:, 4].copy())
            was_on.append(on != 0)
    moved = np.array(path) - path[0]
    return dict(zip(CASES, zip(moved.T, np.array(was_on).T, safeties, strict=True), strict=True))


@pytest.mark.parametrize("case", ["reads high", "reads low", "in pauses"])
def test_a_joint_that_reads_wrong_does_not_creep_to_its_stop(held, case):
    """Also where the force falls below its limit for a moment: every new hold could ease by the error again."""
    path, on, safety = held[case]
    assert np.abs(path).max() < 0.13
    assert 4.9 <= on.sum() * CYCLE < 8.0 and not on[-1]
    assert safety.latched == "the fingertip force is too high for 5 s"


@pytest.mark.parametrize("case", ["wrong at first", "wrong twice"])
def test_a_wrong_angle_as_a_hold_begins_is_not_eased_to(held, case):
    path, _, safety = held[case]
    assert safety.counts["implausible: measurement"] == 0, "small enough to be believed"
    assert np.abs(path[: round(3.0 / CYCLE)]).max() < 0.01


def test_a_reading_outside_the_limits_leaves_a_hold_at_its_command(held):
    """No pose is known right after one: a command made of it would be NaN."""
    path, on = (part[: round(1.0 / CYCLE)] for part in held["outside"][:2])
    assert np.isfinite(path).all() and on.all() and np.abs(path).max() < 0.01


def test_whatever_a_joint_reads_an_easing_hand_does_not_go_far(held):
    path, on, _ = held["far"]
    assert np.abs(path).max() < 0.2 + 0.12 and not on[-1]


def test_a_finger_that_is_pushed_gives_way(hand):
    """By a tenth of a radian from where it was, at the speed of starts."""
    bench = ready(hand)
    commands = []
    for _ in range(round(1.0 / CYCLE)):
        bench.position = bench.position - np.float32(0.004) * JOINT
        commands.append(bench.cycle(target=MIDDLE, follow=False, force=30.0).position[4] - MIDDLE[4])
    assert np.abs(np.diff(commands)).max() <= 0.5 * CYCLE + 1e-6
    assert commands[-1] == pytest.approx(-0.1, abs=0.005)


@pytest.mark.parametrize(("share", "ended"), [(15, False), (30, True)])
def test_short_holds_may_take_a_fifth_of_the_time(hand, share, ended):
    """A policy that touches too hard now and then goes on."""
    bench = ready(hand)
    for k in range(round(52.0 / CYCLE)):
        bench.cycle(target=MIDDLE, force=30.0 * (k % 100 < share))
        if bench.safety.latched:
            break
    assert bool(bench.safety.latched) == ended


@pytest.mark.parametrize("event", [{"velocity": 25.0}, {"target": np.full(12, np.nan)}])
def test_no_hold_lasts_for_ever(hand, event):
    safety, now = Safety(hand, SafetyConfig()), 0.0
    safety.engage()
    modes = []
    for _ in range(round(8.0 / CYCLE)):
        safety.update(sample(now, MIDDLE, velocity=event.get("velocity", 0.0)))
        safety.set_target(event.get("target", MIDDLE), now)
        modes.append(safety.decide(now).mode != 0)
        now += CYCLE
    assert 5.0 <= sum(modes) * CYCLE < 5.1 and not modes[-1] and safety.latched.endswith("for 5 s")
