"""Goals of the rotation task on hardware."""

import math
from typing import Any

import numpy as np

from dexsim_real.sensors.imu import multiply
from dexsim_real.sensors.readings import ObjectEstimate


class TurnGoals:
    """Goals of the rotation task, followed with what the IMU says, by the task's own rules.

    The simulation judges by the true spin and place of the object; here the spin is estimated from the
    orientation (filtered over 0.1 s), and of the place only the measured coordinate counts.
    """

    _SMOOTH = 0.1  # s

    def __init__(self, config: Any, reference: np.ndarray):
        self._config, self._reference = config, np.asarray(reference)
        self._axis = config.unit_axis
        self.successes, self.times = 0, []
        self._last: tuple[float, np.ndarray] | None = None
        self._spin, self._inside_since = 0.0, None
        self.quat = self._goal()

    def update(self, time: float, seen: ObjectEstimate) -> np.ndarray:
        """The goal [4] that the readings of this tick carry; it has moved on if it was reached."""
        config, quat = self._config, seen.quat
        if self._last is not None and time > self._last[0]:
            step = time - self._last[0]
            turn = multiply(quat, self._last[1] * [1, -1, -1, -1])
            rate = 2 * math.atan2(float(turn[1:] @ self._axis), float(turn[0])) / step
            rate = (rate + math.pi / step) % (2 * math.pi / step) - math.pi / step
            self._spin += step / (step + self._SMOOTH) * (rate - self._spin)
        self._last = time, quat
        away = 2 * math.acos(min(1.0, abs(float(quat @ self.quat))))
        distance = np.linalg.norm(seen.position - self._reference)
        inside = away < config.goal_angle and distance < config.goal_distance
        self._inside_since = (self._inside_since or time) if inside else None
        calm = config.goal_spin <= 0 or abs(self._spin) <= config.goal_spin
        if inside and calm and time - self._inside_since >= config.goal_dwell:
            self.successes += 1
            self.times.append(time)
            self._inside_since = None
            self.quat = self._goal()
        return self.quat

    def _goal(self) -> np.ndarray:
        config = self._config
        angle = (self.successes + 1) * config.direction * config.goal_step % (2 * math.pi)
        return np.concatenate([[math.cos(angle / 2)], math.sin(angle / 2) * self._axis])
