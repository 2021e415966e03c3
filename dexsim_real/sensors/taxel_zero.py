"""The zero of the taxels in a run: it wanders over minutes, as the fingertips warm up, and is followed where nothing
touches.

A taxel that stays near its zero beside neighbours that do so bears nothing. What it reads on average is its new zero.
Light touches look the same to a single taxel, but not to a fingertip: together its taxels rise by more than they drift
in so short a time. Then they keep their zeros. All that is taken for zero is bounded as in taring.
"""

import numpy as np

from dexsim.hand.kinematics import Hand
from dexsim_real.sensors.taxels import around

_WINDOW = 5.0  # s, over which readings are averaged
_NEAR = 1.5  # counts above its zero up to which a taxel may be free: one count, and a zero between two counts
_DRIFT = 2.0  # counts by which the zeros of a fingertip may rise in a window, together


def follow_zero(hand: Hand, zero: np.ndarray, mean: np.ndarray, high: np.ndarray, most: float) -> np.ndarray:
    """The zeros [F, N] counts after a window.

    Args:
      hand: the lattice of the taxels.
      zero: [F, N] counts so far; infinite for stuck taxels, which stay so.
      mean, high: [F, N] raw counts, their mean and their largest value in the window.
      most: counts that the zeros of a fingertip may reach together: the largest load that they can hide.
    """
    pressed = high > zero + _NEAR
    free = np.isfinite(zero) & ~pressed & (around(hand, pressed.astype(np.float32)).max(0) == 0)
    before = np.where(np.isfinite(zero), zero, 0.0)
    after = np.where(free, mean, before)
    rise, total = np.maximum(after - before, 0.0).sum(1), after.sum(1)
    allowed = (rise <= _DRIFT) & ((total <= most) | (total <= before.sum(1)))
    return np.where(free & allowed[:, None], mean, zero).astype(np.float32)


class ZeroTracker:
    """Follows the zeros of a run's taxels, one window after another.

    Args:
      hand: the lattice of the taxels.
      most: counts; see `follow_zero`.
    """

    def __init__(self, hand: Hand, most: float):
        self._hand, self._most = hand, most
        self._begin: float | None = None  # s, of the window
        self._sum = self._high = np.zeros((hand.num_fingers, hand.num_taxels), np.float32)
        self._answers = 0

    def update(self, time: float, counts: np.ndarray, zero: np.ndarray) -> np.ndarray:
        """Update with raw counts [F, N] at a time in s; the zeros [F, N], `zero` itself unless a window has ended."""
        if self._begin is not None and time < self._begin + _WINDOW:
            self._sum, self._high = self._sum + counts, np.maximum(self._high, counts)
            self._answers += 1
            return zero
        if self._begin is not None:
            zero = follow_zero(self._hand, zero, self._sum / self._answers, self._high, self._most)
        self._begin, self._sum, self._high, self._answers = time, counts, counts, 1
        return zero
