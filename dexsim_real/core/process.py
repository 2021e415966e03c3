"""Real-time priority, and which of the bridge's threads comes first."""

import contextlib
import os
import signal
from collections.abc import Iterator
from typing import Any

_PRIORITY = 20
_STEP = 5


def use_realtime() -> bool:
    """Give this thread, and those that it starts, precedence over ordinary programs.

    All threads of the bridge should have it, since they share one interpreter lock. False where the
    user may not (docs/hardware.md says how to allow it).
    """
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(_PRIORITY))
    except (OSError, AttributeError):
        return False
    return True


def raise_priority() -> None:
    """Put this thread before the bridge's others; no effect without real-time priority."""
    _shift(_STEP)


def lower_priority() -> None:
    """Put this thread behind the bridge's others, still before ordinary programs; without real-time
    priority it has no effect.

    Threads of one priority do not interrupt each other: an exchange would wait for the kernel to end a
    write to the disk.
    """
    _shift(-_STEP)


def _shift(by: int) -> None:
    with contextlib.suppress(OSError, AttributeError):  # More than `use_realtime` had may not be allowed.
        if os.sched_getscheduler(0) == os.SCHED_FIFO:
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(_PRIORITY + by))


@contextlib.contextmanager
def stopping() -> Iterator[None]:
    """SIGTERM and SIGHUP raise SystemExit(128 + number), SIGINT raises KeyboardInterrupt.

    Also SIGINT where a shell has us ignore it, as it does with what runs in the background: whoever
    interrupts a moving hand means it.
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
