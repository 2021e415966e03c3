"""The guard process: a runner that freezes, or that reaches its hand over a port of somebody's own."""

import os
import select
import signal
import time

import pytest

pytest.importorskip("serial")
from following_hand import FollowingHand
from pty_hand import QUICK

from dexsim_real.core.errors import HandError
from dexsim_real.run import guard
from dexsim_real.run.guard import Guard


@pytest.fixture
def peer():
    with FollowingHand() as peer:
        yield peer


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


def test_a_suspended_guard_is_noticed_within_a_second(peer):
    watched = Guard(peer.port, QUICK)
    watched.arm()
    try:
        for _ in range(20):
            watched.beat()
            watched.check()
            time.sleep(0.02)
        os.kill(watched._process.pid, signal.SIGSTOP)
        begin = time.monotonic()
        with pytest.raises(HandError, match="the guard process does not respond"):
            while time.monotonic() < begin + 10:
                watched.beat()
                watched.check()
                time.sleep(0.02)
        assert guard._ANSWER + guard._MOMENT < 1.0, "s, on a machine that is not busy"
    finally:
        watched._process.kill()
