"""The guard process: a runner that freezes, or that reaches its hand over a port of somebody's own."""

import os
import select
import signal
import time
from types import SimpleNamespace

import pytest

from dexsim_real.control.limits import SafetyConfig
from dexsim_real.control.safety import Safety
from dexsim_real.loop import LoopThread
from dexsim_real.sensors.hand import HandSensing, HardwareConfig
from dexsim_real.wire.frames import empty_state
from dexsim_real.wire.link import PATIENCE, HandPort, LinkCounts, Reply

pytest.importorskip("serial")
from following_hand import FollowingHand
from pty_hand import QUICK

from dexsim import load_hand
from dexsim_real.control import guard
from dexsim_real.control.guard import Guard
from dexsim_real.core.errors import HandError


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


def test_a_suspended_guard_is_noticed_within_a_second(peer, monkeypatch):
    patience = guard._ANSWER
    assert patience + guard._MOMENT < 1.0
    monkeypatch.setattr(guard, "_ANSWER", 20.0)  # A busy machine is not a suspended guard.
    watched = Guard(peer.port, QUICK, load_hand())
    try:
        assert select.select([watched._output], [], [], 20)[0]
        watched.check()  # A node asks before its motors come on.
        watched.arm()
        for _ in range(20):
            watched.beat()
            watched.check()
            time.sleep(0.02)
        until = time.monotonic() + 20
        while watched._asked is not None and time.monotonic() < until:
            watched.check()
        assert watched._asked is None, "it answers"
        os.kill(watched._process.pid, signal.SIGSTOP)
        monkeypatch.setattr(guard, "_ANSWER", patience)
        begin = time.monotonic()
        with pytest.raises(HandError, match="the guard process does not respond"):
            while time.monotonic() < begin + 10:
                watched.beat()
                watched.check()
                time.sleep(0.02)
    finally:
        watched._process.kill()


def test_the_guard_stops_a_hand_whose_driver_prints_exits_and_cannot_be_closed(peer, tmp_path, monkeypatch):
    """What it prints is no word of the guard's, and has no reader once the runner is gone."""
    (tmp_path / "loud_sdk.py").write_text(
        "import sys\n"
        "from dexsim_real.wire.driver import DriverState\n"
        "from dexsim_real.wire.frames import Mode, passive_command\n"
        "from dexsim_real.wire.serial_hand import SerialHand\n"
        "print('SDK 1.0', flush=True)\n"
        "opened = []\n"
        "class Loud:\n"
        "    measures = frozenset()\n"
        "    def __init__(self, *given):\n"
        "        self.hand = SerialHand(*given)\n"
        "    def send(self, targets):\n"
        "        assert not targets.on\n"
        "    def read(self):\n"
        "        reply = self.hand.exchange(passive_command())\n"
        "        return reply and DriverState(reply.state['joint']['position'], reply.state['joint']['id'] < 0)\n"
        "    def connect(self):\n"
        "        print('connecting', flush=True)\n"
        "        if len(opened) < 2:\n"
        "            sys.exit('not found')\n"
        "        return self.hand.connect()\n"
        "    def close(self):\n"
        "        self.hand.close()\n"
        "        raise RuntimeError('close failed')\n"
        "def open_hand(hand, config):\n"
        "    opened.append(config)\n"
        f"    return Loud({peer.port!r}, config)\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    armed = Guard("sdk:loud_sdk", QUICK, load_hand())
    armed.arm()
    armed.dismiss(off=False)
    assert armed._process.wait(10) == 0
    assert peer.commands and not peer.on().any()


def test_the_exchange_thread_gives_the_signs_of_life(hand):
    """Before every exchange, and once more with the time that turning the motors off may take."""
    events = []

    class Port(HandPort):
        counts = LinkCounts()

        def exchange(self, command):
            events.append("exchange")
            time.sleep(0.001)

        def close(self):
            pass

    safety = Safety(hand, SafetyConfig())
    guard = SimpleNamespace(beat=events.append, dismiss=lambda off: events.append(off))
    servo = LoopThread(Port(), HandSensing(hand, HardwareConfig()), safety, 500.0, guard)
    servo.driven = True
    servo.start()
    while events.count("exchange") < 20:
        time.sleep(0.001)
    Port.exchange = lambda self, command: events.append("answered") or Reply(empty_state(), 0.0, 0.0, 1, 1)
    servo.stop()
    last = events.index(PATIENCE)
    assert events[:last:2] == [0.0] * (last // 2) and set(events[1:last:2]) <= {"exchange"}
    assert events[last + 1 :] == ["answered", True]
