"""The zero of the taxels in a run: it wanders over minutes, as the fingertips warm up, and is followed where nothing
touches.

A taxel that stays near its zero beside neighbours that do so bears nothing. What it reads on average is its new zero.
Light touches look the same to a single taxel, so the zeros of a fingertip rise together no faster than they wander with
temperature, and all that is taken for zero is bounded as in taring.
"""

import numpy as np

from dexsim.hand.kinematics import Hand
from dexsim_real.sensors.taxels import around

_WINDOW = 2.0  # s since a taxel was last pressed, over which its readings are averaged
_NEAR = 1.5  # counts above its zero up to which a taxel may be free: one count, and a zero between two counts
_RATE = 0.06  # counts/s by which the zeros of a fingertip may rise, together; 60 counts were seen in half an hour
_AT_ONCE = 10.0  # counts of rise that may have been saved up while the fingertip was pressed


class ZeroTracker:
    """Follows the zeros of a run's taxels.

    Args:
      hand: the lattice of the taxels.
      most: counts that the zeros of a fingertip may reach together: the largest load that they can hide.
    """

    def __init__(self, hand: Hand, most: float):
        self._hand, self._most = hand, most
        self._time: float | None = None  # s, of the last answer
        self._budget = np.full(hand.num_fingers, 2.0)  # counts by which the zeros of a fingertip may rise now
        self._sum = np.zeros((hand.num_fingers, hand.num_taxels), np.float32)
        self._answers, self._begin = np.zeros(self._sum.shape, int), np.zeros(self._sum.shape)

    def update(self, time: float, counts: np.ndarray, zero: np.ndarray) -> np.ndarray:
        """Update with raw counts [F, N] at a time in s; the zeros [F, N], infinite for stuck taxels, which stay so."""
        if self._time is None:
            self._begin[:], self._time = time, time
        self._budget = np.minimum(self._budget + _RATE * (time - self._time), _AT_ONCE)
        self._time = time
        pressed = counts > zero + _NEAR
        if pressed.any():
            self._restart(pressed | (around(self._hand, pressed.astype(np.float32)).max(0) > 0), time)
        self._sum, self._answers = self._sum + counts, self._answers + 1
        due = np.isfinite(zero) & (time - self._begin >= _WINDOW)
        if not due.any():
            return zero
        before = np.where(np.isfinite(zero), zero, np.float32(0))
        change = np.where(due, self._sum / self._answers - before, 0.0)
        rise = np.maximum(change, 0.0).sum(1)
        allowed = np.clip(self._most - before.sum(1), 0.0, self._budget)
        share = np.minimum(1.0, allowed / np.maximum(rise, 1e-9))
        self._budget -= share * rise
        self._restart(due, time)
        return (zero + np.where(change > 0, change * share[:, None], change)).astype(np.float32)

    def _restart(self, which: np.ndarray, time: float) -> None:
        self._sum[which], self._answers[which], self._begin[which] = 0.0, 0, time
