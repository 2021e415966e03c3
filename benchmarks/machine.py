"""Finds the times in which the machine ran no program, to exclude them from timing benchmarks.

On each core a sentinel with a higher priority than the measured programs wakes twice a millisecond. What delays it (a
hypervisor, the kernel, firmware) delays everything on that core.
"""

import gc
import json
import os
import signal
import subprocess
import sys
import time

import numpy as np

STEP = 0.0005  # s between two wake-ups
GAP = 0.0003  # s, delay of a wake-up above which the core counts as away; several must not fill a cycle's slack
PRIORITY = 90


class Away:
    """Watches every core of this process while the block runs; then `intervals` [N, 2] s (monotonic clock), merged.

    Without the permission for real-time priority (`allowed`, docs/hardware.md) it watches nothing.
    """

    def __enter__(self) -> "Away":
        self._sentinels, self._begin = [], 0.0
        try:
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(PRIORITY))  # The sentinels inherit it.
        except OSError:
            self.allowed = False
            return self
        self.allowed = True
        try:
            self._sentinels = [
                subprocess.Popen([sys.executable, __file__, str(core)], stdout=subprocess.PIPE)
                for core in sorted(os.sched_getaffinity(0))
            ]
        finally:
            os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
        for process in self._sentinels:
            process.stdout.readline()  # It watches from now on.
        self._begin = time.monotonic()  # Before, starting sentinels took the cores from others.
        return self

    def __exit__(self, *_) -> None:
        found = []
        for process in self._sentinels:
            process.send_signal(signal.SIGTERM)
            found += json.loads(process.communicate(timeout=10)[0])
        self.intervals = merged([span for span in found if span[0] > self._begin])

    def summary(self) -> dict[str, float]:
        """Number and duration of the intervals."""
        lengths = self.intervals[:, 1] - self.intervals[:, 0]
        return {
            "watched": self.allowed,
            "times": len(lengths),
            "seconds": round(float(lengths.sum()), 3),
            "longest_ms": round(1e3 * float(lengths.max(initial=0.0)), 1),
        }


def merged(intervals: list) -> np.ndarray:
    """The union of intervals as disjoint, ordered intervals [N, 2]."""
    union: list[list[float]] = []
    for begin, end in sorted(intervals):
        if union and begin <= union[-1][1]:
            union[-1][1] = max(union[-1][1], end)
        else:
            union.append([begin, end])
    return np.reshape(np.array(union, float), (-1, 2))


def overlaps(begin: np.ndarray, end: np.ndarray, intervals: np.ndarray) -> np.ndarray:
    """Whether [begin, end] [K] meets any of the disjoint, ordered intervals [N, 2]: bool [K]."""
    # The first interval that ends after `begin` is the only one that can begin before `end` first.
    first = np.searchsorted(intervals[:, 1], begin)
    starts = np.append(intervals[:, 0], np.inf)
    return starts[first] <= end


def own_timing(
    due: np.ndarray, met: np.ndarray, period: float, intervals: np.ndarray, others: np.ndarray | None = None
) -> dict[str, float]:
    """Lateness and missed deadlines of a loop in the cycles in which the machine let it run.

    Args:
      due: [K] s, deadlines that the loop kept, in order.
      met: [K] s, when it continued after each.
      intervals: [N, 2] s, when a core was away; a cycle that overlaps one, or should have begun in one, is excluded;
        `left_out` is the share of such cycles.
      others: [K] number of deadlines missed before each for other reasons.
    """
    held_up = overlaps(due[:-1], met[1:], intervals)
    late, missed = (met - due)[1:], np.rint(np.diff(due) / period).astype(int) - 1
    if others is not None:
        missed = missed - others[1:]
    mine = late[~held_up]
    return {
        "count": len(mine),
        "left_out": round(float(np.mean(held_up)), 4),
        "missed": int(missed[~held_up].sum()),
        **{f"p{q}_ms": round(1e3 * float(np.percentile(mine, q)), 3) for q in (50, 99)},
        "max_ms": round(1e3 * float(mine.max()), 3),
    }


def watch(core: int) -> None:
    """Watch a core until SIGTERM, then print the intervals in which it was away."""
    found, done = [], []
    os.sched_setaffinity(0, {core})
    signal.signal(signal.SIGTERM, lambda *_: done.append(True))
    gc.disable()
    print(flush=True)
    due = time.monotonic()
    while not done:
        due += STEP
        time.sleep(max(due - time.monotonic(), 0.0))
        now = time.monotonic()
        if now - due > GAP:
            found.append((due, now))
            due = now
    print(json.dumps(found))


if __name__ == "__main__":
    watch(int(sys.argv[1]))
