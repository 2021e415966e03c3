"""Physics simple enough to see through, for the emulated hand's wire: every joint follows its command with a lag."""

import math
from types import SimpleNamespace

import numpy as np

from dexsim_real.twin.plant.emulated_hand import PlantMeasurement
from dexsim_real.twin.plant.shapes import ObjectShape, Primitive
from dexsim_real.wire.frames import Mode

REST = np.array([0.3] * 3 + [0.0] + [0.3] * 8)


class ScriptedPlant:
    """First-order joints, fingertips that press as they bend, an object at rest; trials of `trial_seconds`."""

    hand = SimpleNamespace(side="right")
    up = np.array([math.cos(0.2), 0.0, math.sin(0.2)])
    shape = ObjectShape("box", (Primitive("box", (0.025, 0.025, 0.025)),))

    def __init__(self, trial_seconds=math.inf):
        self.trial_seconds = trial_seconds
        self.time, self.angle = 0.0, REST.copy()
        self.velocity, self.heat = np.zeros(12), np.full(12, 35.0)
        self.motors = None

    @property
    def trial(self):
        return int(self.time / self.trial_seconds)

    def drive(self, motors):
        self.motors = motors

    def advance(self, seconds):
        self.time += seconds
        before, goal = self.angle, self.angle
        if self.motors is not None:
            goal = np.where(self.motors["mode"] == Mode.POSITION, self.motors["position"], self.angle)
        self.angle = goal + (self.angle - goal) * math.exp(-seconds / 0.02)
        self.velocity = (self.angle - before) / seconds

    def measure(self):
        force = np.zeros((5, 120, 3))
        # Quarter of a newton on ten taxels for each radian; what pulls along the tip is half of it.
        force[:, 40:50, 2] = 0.25 * np.maximum(self.angle[[2, 5, 7, 9, 11]], 0)[:, None]
        force[:, 40:50, 0] = -0.5 * force[:, 40:50, 2]
        return PlantMeasurement(
            joint_position=self.angle.copy(),
            joint_velocity=self.velocity.copy(),
            current=-100.0 * self.velocity,
            temperature=self.heat.copy(),
            taxel_force=force,
        )

    def measure_object(self):
        return np.array([0.047, 0.0, 0.071]), np.array([1.0, 0.0, 0.0, 0.0]), 9.81 * self.up

    def results(self):
        return [{"trial": k} for k in range(self.trial + 1)]
