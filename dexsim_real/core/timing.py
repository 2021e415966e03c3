"""Absolute deadlines, and statistics of lateness."""

import math
import time
from collections.abc import Callable

import numpy as np

_BIN, _BINS = 1e-5, 5000  # s and number: the histogram ends at 50 ms
GRACE = 0.001  # s by which a cycle may begin late instead of being skipped


class Timing:
    """Statistics of durations in constant memory."""

    def __init__(self) -> None:
        self._bins = np.zeros(_BINS + 1, np.int64)
        self.count, self.missed, self.worst = 0, 0, 0.0

    def add(self, seconds: float) -> None:
        self._bins[min(int(max(seconds, 0.0) / _BIN), _BINS)] += 1
        self.count += 1
        self.worst = max(self.worst, seconds)

    def percentile(self, percent: float) -> float:
        """Percentile of the samples in s; NaN when there are none."""
        if not self.count:
            return float("nan")
        at = np.searchsorted(np.cumsum(self._bins), percent / 100 * self.count)
        return min((int(at) + 1) * _BIN, self.worst)

    def summary(self) -> dict[str, float]:
        """Percentiles in ms, number of samples, number of missed deadlines."""
        p50, p99 = self.percentile(50), self.percentile(99)
        return {
            "count": self.count,
            "missed": self.missed,
            "p50_ms": 1e3 * p50,
            "p99_ms": 1e3 * p99,
            "max_ms": 1e3 * self.worst,
        }


class Pace:
    """Absolute deadlines `start + k / rate`, rate in Hz, so a slow cycle does not shift the next one."""

    def __init__(
        self, rate: float, clock: Callable[[], float] = time.monotonic, sleep: Callable[[float], None] = time.sleep
    ):
        self.period, self._clock, self._sleep = 1.0 / rate, clock, sleep
        self.jitter = Timing()
        self.next = clock() + self.period

    def wait(self) -> None:
        """Sleep until the next deadline. One that passed by at most `GRACE` is kept; older ones are missed."""
        now = self._clock()
        # An exchange fills most of its period: skipping a deadline over a fraction of a millisecond costs a whole one.
        behind = max(math.ceil((now - self.next - GRACE) / self.period), 0)
        self.jitter.missed += behind
        self.next += behind * self.period
        self._sleep(max(self.next - now, 0.0))
        self.jitter.add(self._clock() - self.next)
        self.next += self.period


def keep_phase(rate: float, other: float) -> float:
    """`rate` rounded to a multiple of half of `other`, if that changes it by at most 1 %.

    Two loops with such rates keep one or two fixed phases to each other.
    """
    near = max(round(2 * rate / other), 1) * other / 2
    return near if abs(near - rate) <= 0.01 * rate else rate
