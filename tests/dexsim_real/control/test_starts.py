"""Starts with wrong readings, judged by the true angles: motors that come on move no joint faster than `slow_speed`.

Hundreds of hands at once have the motors of the emulated hand, without friction, which would hide a motion, unless a
test asks for it. Each has a `Safety` of its own and is read at 83 Hz. The first readings after the connection, or
after a reconnection, are wrong.
"""

from types import SimpleNamespace

import numpy as np
import pytest
from test_safety import CYCLE, FREE, MIDDLE, sample

from dexsim_real.control.limits import SafetyConfig
from dexsim_real.control.pose_check import PoseCheck
from dexsim_real.control.safety import Safety
from dexsim_real.sensors.hand import HardwareConfig
from dexsim_real.twin.plant.drives import PERIOD, Drives
from dexsim_real.twin.plant.parameters import sample_trial
from dexsim_real.twin.plant.scene import ROTORS, STRONG
from dexsim_real.wire.frames import Mode

SLOW = SafetyConfig().slow_speed
KP = HardwareConfig().kp[0]
BEFORE, READ = 14, 45  # cycles until the connection is lost, and of wrong and right readings


class Hands:
    """The joints [H, 12] of many hands, moved by the drives of the emulated one."""

    def __init__(self, hand, count, friction=0.0):
        self.angle = np.tile(MIDDLE.astype(float), (count, 1))
        self.speed, self.time = np.zeros_like(self.angle), 0.0
        self.fastest = np.zeros(count)  # rad/s, mean of a cycle, with the motors on
        self._inertia = np.tile(np.where(hand.torque_limit > STRONG, *ROTORS), count)
        self._drives = Drives(np.tile(hand.torque_limit, count), np.tile(hand.speed_limit, count))
        fixed = {"thermal": 0.0, "no_load_current": 0.0, "coulomb_friction": friction}
        nominal = sample_trial("rotate", np.random.default_rng(0), "nominal", fixed)
        self._drives.configure(
            SimpleNamespace(**{name: np.tile(v, count) if v.shape == (12,) else v for name, v in nominal.value.items()})
        )

    def cycle(self, position, on, stiffness):
        """One exchange, for 12 ms: angles [H, 12] rad, motors on [H], share of the stiffness [H]."""
        size, before, on = self.angle.size, self.angle.copy(), np.repeat(on[:, None], 12, axis=1)
        zero, full = np.zeros(size), np.full(size, HardwareConfig().torque_max)
        kp = np.repeat(stiffness, 12) * KP
        mode = on.ravel() * Mode.POSITION
        command = {"position": position.ravel(), "kp": kp, "ki": zero, "kd": zero, "torque_max": full, "mode": mode}
        self._drives.send(self.time, command)
        for _ in range(round(CYCLE / PERIOD)):
            torque, dry = self._drives.step(self.time, self.angle.ravel(), self.speed.ravel())
            speed, stopped = self.speed.ravel() + PERIOD * torque / self._inertia, PERIOD * dry / self._inertia
            self.speed = (np.sign(speed) * np.maximum(np.abs(speed) - stopped, 0.0)).reshape(on.shape) * on
            self.angle = self.angle + PERIOD * self.speed
            self.time += PERIOD
        self.fastest = np.maximum(self.fastest, np.abs(self.angle - before).max(1) / CYCLE)


# What a hand reads instead of its true angles. `past` has those of all cycles since the connection.


def spike(rng):
    at, joint, size = rng.integers(12), rng.integers(12), rng.choice([-1, 1]) * rng.uniform(0.02, 0.6)
    return lambda k, past: past[-1] + size * (np.arange(12) == joint) * (k == at)


def huge(rng):
    at, joint, value = rng.integers(12), rng.integers(12), rng.choice([np.nan, 1e30, -1e30])
    return lambda k, past: np.where((np.arange(12) == joint) & (k == at), value, past[-1])


def several(rng):
    """Two to four equal ones, in a row or with true ones between them."""
    joint, size = rng.integers(12), rng.choice([-1, 1]) * rng.uniform(0.02, 0.6)
    wrong = set(rng.integers(0, 15) + rng.permutation(6)[: rng.integers(2, 5)])
    return lambda k, past: past[-1] + size * (np.arange(12) == joint) * (k in wrong)


def drift(rng):
    at, joint, last = rng.integers(12), rng.integers(12), rng.integers(30)
    rate = rng.choice([-1, 1]) * rng.uniform(0.1, 5)
    return lambda k, past: past[-1] + rate * CYCLE * (np.arange(12) == joint) * max(k - at, 0) * (k < at + last)


def stuck(rng):
    """The hand sinks while the first readings are all the same."""
    last, sunk = rng.integers(1, 9), rng.uniform(0.1, 0.4)

    def read(k, past):
        if k < 9:
            past[-1] -= FREE * sunk / 9
        return past[0] if k < last else past[-1]

    return read


