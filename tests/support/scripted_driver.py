"""A driver of any hand that gives the states that it is told to; a driver with port and loop in their own time."""

import dataclasses

import numpy as np

from dexsim_real.control.limits import SafetyConfig
from dexsim_real.control.safety import Safety
from dexsim_real.loop import ExchangeLoop
from dexsim_real.sensors.hand import HandSensing, HardwareConfig
from dexsim_real.wire.driver import WITHOUT, DriverPort, DriverState
from dexsim_real.wire.link import LinkConfig


class ScriptedDriver:
    """`HandDriver` whose joints go this share of the way to their targets at each command."""

    def __init__(self, hand, measures=WITHOUT, share=0.0):
        self.measures, self.share, self.sent, self.calls, self.failing = frozenset(measures), share, [], [], False
        joints, taxels = hand.num_joints, (hand.num_fingers, hand.num_taxels)
        self.state = DriverState(
            position=np.clip(0.1, hand.joint_lower, hand.joint_upper).astype(float),
            on=np.zeros(joints, bool),
            current=np.zeros(joints) if "currents" in measures else None,
            temperature=np.full(joints, 30.0) if "temperatures" in measures else None,
            taxel_force=np.zeros(taxels) if "taxels" in measures else None,
        )

    def set(self, **values):
        self.state = dataclasses.replace(self.state, **values)

    @property
    def on(self):
        return bool(self.state.on.all())

    def connect(self):
        self.calls.append("connect")
        if self.failing:
            raise OSError("gone")
        return "scripted"

    def send(self, targets):
        if self.failing:
            raise OSError("gone")
        self.sent.append(targets)
        position = self.state.position
        if targets.on:
            position = position + self.share * (targets.position - position)
        self.set(on=np.full(len(targets.position), targets.on), position=position)

    def read(self):
        return self.state

    def close(self):
        self.calls.append("close")


class DriverBench:
    """Connected and tared, with the motors off; `hardware` are fields of `HardwareConfig`."""

    def __init__(self, hand, driver, **hardware):
        self.hand, self.driver, self.time = hand, driver, 0.0
        self.port = DriverPort(driver, hand, LinkConfig())
        self.port._clock = driver._clock = self.clock  # the driver's: of a mock, whose plant it moves
        self.safety, sensing = Safety(hand, SafetyConfig()), HandSensing(hand, HardwareConfig(**hardware))
        self.loop = ExchangeLoop(self.port, sensing, self.safety, 83.0, clock=self.clock, sleep=self.sleep)
        self.port.connect()
        self.loop.tare()

    def clock(self):
        return self.time

    def sleep(self, seconds):
        self.time += seconds

    def run(self, seconds, target=None, before=lambda: None):
        """Exchange for this long, with a joint target from the policy and a call before each exchange."""
        until = self.time + seconds
        while self.time < until:
            if target is not None:
                self.safety.set_target(target, self.time)
            before()
            self.loop.cycle()
            self.loop.pace.wait()

    def engage(self):
        self.loop.engage()
        self.run(0.05)
        assert self.safety.anchor, "the motors are on"
