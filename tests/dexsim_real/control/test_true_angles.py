"""Wrong readings judged by the true angles: starts, holds for force, and a soak of everything.

Hands, hundreds at once, have the motors of the emulated hand, without friction, which would hide a motion, unless a
test asks for it. Motors that come on move no joint faster than `slow_speed`.
"""

from types import SimpleNamespace

import numpy as np
import pytest
from test_safety import AGREEING, CYCLE, FREE, MIDDLE, SOFT, ready, sample

from dexsim_real.control.limits import SafetyConfig
from dexsim_real.control.pose_check import PoseCheck
from dexsim_real.control.safety import Safety
from dexsim_real.loop import ExchangeLoop
from dexsim_real.sensors.hand import HandSensing, HardwareConfig
from dexsim_real.twin.plant.drives import PERIOD, Drives
from dexsim_real.twin.plant.parameters import sample_trial
from dexsim_real.twin.plant.scene import ROTORS, STRONG
from dexsim_real.wire import frames
from dexsim_real.wire.frames import Mode
from dexsim_real.wire.link import HandPort, LinkCounts, Reply

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


def huge(rng):
    at, joint, value = rng.integers(12), rng.integers(12), rng.choice([np.nan, 1e30, -1e30])
    return lambda k, past: np.where((np.arange(12) == joint) & (k == at), value, past[-1])


def spikes(rng):
    """One to four equal ones, in a row or with true ones between them."""
    joint, size = rng.integers(12), rng.choice([-1, 1]) * rng.uniform(0.02, 0.6)
    wrong = set(rng.integers(0, 15) + rng.permutation(6)[: rng.integers(1, 5)])
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


KINDS = (spikes, huge, drift, stuck, noise, swapped)


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


@pytest.mark.parametrize(
    ("case", "seconds", "far"),
    [("wrong at first", 3.0, 0.01), ("wrong twice", 3.0, 0.01), ("outside", 1.0, 0.01), ("far", 9.0, 0.2 + 0.12)],
)
def test_a_wrong_angle_in_a_hold_is_not_eased_to(held, case, seconds, far):
    """Neither where it begins, nor one outside the limits, right after which no pose is known; others not far."""
    path, on, safety = held[case]
    assert (safety.counts["implausible: measurement"] > 0) == (case == "outside")
    steps = round(seconds / CYCLE)
    assert np.isfinite(path).all() and np.abs(path[:steps]).max() < far
    assert on[: round(1.0 / CYCLE)].all() and not on[-1]


@pytest.mark.parametrize(("share", "ended"), [(18, False), (35, True)])
def test_short_holds_may_take_a_fifth_of_the_time(hand, share, ended):
    """A policy that touches too hard now and then goes on."""
    bench = ready(hand)
    for k in range(round(30.0 / CYCLE)):
        bench.cycle(target=MIDDLE, force=30.0 * (k % 100 < share))
        if bench.safety.latched:
            break
    assert bool(bench.safety.latched) == ended


RARE = 1e-3  # probability in a cycle that the cable comes out, and that a run ends and another begins
LENGTH = 30  # answers in which the angles of a fault are wrong, some or all
ANGLES = (spikes, huge, drift, noise, swapped)
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
        """While the cable is out, the hand keeps to its last command. When it is back, its motors go off."""
        if self._away == 1:
            self.reconnections += 1
            self._generation += 1
            self.sink()
        elif not self._away:
            on = np.array([command["mode"][0] == Mode.POSITION])
            self._command = command["position"][None].astype(float), on, command["kp"][:1] / KP
            self._move()
            self._away = int(self.rng.integers(3, 151)) * (self.rng.random() < RARE)
        else:
            self._move()
        self._away = max(self._away - 1, 0)
        return None if self._away else self._answer()

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
    """So many minutes of virtual time, in which faults begin with a probability of `share` in each answer.

    A random policy gives targets all the time, and whenever `Safety` has ended a run, a new one starts.
    """
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
