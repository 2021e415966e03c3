"""The bridge as a process: real-time priority of its threads, and signals that end it.

Threads of equal real-time priority do not preempt each other, so the exchange thread runs above the others and
disk and terminal output below them.
"""

import contextlib
import os
import signal
from collections.abc import Iterator
from typing import Any

_PRIORITY = 20
_STEP = 5


def use_realtime() -> bool:
    """Request real-time priority for this thread and those that it starts.

    All threads of the bridge need it, since they share one interpreter lock.

    Returns:
      Whether it was granted (docs/hardware.md says how to allow it).
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
    """Run this thread after the bridge's others, still before ordinary programs.

    No effect without real-time priority.
    """
    _change_priority(-_STEP)


def _change_priority(by: int) -> None:
    with contextlib.suppress(OSError, AttributeError):  # A priority above that of `use_realtime` may be refused.
        if os.sched_getscheduler(0) == os.SCHED_FIFO:
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(_PRIORITY + by))


@contextlib.contextmanager
def stopping() -> Iterator[None]:
    """Within this context SIGTERM and SIGHUP raise SystemExit(128 + number), and SIGINT raises KeyboardInterrupt.

    A shell starts background programs with SIGINT ignored. It is handled here nevertheless, so that a moving hand
    can always be interrupted.
    """
    handlers = {signal.SIGTERM: _terminate, signal.SIGHUP: _terminate, signal.SIGINT: signal.default_int_handler}
    before = {number: signal.signal(number, handler) for number, handler in handlers.items()}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _terminate(number: int, frame: Any) -> None:
    raise SystemExit(128 + number)
