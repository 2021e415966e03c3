"""Whatever ends a run, the motors go off: signals, a lost cable, SIGKILL, a frozen runner. The hand has no watchdog."""

import contextlib
import os
import random
import select
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
from following_hand import FollowingHand, arguments, summary
from paths import ROOT
from pty_hand import QUICK

from dexsim import load_hand
from dexsim_real.control import guard
from dexsim_real.control.guard import Guard
from dexsim_real.core.errors import HandError
from dexsim_real.core.process import ignore_signals, stopping

pytest.importorskip("serial")


def wait(condition, seconds=60.0):
    until = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < until
        time.sleep(0.01)


@contextlib.contextmanager
def moving(folder, *without):
    """A runner whose motors are on, and its hand. As shells start what runs in the background: with Ctrl-C ignored."""
    shell = ["sh", "-c", "trap '' INT; exec \"$@\"", "sh", sys.executable, "-m", "dexsim_real.run"]
    with FollowingHand() as peer:
        options = [word for word in arguments(peer, folder, "--seconds", "60") if word not in without]
        process = subprocess.Popen([*shell, *options], cwd=ROOT, stderr=subprocess.PIPE)
        try:
            wait(lambda: peer.on().sum() > 60 or process.poll() is not None)
            assert process.poll() is None, process.stderr.read()
            yield peer, process
        finally:
            process.kill()
            process.communicate()


@pytest.mark.parametrize("number", [signal.SIGINT, pytest.param(signal.SIGTSTP, marks=pytest.mark.slow)])
def test_signals_in_a_row_turn_the_motors_off(tmp_path, number):
    """The second and later ones come while the first is handled, whose exit code it is."""
    with moving(tmp_path) as (peer, process):
        later = max(number, signal.SIGTERM)  # Python handles signals that wait together by number.
        for each in (number, later, later):
            process.send_signal(each)
            time.sleep(random.uniform(0.001, 0.006))
        assert process.wait(60) == 128 + number
        on = peer.on().astype(int)
        assert not on[-1] and np.sum(np.diff(on) > 0) == 1, "off once and for all"
    report = summary(tmp_path)
    assert report["motors_off"]
    assert ("Ctrl-C" if number == signal.SIGINT else f"signal {int(number)}") in report["end"]


def test_only_the_first_signal_interrupts():
    interrupted = []
    with stopping():
        try:
            os.kill(os.getpid(), signal.SIGQUIT)
            time.sleep(1)
        except SystemExit as stop:
            for number in (signal.SIGINT, signal.SIGTERM, signal.SIGTSTP, signal.SIGHUP):
                os.kill(os.getpid(), number)
                time.sleep(0.01)
            interrupted.append(stop.code)
    with stopping():
        ignore_signals()
        os.kill(os.getpid(), signal.SIGINT)
        time.sleep(0.01)
        interrupted.append("not")
    assert interrupted == [128 + signal.SIGQUIT, "not"]


def test_the_stop_is_repeated_until_the_cable_is_back(tmp_path):
    """Interrupted while the cable is out: the motors go off when it returns, a second later. The guard lets it try."""
    with moving(tmp_path, "--no-guard") as (peer, process):
        peer.close()
        time.sleep(0.2)
        process.send_signal(signal.SIGINT)
        time.sleep(1.0)
        assert process.poll() is None
        peer.open()
        asked = len(peer.commands)
        assert process.wait(60) == 130
        assert len(peer.commands) > asked and not peer.on()[asked:].any()
    assert summary(tmp_path)["motors_off"]


@pytest.mark.slow
def test_a_hand_that_never_confirms_is_named_and_left_to_the_guard(tmp_path):
    with moving(tmp_path, "--no-guard") as (peer, process):
        peer.close()
        process.send_signal(signal.SIGINT)
        assert process.wait(30) == 1
        asked = len(peer.commands)
        peer.open()
        wait(lambda: len(peer.commands) > asked)
        assert not peer.on()[asked:].any()
    report = summary(tmp_path)
    assert not report["motors_off"] and "press the emergency stop" in report["end"]


@pytest.mark.parametrize("way", [signal.SIGKILL, pytest.param(signal.SIGSTOP, marks=pytest.mark.slow)])
def test_the_guard_stops_the_hand_of_a_runner_that_was_killed_or_suspended(tmp_path, way):
    with moving(tmp_path, "--no-guard") as (peer, process):
        process.send_signal(way)
        process.wait(60)
        wait(lambda: not peer.on()[-1])


def test_the_guard_waits_for_a_cable():
    with FollowingHand() as peer:
        peer.close()
        guard = Guard(peer.port, QUICK, load_hand())
        guard.arm()
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            guard._process.send_signal(number)  # It ignores them.
        guard.check()
        guard.dismiss(off=False)
        time.sleep(1.0)
        peer.open()
        wait(lambda: len(peer.commands) > 0)
        assert not peer.on().any()
        assert guard._process.wait(60) == 0


