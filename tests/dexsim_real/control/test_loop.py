"""The exchange loop's end: how long a hand is told to turn its motors off, by whether they may be on."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest
from test_safety import AGREEING, CYCLE, MIDDLE

from dexsim_real.control.limits import SafetyConfig
from dexsim_real.control.safety import Reaction, Safety
from dexsim_real.loop import LoopThread
from dexsim_real.sensors.hand import HandSensing, HardwareConfig
from dexsim_real.wire import frames
from dexsim_real.wire.frames import Mode
from dexsim_real.wire.link import PATIENCE, HandPort, LinkCounts, Reply


class Hand(HandPort):
    """Answers at once, or not at all until a time; a clock of its own that every exchange moves on."""

    def __init__(self):
        self.counts, self.now, self.silent_until, self.modes, self.closed = LinkCounts(), 100.0, 0.0, [], False

    def exchange(self, command):
        sent, self.now = self.now, self.now + CYCLE
        if sent < self.silent_until:
            return None
        self.modes.append(int(command["mode"][0]))
        state = frames.empty_state()
        state["joint"]["position"] = MIDDLE
        return Reply(state, sent, self.now, len(self.modes), 1)

    def close(self):
        self.closed = True


@pytest.fixture
def loop(hand, monkeypatch):
    """Its cycles are called one by one, in the clock of its hand."""
    port = Hand()
    clock = SimpleNamespace(monotonic=lambda: port.now)
    monkeypatch.setattr("dexsim_real.wire.link.time", clock)
    monkeypatch.setattr("dexsim_real.loop.ignore_signals", lambda: None)
    safety = Safety(hand, SafetyConfig())
    return LoopThread(port, HandSensing(hand, HardwareConfig()), safety, 1 / CYCLE, clock=clock.monotonic)


def run(loop, cycles):
    for _ in range(cycles):
        loop.safety.set_target(MIDDLE, loop.port.now)
        loop.cycle()


@pytest.mark.parametrize(("on", "silence", "confirmed"), [(True, 4.0, True), (True, 7.0, False), (False, 4.0, False)])
def test_a_hand_that_is_on_and_silent_is_told_for_five_seconds(loop, on, silence, confirmed):
    """One that is off already delays the end by a third of a second only."""
    assert PATIENCE == 5.0
    run(loop, AGREEING)
    if on:
        loop.engage()
        run(loop, 5)
    port = loop.port
    assert port.modes[-1] == (Mode.POSITION if on else Mode.PASSIVE)
    port.silent_until = began = port.now
    port.silent_until += silence
    loop.stop()
    assert port.closed and loop.driven == (on and not confirmed)
    assert (port.modes[-1] == Mode.PASSIVE) == (confirmed or not on)
    assert port.now - began == pytest.approx(silence if confirmed else 5.0 if on else 0.3, abs=0.1)


def test_a_command_without_an_answer_may_have_turned_the_motors_on(loop):
    run(loop, AGREEING)
    loop.engage()
    loop.port.silent_until = loop.port.now + 2 * CYCLE
    assert not loop.driven
    run(loop, 1)
    assert loop.driven and Mode.POSITION not in loop.port.modes
    run(loop, 5)
    assert loop.driven and loop.port.modes[-1] == Mode.POSITION
    loop.safety.relax("enough")
    run(loop, 1)
    assert not loop.driven
    loop.stop()
    assert not loop.driven and loop.port.modes[-1] == Mode.PASSIVE


def test_the_velocity_knows_no_wrong_reading_and_begins_anew_with_a_connection(loop):
    """A reading of 1e30 leaves no trace; a hand that was moved while it was away is not a fast one."""
    run(loop, 5)
    far, exchange = frames.empty_state(), loop.port.exchange
    far["joint"]["position"] = np.where(np.arange(12) == 4, np.float32(1e30), MIDDLE)
    loop.port.exchange = lambda command: dataclasses.replace(exchange(command), state=far)
    run(loop, 1)
    loop.port.exchange = exchange
    run(loop, 5)
    assert loop.safety.counts["implausible: measurement"] == 1
    np.testing.assert_allclose(loop.safety.sample.velocity, 0.0, atol=1e-6)
    far["joint"]["position"] = MIDDLE + np.float32(0.1)
    for number in (20, 21):
        sample = loop._sample(Reply(far, loop.port.now, loop.port.now + CYCLE, number, 2))
        np.testing.assert_array_equal(sample.velocity, 0.0)


def test_a_hand_that_was_silent_when_it_was_told_to_turn_off_may_still_be_on(loop):
    run(loop, AGREEING)
    loop.engage()
    run(loop, 5)
    loop.port.silent_until = loop.port.now + 3.0
    run(loop, round(2.0 / CYCLE))
    assert loop.safety.last[0] == Reaction.RELAX, "long silent: the commands are to turn off"
    assert loop.driven
    loop.stop()
    assert not loop.driven and loop.port.modes[-1] == Mode.PASSIVE


def test_who_keeps_the_log_is_told_when_a_zero_has_moved(loop):
    """From the exchange on whose measurement is the first with the new zero: a replay uses it from there."""
    told, tares = [], []
    loop.retared = lambda sequence, lines: told.append((sequence, lines, loop.sensing.tare.copy()))
    warm, exchange = frames.empty_state(), loop.port.exchange
    warm["joint"]["position"] = MIDDLE
    warm["tip"]["taxel"]["z"][3, 60] = 1

    loop.port.exchange = lambda command: dataclasses.replace(exchange(command), state=warm)
    for _ in range(round(6.0 / CYCLE)):
        loop.cycle()
        tares.append(loop.sensing.tare[3, 60])
    ((sequence, lines, tare),) = told
    assert tare[3, 60] == 1.0 and tare.sum() == 1.0 and lines == []
    assert tares[sequence - 2 : sequence] == [0.0, 1.0]
    assert loop.safety.sample.measured.finger_force[3] == 0.0
