"""A signal at the worst moment of a calibration: just before the motors go off, and while they do; Ctrl-D at any."""

import io
import os
import signal
import time

import numpy as np
import pytest
from calibrating import QUICK, arguments, off, on, plates, record
from press_bench import BenchHand
from rich.console import Console

from dexsim_real.calibrate.hand_loop import HandLoop, Operator
from dexsim_real.core.errors import HandError
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


class Terminal:
    """One line is typed, then Ctrl-D, or the terminal hangs up."""

    def __init__(self, end):
        self.lines, self.end = ["\n"], end

    def isatty(self):
        return True

    def __iter__(self):
        return self

    def __next__(self):
        if self.lines:
            return self.lines.pop()
        raise self.end


@pytest.mark.parametrize("end", [StopIteration(), OSError(5, "hung up")])
def test_the_end_of_the_input_between_two_questions_is_the_end_of_the_second(end):
    who, cycles = Operator(Console(file=io.StringIO()), stream=Terminal(end)), []

    def wait():
        cycles.append(time.sleep(0.005))
        assert len(cycles) < 400, "nobody will answer"

    assert who.ask("Enter presses", wait) == ""
    who._reader.join(5.0)
    for _ in range(2):
        with pytest.raises(HandError, match="nobody can answer: standard input is closed"):
            who.ask("Enter presses", wait)
