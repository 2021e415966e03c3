"""Goals of the rotation task on hardware, tracked with the IMU."""

import math

import numpy as np

from dexsim.task_spec import TurnSpec
from dexsim_real.sensors.imu import multiply
from dexsim_real.sensors.readings import ObjectEstimate


class TurnGoals:
    """Tracks the goals of the rotation task by the rules of the task.

    The simulation uses the object's true angular velocity and position. Here the angular velocity is estimated from
    the orientation (filtered over 0.1 s), and only the measured coordinate of the position counts.

    Args:
      turn: goals of the task.
      reference: [3] m, nominal position of the object.
    """

    _SMOOTH = 0.1  # s

    def __init__(self, turn: TurnSpec, reference: np.ndarray):
        self._turn, self._reference = turn, np.asarray(reference)
        self._axis = turn.unit_axis
        self.successes, self.times = 0, list[float]()
        self._last: tuple[float, np.ndarray] | None = None
        self._spin = 0.0
        self.quat = self._goal()

    def update(self, time: float, estimate: ObjectEstimate) -> np.ndarray:
        """Goal orientation [4] for this tick; the next one as soon as the last was reached.

        Args:
          time: s of the orientation.
          estimate: of the object.
        """
        goal, quat = self._turn, estimate.quat
        if self._last is not None and time > self._last[0]:
            step = time - self._last[0]
            turn = multiply(quat, self._last[1] * [1, -1, -1, -1])
            rate = 2 * math.atan2(float(turn[1:] @ self._axis), float(turn[0])) / step
            rate = (rate + math.pi / step) % (2 * math.pi / step) - math.pi / step
            self._spin += step / (step + self._SMOOTH) * (rate - self._spin)
        self._last = time, quat
        away = 2 * math.acos(min(1.0, abs(float(quat @ self.quat))))
        distance = np.linalg.norm(estimate.position - self._reference)
        inside = away < goal.angle and distance < goal.distance
        calm = goal.spin <= 0 or abs(self._spin) <= goal.spin
        if inside and calm:
            self.successes += 1
            self.times.append(time)
            self.quat = self._goal()
        return self.quat

    def _goal(self) -> np.ndarray:
        angle = (self.successes + 1) * self._turn.step % (2 * math.pi)
        return np.concatenate([[math.cos(angle / 2)], math.sin(angle / 2) * self._axis])
