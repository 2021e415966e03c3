"""A signal at the worst moment of a calibration: just before the motors go off, and while they do."""

import os
import signal
import time

import numpy as np
import pytest
from calibrating import QUICK, arguments, off, on, plates, record
from press_bench import BenchHand

from dexsim_real.calibrate.hand_loop import HandLoop
from dexsim_real.core.log import Kind, LogReader
from dexsim_real.wire.frames import Mode


class Broken(BenchHand):
    """The procedure fails early in its first press; `stopped` is called at the first command to turn the motors off."""

    def __init__(self, hand, stopped=lambda: None):
        super().__init__(hand, plates(hand, "index pad"))
        self.stopped, self.presses, self.was_on = stopped, 0, False

    def exchange(self, command):
        on = bool(np.all(command["mode"] == Mode.POSITION))
        if self.was_on and not on:
            self.was_on = False
            self.stopped()
        self.was_on |= on
        self.presses += self.force[1] > 0.5
        if self.presses == 5:
            self.presses += 1
            raise RuntimeError("broken")
        return super().exchange(command)


def interrupt():
    os.kill(os.getpid(), signal.SIGINT)
    time.sleep(0.01)  # The interpreter handles it here.


def test_a_signal_just_before_the_motors_go_off_does_not_keep_them_on(hand, tmp_path, monkeypatch):
    close, calls = HandLoop.close, []

    def interrupted(loop):
        calls.append(loop.driven)
        if len(calls) == 1:
            interrupt()
        close(loop)

    monkeypatch.setattr(HandLoop, "close", interrupted)
    bench = Broken(hand)
    with pytest.raises(KeyboardInterrupt):
        record(bench, hand, arguments(tmp_path, press=QUICK))
    assert calls == [True, True] and on(bench).any() and off(bench) and bench.closed
    assert [entry.kind for entry in LogReader(tmp_path / "hand.log")][-1] == Kind.END


def test_a_signal_while_the_motors_go_off_is_ignored(hand, tmp_path):
    seen = []

    def during():
        seen.append("signal")
        interrupt()

    bench = Broken(hand, during)
    with pytest.raises(RuntimeError, match="broken"):
        record(bench, hand, arguments(tmp_path, press=QUICK))
    assert seen == ["signal"] and on(bench).any() and off(bench) and bench.closed
