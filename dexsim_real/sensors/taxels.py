"""Taxels at rest and in a run: which ones are stuck, what touches, and how their zeros wander.

The skin spreads every load over adjacent taxels. So a taxel that reads much while the rest of its fingertip reads next
to nothing is stuck, and one that stays near its zero beside neighbours that do so bears nothing.
"""

import numpy as np

from dexsim.hand.description import Hand
from dexsim_real.core.errors import HandError

_HIGH = 40.0  # counts above which a taxel cannot be tared: alone it is stuck, several adjacent ones touch something
_ADJACENT = 2  # neighbours above the limit that make it a touch: three taxels in a patch
_MANY = 6  # stuck taxels of a fingertip with which it is of no use
_QUIET = 5.0  # counts up to which the other taxels of a fingertip read next to nothing
_ANSWERS = 20  # in which a stuck taxel reads the same
_SAME = 1.0  # counts
_WINDOW = 2.0  # s since a taxel was last pressed, over which its readings are averaged
_NEAR = 1.5  # counts above its zero up to which a taxel may be free: one count, and a zero between two counts
_RATE = 0.06  # counts/s by which the zeros of a fingertip may rise, together; 60 counts were seen in half an hour
_FIRST = 2.0  # counts of rise that are allowed from the beginning
_AT_ONCE = 10.0  # counts of rise that may have been saved up while the fingertip was pressed


def judge_rest(hand: Hand, counts: np.ndarray, most: float) -> np.ndarray:
    """Mask [F, N] of stuck taxels, given mean raw counts [F, N] of fingertips that should touch nothing.

    `most` is the sum of a fingertip's counts above which it is touched; stuck taxels do not add to it. Raises
    HandError: something touches a fingertip, or many of its taxels are stuck.
    """
    high = counts > _HIGH
    beside = around(hand, high.astype(np.float32)).sum(0)
    total = np.where(high, 0.0, counts).sum(1)
    for finger, name in enumerate(hand.finger_names):
        patch = high[finger] & (beside[finger] > 0)
        if np.any(high[finger] & (beside[finger] >= _ADJACENT)):
            what = f"{patch.sum()} adjacent taxels of the {name} read above {_HIGH:.0f} counts"
            raise HandError(f"cannot tare the taxels: {what}: something touches it; free the fingertips")
        if total[finger] > most:
            what = f"those of the {name} read {total[finger]:.0f} counts together, limit {most:.0f}"
            todo = "free the fingertips; if they read as much untouched, raise --hardware.tare-sum"
            raise HandError(f"cannot tare the taxels: {what}: something touches it; {todo}")
        if high[finger].sum() > _MANY:
            which = taxel_names(hand, high[finger])
            raise HandError(f"{name}: {high[finger].sum()} taxels are stuck: {which}; power-cycle the hand")
    return high


def taxel_names(hand: Hand, which: np.ndarray) -> str:
    """ "column 3 row 7, ..." of a mask [N], counted from 0 as in the layout file."""
    rows = hand.taxel_grid[1]
    named = [f"column {i // rows} row {i % rows}" for i in np.flatnonzero(which)]
    return ", ".join(named[:6]) + (f" and {len(named) - 6} more" if len(named) > 6 else "")


def around(hand: Hand, values: np.ndarray) -> np.ndarray:
    """Values [8, F, N] of the eight neighbours of each taxel, given values [F, N]; 0 beyond the lattice."""
    columns, rows = hand.taxel_grid
    padded = np.pad(values.reshape(-1, columns, rows), ((0, 0), (1, 1), (1, 1)))
    shifts = [(i, j) for i in range(3) for j in range(3) if (i, j) != (1, 1)]
    return np.stack([padded[:, i : i + columns, j : j + rows].reshape(values.shape) for i, j in shifts])


class StuckTaxels:
    """Finds taxels that get stuck in a run: above what a finger may press, the same for 20 answers, and nothing else on
    the fingertip reads anything.

    Beside a load a taxel may also saturate. A real load of that size makes `Safety` ease it, which changes the reading;
    what is stuck stays until the fingertip is free.
    """

    def __init__(self, hand: Hand):
        self._first = np.zeros((hand.num_fingers, hand.num_taxels), np.float32)  # counts
        self._answers = np.zeros(self._first.shape, int)

    def find(self, counts: np.ndarray, limit: np.ndarray) -> np.ndarray:
        """Mask [F, N] of stuck taxels, given each answer's tared counts [F, N] and what a finger may read [F, 1]."""
        same = (counts > limit) & (np.abs(counts - self._first) <= _SAME)
        self._first = np.where(same, self._first, counts)
        others = np.where(same, 0.0, counts).max(1, keepdims=True)
        self._answers = np.where(same & (others <= _QUIET), self._answers + 1, 0)
        return self._answers >= _ANSWERS


class ZeroTracker:
    """Follows the zeros of a run's taxels, which wander over minutes, as the fingertips warm up.

    What a free taxel reads on average is its new zero. Light touches look the same to a single taxel, so the zeros of a
    fingertip rise together no faster than they wander with temperature, and to `most` counts: the largest load that
    they can hide.
    """

    def __init__(self, hand: Hand, most: float):
        self._hand, self._most = hand, most
        self._time: float | None = None  # s, of the last answer
        self._budget = np.full(hand.num_fingers, _FIRST)  # counts by which the zeros of a fingertip may rise now
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
