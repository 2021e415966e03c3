"""Which of the bridge's threads the machine runs first, and Ctrl-C before there are any."""

import os
import subprocess
import sys
import threading
import time

import pytest
from paths import ROOT

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
        del command
        self.asked.set()
        self.end.wait(5)

    def close(self):
        pass


def in_thread(work):
    """What `work` returns in a thread of its own, whose priority ends with it."""
    result = []
    thread = threading.Thread(target=lambda: result.append(work()))
    thread.start()
    thread.join()
    return result[0]


def priorities(folder):
    """Of the thread that exchanges, of this one and of the log's."""
    if not use_realtime():
        return None
    hand, port = load_hand(), Silent()
    with LogWriter(folder / "run.log") as log:
        servo = LoopThread(
            port, HandSensing(hand, HardwareConfig()), Safety(hand, SafetyConfig(), lambda text: None), 83.0
        )
        servo.start()
        assert port.asked.wait(5)
        priority = lambda thread: os.sched_getparam(thread).sched_priority  # noqa: E731
        end = time.monotonic() + 5
        while priority(log._thread.native_id) == priority(0) and time.monotonic() < end:
            time.sleep(0.01)  # Its first act may be still to come.
        found = [priority(thread) for thread in (servo._thread.native_id, 0, log._thread.native_id)]
        port.end.set()
        servo.stop()
    return found


def test_exchanges_come_first_and_the_log_last(tmp_path):
    found = in_thread(lambda: priorities(tmp_path))
    if found is None:
        pytest.skip("real-time priority is not allowed here")
    assert found[0] > found[1] > found[2] > 0


@pytest.mark.parametrize("module", ["dexsim_real.run", "dexsim_real.replay"])
def test_ctrl_c_while_modules_load_is_one_line(module):
    script = f"""
import os, runpy, signal, sys

class Interrupt:
    def find_spec(self, name, path=None, target=None):
        if name == "jax":
            os.kill(os.getpid(), signal.SIGINT)

sys.meta_path.insert(0, Interrupt())
runpy.run_module({module!r}, run_name="__main__")
"""
    done = subprocess.run([sys.executable, "-c", script], cwd=ROOT, capture_output=True, text=True, timeout=120)
    assert (done.returncode, done.stderr) == (130, "interrupted\n")
