"""The bridge as a process: real-time priority of its threads, and signals that end it.

Threads of equal real-time priority do not preempt each other, so the exchange thread runs above the others and
disk and terminal output below them.
"""

import contextlib
import os
import signal
import threading
from collections.abc import Iterator
from typing import Any

_PRIORITY = 20
_STEP = 5


def use_realtime() -> bool:
    """Request real-time priority for this thread and those that it starts; returns whether it was granted.

    All threads of the bridge need it, since they share one interpreter lock.
    """
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(_PRIORITY))
    except (OSError, AttributeError):
        return False
    return True


def leave_realtime() -> None:
    """Return this thread to ordinary scheduling."""
    with contextlib.suppress(OSError, AttributeError):
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))


def raise_priority() -> None:
    """Run this thread before the bridge's others. No effect without real-time priority."""
    _change_priority(_STEP)


def lower_priority() -> None:
    """Run this thread after the bridge's others. No effect without real-time priority."""
    _change_priority(-_STEP)


def _change_priority(by: int) -> None:
    with contextlib.suppress(OSError, AttributeError):  # A priority above that of `use_realtime` may be refused.
        if os.sched_getscheduler(0) == os.SCHED_FIFO:
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(_PRIORITY + by))


@contextlib.contextmanager
def loading() -> Iterator[None]:
    """While modules load, Ctrl-C ends the program with one line: some modules abort, or show pages of their insides."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGINT, _leave)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


def _leave(number: int, frame: Any) -> None:
    os.write(2, b"interrupted\n")
    os._exit(128 + number)


_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT, signal.SIGTSTP)
_armed = False  # whether a signal may still interrupt the program
_interrupted = False  # whether one has


@contextlib.contextmanager
def stopping(leaving: bool = False) -> Iterator[None]:
    """Within this context the first signal that would end or suspend the program interrupts it; later ones do nothing.

    SIGTERM, SIGHUP, SIGQUIT and SIGTSTP (Ctrl-Z) raise SystemExit(128 + number), and SIGINT raises KeyboardInterrupt.
    A second one could otherwise interrupt what turns the motors off. A shell starts background programs with SIGINT
    ignored. It is handled here nevertheless, so that a moving hand can always be interrupted.

    `leaving` says that the program ends afterwards: if it was interrupted, it ignores signals from then on, since a
    late one would kill it before its exit code is given.
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
