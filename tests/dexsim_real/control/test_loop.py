"""The exchange loop: refusals of the hand, and how long it is told to turn its motors off."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, strategies as st
from test_safety import AGREEING, CYCLE, MIDDLE

from dexsim_real.control.limits import SafetyConfig
from dexsim_real.control.safety import Reaction, Safety
from dexsim_real.core.errors import HandError
from dexsim_real.loop import GRACE, LoopThread, Pace
from dexsim_real.sensors.hand import HandSensing, HardwareConfig
from dexsim_real.wire import frames
from dexsim_real.wire.frames import Mode
from dexsim_real.wire.link import PATIENCE, HandPort, LinkCounts, Refusal, Reply, read_refusal


class Hand(HandPort):
    """Answers at once, refuses by its `plan`, or is silent until a time; a clock of its own that exchanges move on."""

    def __init__(self):
        self.counts, self.now, self.silent_until, self.modes, self.closed = LinkCounts(), 100.0, 0.0, [], False
        self.plan = []

    def exchange(self, command):
        sent, self.now = self.now, self.now + CYCLE
        step = self.plan.pop(0) if self.plan else "state"
        self.refusal = step if isinstance(step, Refusal) else None
        if isinstance(step, BaseException):
            raise step
        if sent < self.silent_until or step not in ("state", "late"):
            return step if isinstance(step, bool) else None
        self.modes.append(int(command["mode"][0]))
        state = frames.empty_state()
        state["joint"]["position"] = MIDDLE
        state["joint"]["raw_position"] = Mode.POSITION if step == "late" else command["mode"]
        return Reply(state, sent, self.now, len(self.modes), 1)

    def close(self):
        self.closed = True


@pytest.fixture
def loop(hand, monkeypatch):
    """Its cycles are called one by one, in the clock of its hand."""
    port = Hand()
    clock = SimpleNamespace(monotonic=lambda: port.now, sleep=lambda seconds: None)
    monkeypatch.setattr("dexsim_real.wire.link.time", clock)
    monkeypatch.setattr("dexsim_real.loop.ignore_signals", lambda: None)
    safety = Safety(hand, SafetyConfig())
    return LoopThread(port, HandSensing(hand, HardwareConfig()), safety, 1 / CYCLE, clock=clock.monotonic)


def run(loop, cycles):
    """The reactions and their reasons."""
    reactions = []
    for _ in range(cycles):
        loop.safety.set_target(MIDDLE, loop.port.now)
        loop.cycle()
        reactions.append(loop.safety.last)
    return reactions


def test_a_busy_hand_is_held_then_relaxed_and_the_reason_is_shown(loop):
    """Silent first, then busy: the silence counts from its beginning."""
    run(loop, AGREEING)
    loop.engage()
    loop.port.plan = ["state"] * 25 + [None] * 50 + [read_refusal(b"\x06\x00")] * 100
    reactions = run(loop, 150)
    assert not loop.safety.latched
    assert reactions[-1] == (Reaction.RELAX, "no measurement: the hand reports busy (1501006)")
    held = [reaction for reaction, _ in reactions].count(Reaction.HOLD)
    assert 0.9 < held * CYCLE < 1.1 and (Reaction.HOLD, "no measurement") in reactions


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


def test_the_guard_is_armed_gets_signs_of_life_and_is_told_whether_the_motors_are_off(loop):
    """Before every exchange, and once more with the time that turning the motors off may take."""

    def fail():
        raise HandError("the guard")

    told, signs, begin = [], [], loop.port.now
    beat = lambda more=0.0: signs.append((more, loop.port.now))  # noqa: E731
    loop.guard = SimpleNamespace(beat=beat, dismiss=lambda off: told.append(off), check=fail, arm=fail)
    run(loop, AGREEING)
    for call in (loop.engage, loop.check):
        with pytest.raises(HandError, match="the guard"):
            call()
    run(loop, 1)
    assert not loop.safety.engaged
    loop.guard.arm = lambda: None
    loop.engage()
    run(loop, 2)
    assert [sign for sign, _ in signs] == [0.0] * (AGREEING + 3)
    np.testing.assert_allclose([now for _, now in signs], begin + CYCLE * np.arange(AGREEING + 3))
    loop.port.silent_until = loop.port.now + 9.0
    loop.stop()
    assert signs[AGREEING + 3][0] == PATIENCE and told == [False] and loop.driven


def test_a_driver_that_fails_is_asked_again_and_only_a_reply_confirms(loop):
    """A procedure has no guard process: an error of the driver must not leave the motors on."""
    port, off, gone = loop.port, frames.passive_command(), OSError("the adapter is gone")
    port.plan = [gone, None, False, "late", SystemExit(1)]
    assert port.turn_off(off, 5.0) and not port.plan
    for answer in (gone, False, True):
        port.plan = [answer] * 100
        assert not port.turn_off(off, 0.05)


def test_a_command_without_an_answer_may_have_turned_the_motors_on_and_may_not_have_turned_them_off(loop):
    run(loop, AGREEING)
    loop.engage()
    loop.port.silent_until = loop.port.now + 2 * CYCLE
    assert not loop.driven
    run(loop, 1)
    assert loop.driven and Mode.POSITION not in loop.port.modes
    run(loop, 5)
    assert loop.driven and loop.port.modes[-1] == Mode.POSITION
    loop.port.silent_until = loop.port.now + 3.0
    run(loop, round(2.0 / CYCLE))
    assert loop.safety.last[0] == Reaction.RELAX, "long silent: the commands are to turn off"
    assert loop.driven
    loop.port.now, loop.port.plan = loop.port.silent_until, ["late"]
    run(loop, 1)
    assert loop.driven, "an answer to a command of before"
    run(loop, 1)
    assert not loop.driven, "it has answered"
    loop.stop()
    assert not loop.driven and loop.port.modes[-1] == Mode.PASSIVE


def test_the_velocity_is_filtered(loop):
    """After n steps of h at a constant rate, 1 - (T / (T + h))^n of it is seen; no time changes nothing."""
    state = frames.empty_state()
    for number in (*range(6), 5):
        state["joint"]["position"] = MIDDLE + np.float32(0.02 * number)
        loop.safety.update(loop._sample(Reply(state, 0.0, 100 + 0.01 * number, number, 1)))
    np.testing.assert_allclose(loop.safety.sample.velocity, 2.0 * (1 - (2 / 3) ** 5), rtol=1e-4)


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


# --- deadlines: kept, skipped, and in phase with the policy's --------------------------------------


@given(st.lists(st.one_of(st.floats(0.0, 0.05), st.floats(0.0119, 0.0132)), min_size=1, max_size=60))
def test_a_cycle_begins_at_a_deadline_or_a_little_after_and_skips_what_is_past(durations):
    clock = [0.0]

    def sleep(seconds):
        clock[0] += seconds

    pace, last, missed = Pace(250 / 3, lambda: clock[0], sleep), 0, 0
    for duration in durations:
        clock[0] += duration
        at = clock[0]
        # The first deadline after the last one that is still to come, or has passed by the grace at most.
        index = last + 1
        while at > index * CYCLE + GRACE:
            index += 1
        if abs(at - index * CYCLE - GRACE) < 1e-9 or abs(at - (index - 1) * CYCLE - GRACE) < 1e-9:
            return  # On the brink: rounding decides.
        pace.wait()
        assert clock[0] == pytest.approx(max(at, index * CYCLE), abs=1e-9)
        missed, last = missed + index - last - 1, index
        assert pace.jitter.missed == missed and pace.jitter.worst <= GRACE + 1e-9
    assert pace.jitter.count == len(durations)