def test_the_guard_leaves_a_hand_alone_whose_motors_were_never_on():
    near, far = os.pipe()
    os.close(far)
    assert guard._watch(near, os.open(os.devnull, os.O_WRONLY)) == ""


def test_only_the_runner_that_started_the_guard_is_killed(monkeypatch):
    """Once it has ended, its number may be another's. The guard waits until the kernel has closed its files."""
    for others in (True, False):
        with subprocess.Popen(["sleep", "60"], stdout=subprocess.PIPE) as runner:
            monkeypatch.setattr(guard, "_DEATH", 0.05 if others else 20.0)
            monkeypatch.setattr(os, "getppid", lambda pid=runner.pid, others=others: pid + others)
            guard._kill(runner.pid, runner.stdout.fileno())
            with contextlib.suppress(subprocess.TimeoutExpired):
                runner.wait(0.2 if others else 20.0)
            assert runner.returncode == (None if others else -signal.SIGKILL)
            runner.kill()


def test_the_guard_does_not_say_that_motors_are_off_which_it_cannot_reach(tmp_path, monkeypatch):
    monkeypatch.setattr(guard, "_PATIENCE", 0.1)
    assert guard._stop(str(tmp_path / "port"), QUICK, load_hand()) is False


@pytest.mark.parametrize("wakes", [True, False])
def test_a_machine_that_paused_gets_a_second_look(monkeypatch, wakes):
    """When all of it stood still, the runner's sign is overdue as the guard wakes, and comes a moment later."""
    near, far = os.pipe()
    os.write(far, b"0.05\n")
    real, looks = select.select, []

    def look(read, write, error, seconds):
        looks.append(seconds)
        if len(looks) == 3 and wakes:
            os.write(far, b"off\n")
            os.close(far)
        return real(read, write, error, seconds)

    monkeypatch.setattr(guard.select, "select", look)
    assert guard._watch(near, os.open(os.devnull, os.O_WRONLY)) == ("" if wakes else guard._FROZEN)
    assert looks[2] == guard._MOMENT


def test_a_suspended_guard_is_noticed_within_a_second(tmp_path, monkeypatch):
    patience, moment = guard._ANSWER, guard._MOMENT
    assert patience + moment < 1.0
    # A busy machine is not a suspended guard: each answer is late, and comes at the second look.
    monkeypatch.setattr(guard, "_ANSWER", 0.0)
    monkeypatch.setattr(guard, "_MOMENT", 20.0)
    watched = Guard(str(tmp_path / "port"), QUICK, load_hand())
    try:
        assert select.select([watched._output], [], [], 20)[0]
        assert 1.5 <= watched._allowed < 3.0, "s for which a runner may stand still: longer than a slow hand's answers"
        watched.check()  # A node asks before its motors come on.
        watched.arm()
        for _ in range(20):
            watched.beat()
            watched.check()
            time.sleep(0.02)
        os.kill(watched._process.pid, signal.SIGSTOP)
        monkeypatch.setattr(guard, "_ANSWER", patience)
        monkeypatch.setattr(guard, "_MOMENT", moment)
        begin = time.monotonic()
        with pytest.raises(HandError, match="the guard process does not respond"):
            while time.monotonic() < begin + 10:
                watched.beat()
                watched.check()
                time.sleep(0.02)
    finally:
        watched._process.kill()


LOUD = """
import sys
from scripted_driver import ScriptedDriver

print("SDK 1.0", flush=True)
opened = []

class Loud(ScriptedDriver):
    def connect(self):
        print("connecting", flush=True)
        if len(opened) < 2:
            sys.exit("not found")

    def send(self, targets):
        super().send(targets)
        with open({path!r}, "a") as file:
            print(targets.on, file=file)

    def close(self):
        raise RuntimeError("close failed")

def open_hand(hand, config):
    opened.append(config)
    return Loud(hand)
"""


def test_the_guard_stops_a_hand_whose_driver_prints_exits_and_cannot_be_closed(tmp_path, monkeypatch):
    """What it prints is no word of the guard's, and has no reader once the runner is gone."""
    heard = tmp_path / "heard"
    (tmp_path / "loud_sdk.py").write_text(LOUD.format(path=str(heard)))
    monkeypatch.syspath_prepend(tmp_path)
    armed = Guard("sdk:loud_sdk", QUICK, load_hand())
    armed.arm()
    armed.dismiss(off=False)
    assert armed._process.wait(60) == 0
    assert set(heard.read_text().split()) == {"False"}
