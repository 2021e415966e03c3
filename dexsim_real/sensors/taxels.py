"""Taxels at rest: which ones are stuck, and whether something touches a fingertip. Taxels that get stuck later.

The skin spreads every load over adjacent taxels. So a taxel that reads much while the rest of its fingertip reads next
to nothing is stuck.
"""

import numpy as np

from dexsim.hand.kinematics import Hand
from dexsim_real.core.errors import HandError

_QUIET = 5.0  # counts up to which the other taxels of a fingertip read next to nothing
_ADJACENT = 2  # neighbours above the limit that make it a touch: three taxels in a patch
_MANY = 6  # stuck taxels of a fingertip with which it is of no use
_ANSWERS = 20  # in which a stuck taxel reads the same
_SAME = 1.0  # counts


def judge_rest(hand: Hand, counts: np.ndarray, limit: float, most: float) -> np.ndarray:
    """Judge fingertips that should touch nothing.

    Args:
      hand: names, and the lattice of the taxels.
      counts: [F, N] mean raw counts.
      limit: counts above which a taxel is stuck, or touched together with its neighbours.
      most: sum of a fingertip's counts above which it is touched; stuck taxels, which are masked, do not add to it.

    Returns:
      Mask [F, N] of stuck taxels.

    Raises:
      HandError: something touches a fingertip, or many of its taxels are stuck.
    """
    high = counts > limit
    beside = around(hand, high.astype(np.float32)).sum(0)
    total = np.where(high, 0.0, counts).sum(1)
    for finger, name in enumerate(hand.finger_names):
        patch = high[finger] & (beside[finger] > 0)
        if np.any(high[finger] & (beside[finger] >= _ADJACENT)):
            raise HandError(
                f"cannot tare the taxels: {patch.sum()} adjacent taxels of the {name} read above {limit:.0f} counts: "
                "something touches it; free the fingertips"
            )
        if total[finger] > most:
            raise HandError(
                f"cannot tare the taxels: those of the {name} read {total[finger]:.0f} counts together, limit "
                f"{most:.0f}: something touches it; free the fingertips, or power-cycle the hand. If they read as much "
                "untouched, raise --hardware.tare-sum"
            )
        if high[finger].sum() > _MANY:
            which = taxel_names(hand, high[finger])
            raise HandError(f"{name}: {high[finger].sum()} taxels are stuck: {which}; power-cycle the hand")
    return high


def taxel_names(hand: Hand, which: np.ndarray) -> str:
    """ "column 3 row 7, ..." of a mask [N], counted from 0 as in the layout file."""
    rows = hand.taxel_grid[1]
    named = [f"column {i // rows} row {i % rows}" for i in np.flatnonzero(which)]
    return ", ".join(named[:6]) + (f" and {len(named) - 6} more" if len(named) > 6 else "")


class StuckTaxels:
    """Finds taxels that get stuck in a run: above what a finger may press, the same for 20 answers, and nothing else on
    the fingertip reads anything.

    Beside a load a taxel may also saturate. A real load of that size makes `Safety` ease it, which changes the reading;
    what is stuck stays until the fingertip is free.
    """

    def __init__(self, hand: Hand):
        self._first = np.zeros((hand.num_fingers, hand.num_taxels), np.float32)  # counts
        self._answers = np.zeros(self._first.shape, int)

    def find(self, counts: np.ndarray, limit: np.ndarray) -> np.ndarray | None:
        """Update with tared counts [F, N] of an answer; returns the mask [F, N] of stuck taxels, None without any.

        Args:
          counts: 0 where a taxel reads no force.
          limit: [F, 1] counts that a finger may read.
        """
        same = (counts > limit) & (np.abs(counts - self._first) <= _SAME)
        self._first = np.where(same, self._first, counts)
        others = np.where(same, 0.0, counts).max(1, keepdims=True)
        self._answers = np.where(same & (others <= _QUIET), self._answers + 1, 0)
        stuck = self._answers >= _ANSWERS
        return stuck if stuck.any() else None


def around(hand: Hand, values: np.ndarray) -> np.ndarray:
    """Values [8, F, N] of the eight neighbours of each taxel, given values [F, N]; 0 beyond the lattice."""
    columns, rows = hand.taxel_grid
    padded = np.pad(values.reshape(-1, columns, rows), ((0, 0), (1, 1), (1, 1)))
    shifts = [(i, j) for i in range(3) for j in range(3) if (i, j) != (1, 1)]
    return np.stack([padded[:, i : i + columns, j : j + rows].reshape(values.shape) for i, j in shifts])
