"""Which of the bridge's threads the machine runs first."""

import os
import threading
import time

import pytest

from dexsim import load_hand
from dexsim_real.control.limits import SafetyConfig
from dexsim_real.control.safety import Safety
from dexsim_real.core.log import LogWriter
from dexsim_real.core.process import use_realtime
from dexsim_real.loop import LoopThread
from dexsim_real.sensors.hand import HandSensing, HardwareConfig


class Silent:
    """A port at which nothing answers until told to end."""

    def __init__(self):
        self.asked, self.end = threading.Event(), threading.Event()

    def exchange(self, command):
        self.asked.set()
        self.end.wait(5)

    def close(self):
        pass


def priorities(folder, result):
    """Of the thread that exchanges, of this one and of the log's."""
    if not use_realtime():
        return
    hand, port = load_hand(), Silent()
    with LogWriter(folder / "run.log") as log:
        loop = LoopThread(port, HandSensing(hand, HardwareConfig()), Safety(hand, SafetyConfig()), 83.0)
        loop.start()
        assert port.asked.wait(5)
        priority = lambda thread: os.sched_getparam(thread).sched_priority  # noqa: E731
        end = time.monotonic() + 5
        while priority(log._thread.native_id) == priority(0) and time.monotonic() < end:
            time.sleep(0.01)  # Its first act may be still to come.
        result += [priority(thread) for thread in (loop._thread.native_id, 0, log._thread.native_id)]
        port.end.set()
        loop.stop()


def test_exchanges_come_first_and_the_log_last(tmp_path):
    result = []
    thread = threading.Thread(target=priorities, args=(tmp_path, result))  # Its priority ends with it.
    thread.start()
    thread.join()
    if not result:
        pytest.skip("real-time priority is not allowed here")
    assert result[0] > result[1] > result[2] > 0
