"""The policy's side of a run in virtual time: sensors of the object that fall silent end it, with their reason."""

from types import SimpleNamespace

import numpy as np
import pytest
from test_safety import CYCLE, MIDDLE, Bench

from dexsim_real.control import policy_loop
from dexsim_real.control.controller import Tick
from dexsim_real.control.safety import Reaction
from dexsim_real.sensors.imu import IDENTITY, ImuReader, encode


class Still:
    """What the loop needs of a controller, with a policy that stays where it is."""

    def __init__(self, hand):
        self.hand, self.period = hand, 3 * CYCLE
        self.spec = SimpleNamespace(turn=None, posture=None, reference=(0.0, 0.0, 0.1))

    def start(self, target):
        self.target = target

    resume = anchor = start

    def tick(self, measured, estimate, goal, command):
        return Tick(None, None, np.zeros(12), MIDDLE)


@pytest.mark.parametrize("silent", [False, True])
def test_a_silent_imu_is_held_within_a_third_of_a_second_then_relaxed(hand, silent):
    bench, imu = Bench(hand), ImuReader()
    objects = policy_loop.ObjectSensors(np.zeros(3), None, imu)
    loop = policy_loop.PolicyLoop(Still(hand), bench.safety, objects, command=0.5, approach=0.0, place=0.0)
    imu.receive(bench.now, encode(0, IDENTITY))
    bench.engage()
    bench.cycle()
    while loop.approach(bench.now):
        bench.cycle()
    loop.begin()
    start, reactions = bench.now, []
    for k in range(round(3.0 / CYCLE)):
        if not (silent and bench.now > start + 1.0):
            imu.receive(bench.now, encode(k, IDENTITY))
        if k % 3 == 0 and not bench.safety.latched:
            assert loop.tick(bench.now) is not None
        reactions.append((bench.now - start, *bench.safety.last))
        bench.cycle()
    held = [(time, reason) for time, reaction, reason in reactions if reaction >= Reaction.HOLD]
    if silent:
        assert 1.3 <= held[0][0] < 1.4 and held[0][1] == "the IMU is silent"
        assert bench.safety.latched == "the IMU is silent for 1 s"
    else:
        assert not held and not bench.safety.latched
