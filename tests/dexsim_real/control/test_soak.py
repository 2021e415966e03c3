"""A soak in virtual time: wrong readings of every kind through the exchange loop, judged by the true angles.

The joints are moved by the motors of the emulated hand, without friction, which would hide a motion. A random policy
gives targets all the time. The cable comes out and back, and whenever `Safety` has ended a run, a new one starts.
"""

import numpy as np
import pytest
from test_safety import AGREEING, CYCLE, FREE, MIDDLE, SOFT
from test_starts import KP, SLOW, Hands, drift, huge, noise, several, spike, swapped

from dexsim_real.control.limits import SafetyConfig
from dexsim_real.control.safety import Safety
from dexsim_real.loop import ExchangeLoop
from dexsim_real.sensors.hand import HandSensing, HardwareConfig
from dexsim_real.wire import frames
from dexsim_real.wire.frames import Mode
from dexsim_real.wire.link import HandPort, LinkCounts, Reply

RARE = 1e-3  # probability in a cycle that the cable comes out, and that a run ends and another begins
LENGTH = 30  # answers in which the angles of a fault are wrong, some or all
ANGLES = (spike, huge, several, drift, noise, swapped)


# Faults of what is no angle: what a joint or 60 taxels of a fingertip read, and in how many answers.
OTHERS = dict(temperature=(255, 1), current=(-3000, 5), joint_error=(4, 3), raw_position=(0, 3), taxel=(9, 10))


class Faulty(HandPort):
    """`HandPort` of one hand whose answers are wrong for a share of the time, and its clock."""

    def __init__(self, hand, rng, share):
        self.hands, self.rng, self.counts, self._share = Hands(hand, 1), rng, LinkCounts(), share
        self.wrong = self.reconnections = self.cycles = self.cycles_on = 0
        self.step = self.step_of_starts = 0.0  # rad, largest true motion of a joint in a cycle
        self._generation, self._away, self._stops = 1, 0, (hand.joint_lower, hand.joint_upper)
        self._angles = self._other = None  # the fault of now, and its answers that are left
        self._past, self._left = [], 0
        self._command, self._since = (MIDDLE[None], np.zeros(1, bool), np.zeros(1)), None

    def clock(self):
        return self.hands.time

    def exchange(self, command):
        if self._away:
            return self._lost()
        if self.rng.random() < RARE:
            self._away = int(self.rng.integers(2, 150))
        on = bool(command["mode"][0] == Mode.POSITION)
        self._command = command["position"][None].astype(float), np.array([on]), command["kp"][:1] / KP
        self._move()
        return self._answer()

    def _lost(self):
        """The cable is out: the hand keeps to its last command. When it is back, its motors go off, and it sinks."""
        self._away -= 1
        if self._away:
            self._move()
            return None
        self.reconnections += 1
        self._generation += 1
        self.sink()
        return self._answer()

    def sink(self):
        """The motors are off for a while."""
        self._command = (*self._command[:1], np.zeros(1, bool), np.zeros(1))
        self._move()
        self.hands.angle += FREE * self.rng.uniform(-0.2, 0.2, 12)
        self.hands.angle = np.clip(self.hands.angle, *self._stops)

    def _move(self):
        before, on = self.hands.angle.copy(), bool(self._command[1][0])
        self._since = (self.hands.time if self._since is None else self._since) if on else None
        starting = on and self.hands.time - self._since < SOFT
        self.hands.cycle(*self._command)
        step = np.abs(self.hands.angle - before).max()
        self.step = max(self.step, step)
        self.step_of_starts = max(self.step_of_starts, step * starting)
        self.cycles += 1
        self.cycles_on += on

    def _answer(self):
        state = frames.empty_state()
        joints, tips = state["joint"], state["tip"]
        joints["position"] = self.hands.angle[0]
        joints["raw_position"] = int(self._command[1][0]) * Mode.POSITION
        joints["temperature"] = 35
        sound = state.copy()
        if not self._left and self.rng.random() < self._share:
            self._begin()
        if self._left:
            self._left -= 1
            self._past.append(self.hands.angle[0].copy())
            if self._other == "taxel":
                tips["taxel"]["z"][self.rng.integers(5), :60] = OTHERS["taxel"][0]  # 54 N
            elif self._other:
                joints[self._other][self.rng.integers(12)] = OTHERS[self._other][0]
            else:
                joints["position"] = self._angles(len(self._past) - 1, self._past)
        self.wrong += state.tobytes() != sound.tobytes()
        self.counts.sent += 1
        return Reply(state, self.hands.time - CYCLE, self.hands.time, self.counts.sent, self._generation)

    def _begin(self):
        """Draw a fault."""
        self._past, self._other = [], None
        if self.rng.random() < 0.5:
            self._angles, self._left = self.rng.choice(ANGLES)(self.rng), LENGTH
        else:
            self._other = self.rng.choice(list(OTHERS))
            self._left = int(self.rng.integers(1, OTHERS[self._other][1] + 1))


def soak(hand, minutes, share, speed, seed=0):
    """So many minutes of virtual time, in which faults begin with a probability of `share` in each answer."""
    rng = np.random.default_rng(seed)
    port, starts, ends, target = Faulty(hand, rng, share), 0, {}, MIDDLE
    while port.clock() < 60 * minutes:
        safety = Safety(hand, SafetyConfig(speed=speed))
        loop = ExchangeLoop(port, HandSensing(hand, HardwareConfig()), safety, 1 / CYCLE, clock=port.clock)
        for _ in range(AGREEING):
            loop.cycle()
        loop.engage()
        starts += 1
        while not safety.latched and port.clock() < 60 * minutes and rng.random() > RARE:
            if port.cycles % 3 == 0:  # As a policy: up to 0.2 rad every 36 ms.
                target = np.clip(target + rng.uniform(-0.2, 0.2, 12) * FREE, MIDDLE - 0.7, MIDDLE + 0.7)
            safety.set_target(target, port.clock())
            loop.cycle()
        port.sink()
        reason = safety.latched.partition(":")[0]
        ends[reason] = ends.get(reason, 0) + 1
    return port, starts, ends


@pytest.mark.parametrize(
    ("speed", "minutes", "least"),
    [(7.0, 0.5, 100), pytest.param(2.0, 30, 10_000, marks=pytest.mark.slow)],
)
def test_no_wrong_reading_moves_a_joint_faster_than_its_limit(hand, speed, minutes, least):
    port, starts, ends = soak(hand, minutes, 0.018, speed)
    assert port.wrong >= least and min(port.reconnections, starts) >= 2 * minutes, ends
    assert port.cycles_on > 0.5 * port.cycles
    assert port.step_of_starts <= SLOW * CYCLE
    assert port.step <= speed * CYCLE * 1.05
