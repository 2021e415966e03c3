"""A driver of any hand: it gives the states that it is told to, and keeps what was sent."""

import dataclasses

import numpy as np

from dexsim_real.wire.driver import WITHOUT, DriverState


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
