"""The bridge as a process: real-time priority of its threads, and signals that end it.

Threads of equal real-time priority do not preempt each other, so the exchange thread runs above the others and
disk and terminal output below them.
"""

import contextlib
import os
import signal
from collections.abc import Iterator
from typing import Any

EXCHANGE, BACKGROUND = 5, -5
"""Priority of the exchange thread, and of threads that wait for disk, terminal or camera, relative to the others'."""
_PRIORITY = 20
_UNSUPPORTED = (OSError, AttributeError)  # not permitted; no such scheduler on this system


def use_realtime() -> bool:
    """Request real-time priority for this thread and those that it starts; returns whether it was granted.

    All threads of the bridge need it, since they share one interpreter lock.
    """
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(_PRIORITY))
    except _UNSUPPORTED:
        return False
    return True


def leave_realtime() -> None:
    """Return this thread to ordinary scheduling."""
    with contextlib.suppress(*_UNSUPPORTED):
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))


def change_priority(by: int) -> None:
    """Run this thread before the bridge's others (`EXCHANGE`) or after them. No effect without real-time priority."""
    with contextlib.suppress(*_UNSUPPORTED):  # A priority above that of `use_realtime` may be refused.
        if os.sched_getscheduler(0) == os.SCHED_FIFO:
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(_PRIORITY + by))


_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT, signal.SIGTSTP)
_armed = False  # whether a signal may still interrupt the program
_interrupted = False  # whether one has


@contextlib.contextmanager
def stopping(leaving: bool = False) -> Iterator[None]:
    """Within this context the first signal that would end or suspend the program interrupts it; later ones do nothing.

    SIGINT raises KeyboardInterrupt, also in a program that a shell started in the background, with SIGINT ignored.
    SIGTERM, SIGHUP, SIGQUIT and SIGTSTP (Ctrl-Z) raise SystemExit(128 + number). A second signal could otherwise
    interrupt what turns the motors off. `leaving`: the program ends afterwards, so if it was interrupted, it ignores
    signals from then on: a late one would kill it before its exit code is given.
    """
    global _armed, _interrupted
    before = {number: signal.signal(number, _interrupt) for number in _SIGNALS}
    _armed, _interrupted = True, False
    try:
        yield
    finally:
        _armed = False
        for number, handler in before.items():
            signal.signal(number, signal.SIG_IGN if leaving and _interrupted else handler)


def ignore_signals() -> None:
    """From now on no signal interrupts the program, up to the end of `stopping`: call it before the motors go off."""
    global _armed
    _armed = False


def _interrupt(number: int, frame: Any) -> None:
    global _armed, _interrupted
    if not _armed:
        return
    _armed, _interrupted = False, True
    if number == signal.SIGINT:
        raise KeyboardInterrupt
    raise SystemExit(128 + number)
