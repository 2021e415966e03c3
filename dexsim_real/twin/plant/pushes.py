"""Pushes on the object of the emulated hand: a constant force for a short time, at random times."""

import numpy as np

from dexsim_real.twin.plant.parameters import PUSHES, TrialParameters


class Pushes:
    """The pushes of one trial; `begin` starts them.

    Args:
      parameters: of the trial.
      rng: random numbers for times and directions.
    """

    def __init__(self, parameters: TrialParameters, rng: np.random.Generator):
        self._parameters, self._rng = parameters, rng
        self._until: float | None = None  # s, end of the push that lasts
        self._at = np.inf  # s, of the next push

    def begin(self, time: float) -> None:
        """The object is free from a time in s."""
        rate = PUSHES[self._parameters.task][0] * float(self._parameters.push_rate)
        self._at = time + self._rng.exponential(1 / rate) if rate > 0 else np.inf

    def apply(self, time: float, force: np.ndarray) -> None:
        """Set the force [3] N on the object at a time in s."""
        if self._until is not None and time >= self._until:
            force[:], self._until = 0.0, None
        if time < self._at:
            return
        parameters, duration = self._parameters, float(self._parameters.push_seconds)
        direction = self._rng.standard_normal(3)
        change = PUSHES[parameters.task][1] * self._rng.random() * direction / np.linalg.norm(direction)
        force[:] = float(parameters.mass) * change / duration
        self._until = time + duration
        self.begin(time)