def noise(rng):
    size = rng.uniform(0.0, 0.015)
    return lambda k, past: past[-1] + size * rng.standard_normal(12)


def swapped(rng):
    joints, at, last = rng.permutation(12)[:2], rng.integers(12), rng.integers(1, 5)

    def read(k, past):
        angles = past[-1].copy()
        if at <= k < at + last:
            angles[joints] = angles[joints[::-1]]
        return angles

    return read


KINDS = (spike, huge, several, drift, stuck, noise, swapped)


def starts(hand, kinds):
    """Starts, one for each kind: largest true speed [H] rad/s, and which [H] motors came on.

    Every other hand is connected anew; every third has a target far away, to which it moves at `slow_speed`.
    """
    rng, count = np.random.default_rng(1), len(kinds)
    hands, reads, moving = Hands(hand, count), [kind(rng) for kind in kinds], np.arange(count) % 3 == 0
    hands.angle += FREE * rng.uniform(-0.2, 0.2, (count, 12))
    safeties = [Safety(hand, SafetyConfig(speed=SLOW if far else 7.0)) for far in moving]
    position, on, stiffness = hands.angle.copy(), np.zeros(count, bool), np.zeros(count)

    def exchange(readings, generation, which):
        for h in which:
            safety = safeties[h]
            safety.update(sample(hands.time, readings[h], generation=generation))
            if moving[h]:
                safety.set_target(MIDDLE + np.float32(0.6), hands.time)
            decision = safety.decide(hands.time)
            position[h], on[h], stiffness[h] = decision.position, decision.mode == Mode.POSITION, decision.stiffness
        hands.cycle(position, on, stiffness)

    for safety in safeties:
        safety.engage()
    again = np.arange(1, count, 2)
    for _ in range(BEFORE):
        exchange(hands.angle, 1, again)
    assert on[again].all()
    hands.speed[:] = 0.0
    hands.angle[again] += FREE * rng.uniform(-0.2, 0.2, (len(again), 12))  # The cable was out, the motors off.
    past = [[angles] for angles in hands.angle]
    for k in range(READ):
        for h, angles in enumerate(hands.angle):
            past[h].append(angles.copy())
        readings = [read(k, past[h]) for h, read in enumerate(reads)]
        hands.angle = np.where(on[:, None], hands.angle, [p[-1] for p in past])
        exchange(readings, 2, range(count))
    return hands.fastest, on


@pytest.mark.parametrize("count", [105, pytest.param(3003, marks=pytest.mark.slow)])
def test_no_start_moves_a_joint_faster_than_the_speed_of_starts(hand, count):
    kinds = [KINDS[k % len(KINDS)] for k in range(count)]
    fastest, on = starts(hand, kinds)
    assert on.mean() > 0.95
    worst = {kind.__name__: max(fastest[h] for h, k in enumerate(kinds) if k is kind) for kind in KINDS}
    assert fastest.max() <= SLOW * 1.001, worst


def test_joints_that_stick_do_not_catch_up_while_they_stiffen(hand):
    hands, safety, decision = Hands(hand, 1, friction=0.03), Safety(hand, SafetyConfig()), None
    safety.engage()
    while decision is None or decision.mode != Mode.POSITION or decision.stiffness < 1:
        safety.update(sample(hands.time, hands.angle[0]))
        safety.set_target(MIDDLE + np.float32(0.6), hands.time)
        decision = safety.decide(hands.time)
        hands.cycle(decision.position[None], np.array([decision.mode == Mode.POSITION]), [decision.stiffness])
    assert 0 < hands.time < 2 and hands.fastest <= SLOW


@pytest.mark.parametrize("way", [-1, 1])
def test_a_pose_that_is_wrong_throughout_is_crept_to(hand, way):
    """Nothing tells it from a true one: stiffness that grows from zero keeps 0.1 rad below the speed of starts."""
    for size, most in ((0.1, SLOW), (0.3, 1.5)):
        fastest, on = starts(hand, [lambda rng, e=way * size: lambda k, past: past[-1] + e * (np.arange(12) == 6)] * 3)
        assert on.all() and fastest[1:].max() <= most


@pytest.mark.parametrize(("rate", "known"), [(0.0, True), (0.1, True), (0.25, False), (-0.9, False)])
def test_readings_that_drift_are_no_pose(hand, rate, known):
    """Ten readings of 0.9 rad/s are within 0.05 rad of their median, and may be as far from the true angle."""
    check = PoseCheck(hand)
    for k in range(20):
        check.judge(k * CYCLE, MIDDLE + rate * k * CYCLE * (np.arange(12) == 9), None)
    assert (check.at_rest is not None) == known
