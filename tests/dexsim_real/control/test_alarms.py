"""Alarms of the hand itself: heat, current, error bits, control mode, refusals. Each names joint and finger."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from test_safety import AGREEING, CYCLE, FREE, MIDDLE, Bench, sample

from dexsim_real.control.alarms import Alarms, joint_labels
from dexsim_real.control.limits import SafetyConfig
from dexsim_real.control.safety import Reaction, Safety
from dexsim_real.loop import ExchangeLoop
from dexsim_real.sensors.hand import HandSensing, HardwareConfig
from dexsim_real.wire import frames
from dexsim_real.wire.frames import Mode
from dexsim_real.wire.link import LinkCounts, Reply
from dexsim_real.wire.refusals import Refusal, read_refusal

FINGER = ["thumb"] * 3 + ["index"] * 3 + ["middle"] * 2 + ["ring"] * 2 + ["pinky"] * 2
ON = np.full(12, Mode.POSITION, np.uint8)


def reported(bench, **fields):
    """A measurement at the bench's time and pose with other fields."""
    plain = sample(bench.now, bench.position)
    measured = dataclasses.replace(plain.measured, **{"mode": ON, **fields})
    return dataclasses.replace(plain, measured=measured)


def cycle(bench, wish=MIDDLE, **fields):
    bench.safety.see(reported(bench, **fields))
    return bench.cycle(wish=wish, fresh=False)


def changed(base, index, value):
    array = np.array(base)
    array[index] = value
    return array


@pytest.fixture
def bench(hand):
    bench = Bench(hand)
    bench.engage()
    for _ in range(round(2.0 / CYCLE)):
        cycle(bench)
    return bench


def test_every_joint_has_its_finger(hand):
    assert joint_labels(hand) == tuple(
        f"joint {name} ({finger})" for name, finger in zip(hand.joint_names, FINGER, strict=True)
    )


@pytest.mark.parametrize("part", range(18))
def test_each_part_that_is_too_hot_turns_the_motors_off_by_its_name(hand, bench, part):
    """Any joint board, one fingertip alone, or the palm; in two answers in a row, for a single one may be wrong."""
    cold = np.full(18, 35.0, np.float32)
    for heat in (255.0, 35.0, 255.0):
        assert cycle(bench, temperature=changed(cold, part, heat)).mode == Mode.POSITION
    assert cycle(bench, temperature=changed(cold, part, 71.0)).mode == Mode.PASSIVE
    names = (*joint_labels(hand), *(f"fingertip of the {name}" for name in hand.finger_names), "palm board")
    assert bench.safety.latched == f"too hot: {names[part]}, 71 degC"
    assert cycle(bench).mode == Mode.PASSIVE


@pytest.mark.parametrize("joint", [0, 5, 11])
@pytest.mark.parametrize("board", range(3))
@pytest.mark.parametrize("bit", [0, 9, 15])
def test_an_error_bit_holds_then_turns_the_motors_off_by_its_name(bench, joint, board, bit):
    errors = changed(np.zeros((12, 3), np.uint16), (joint, board), 1 << bit)
    before = bench.position.copy()
    decision = cycle(bench, MIDDLE + 0.05 * FREE, errors=errors)
    assert decision.reaction == Reaction.HOLD
    np.testing.assert_array_equal(decision.position, before)
    name = ("palm", "joint", "tip")[board]
    assert f"error bits 0x{1 << bit:04x} of the {name} board, joint" in decision.reason
    for _ in range(round(0.19 / CYCLE)):
        assert cycle(bench, errors=errors).reaction == Reaction.HOLD
    for _ in range(3):
        decision = cycle(bench, errors=errors)
    assert decision.mode == Mode.PASSIVE and bench.safety.latched == decision.reason
    assert f"({FINGER[joint]})" in decision.reason


def test_error_bits_that_are_known_to_be_harmless_are_ignored(hand):
    bench = Bench(hand, ignored_errors=(0, 4, 0x8001))
    bench.engage()
    errors = np.zeros((12, 3), np.uint16)
    errors[3, 1], errors[7, 2] = 4, 0x8001
    for _ in range(60):
        assert cycle(bench, errors=errors).mode == Mode.POSITION
    errors[7, 2] |= 2
    assert "0x0002 of the tip board" in cycle(bench, errors=errors).reason


def test_nothing_is_enabled_on_an_alarm(hand):
    bench = Bench(hand)
    errors = changed(np.zeros((12, 3), np.uint16), (4, 1), 1)
    for _ in range(AGREEING):
        assert cycle(bench, errors=errors).mode == Mode.PASSIVE
    bench.safety.engage()
    assert cycle(bench, errors=errors).mode == Mode.PASSIVE and not bench.safety.latched
    assert cycle(bench).mode == Mode.POSITION


@pytest.mark.parametrize("joints", [[4], [0, 11], range(12)])
def test_a_hand_that_switched_itself_off_is_not_driven(bench, hand, joints):
    mode = changed(ON, list(joints), 0)
    assert cycle(bench, mode=mode).mode == Mode.POSITION
    second = cycle(bench, mode=mode)
    assert second.reaction == Reaction.HOLD and "switched itself off" in second.reason
    for _ in range(round(0.25 / CYCLE)):
        decision = cycle(bench, mode=mode)
    assert decision.mode == Mode.PASSIVE
    who = "all joints report" if len(joints) == 12 else f"{joint_labels(hand)[joints[0]]} reports"
    assert bench.safety.latched == f"the hand switched itself off: {who} mode 0"


def test_a_hand_that_reports_no_mode_is_not_judged_by_it(hand):
    bench = Bench(hand)
    bench.engage()
    for _ in range(100):
        assert cycle(bench, mode=np.zeros(12, np.uint8)).mode == Mode.POSITION


def test_a_mode_that_follows_a_cycle_late_is_no_alarm(hand):
    bench = Bench(hand)
    bench.engage()
    reasons = {cycle(bench, mode=np.full(12, k > 1, np.uint8) * ON).reason for k in range(50)}
    assert not any("switched" in reason for reason in reasons)


def test_a_stalled_joint_is_relaxed_and_named(bench):
    current = changed(np.full(12, 0.1, np.float32), 9, 1.5)
    wish = MIDDLE + 0.3 * FREE
    spent = 0
    while bench.safety.latched == "" and spent < 8.0:
        bench.safety.see(reported(bench, current=current))
        bench.cycle(wish=wish, fresh=False, follow=False)
        spent += CYCLE
    assert 3.0 < spent < 3.1
    assert bench.safety.latched == "stalled: joint ring_joint2 (ring) draws 1.50 A without moving"


def test_a_joint_that_moves_at_high_current_or_rests_at_a_low_one_is_not_stalled(bench):
    current = changed(np.full(12, 1.25, np.float32), 9, 1.5)
    for k in range(round(8.0 / CYCLE)):
        bench.position = changed(MIDDLE, 9, MIDDLE[9] + 0.2 * np.sin(k * CYCLE))
        assert cycle(bench, bench.position, current=current).mode == Mode.POSITION


@pytest.mark.parametrize("joint", range(12))
@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_speed_counts_in_both_directions_and_names_the_joint(hand, bench, joint, sign):
    fast = dataclasses.replace(reported(bench), velocity=changed(np.zeros(12), joint, sign * 25.0))
    bench.safety.see(fast)
    decision = bench.cycle(wish=MIDDLE, fresh=False)
    assert (decision.reaction, decision.reason) == (Reaction.HOLD, f"too fast: {joint_labels(hand)[joint]}")


BOARDS = {"palm": (12, 0x0101), "joint": (14, 0x0202), "tip": (16, 0x0404)}
"""Offset of each board's error field in the 24 bytes of a joint, by the vendor's header; a value for the test."""


@given(st.sets(st.sampled_from(tuple(BOARDS))), st.integers(0, 11))
def test_error_fields_are_not_swapped(hand, boards, joint):
    data = bytearray(frames.empty_state().tobytes())
    for board in boards:
        at, value = BOARDS[board]
        data[24 * joint + at : 24 * joint + at + 2] = value.to_bytes(2, "little")
    errors = HandSensing(hand, HardwareConfig()).measure(frames.decode_state(bytes(data))).errors
    wanted = [value if board in boards else 0 for board, (_, value) in BOARDS.items()]
    assert errors[joint].tolist() == wanted and errors.sum() == sum(wanted)


# --- refusals ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("data", "serious", "text"),
    [
        ((1501028).to_bytes(4, "little"), True, "over-temperature (1501028)"),
        ((1501035).to_bytes(4, "little") + b"\x04\x00", True, "over-current (1501035)"),
        (b"\x1c\x00", True, "over-temperature (1501028)"),
        (b"\x06", False, "busy (1501006)"),
        (b"\xee\xee\xee\xee", False, "unknown error (ee ee ee ee)"),
    ],
)
def test_an_error_frame_keeps_its_number(data, serious, text):
    refusal = read_refusal(data)
    assert refusal.serious == serious and text in refusal.text


class Refusing:
    """A hand that answers `plan` in order: a state, a refusal, or silence (None)."""

    def __init__(self, plan):
        self.plan, self.sent, self.refusal, self.counts = plan, [], None, LinkCounts()

    def exchange(self, command):
        step = self.plan[min(len(self.sent), len(self.plan) - 1)]
        self.sent.append(command)
        self.refusal = step if isinstance(step, Refusal) else None
        if step != "state":
            return None
        state = frames.empty_state()
        state["joint"]["position"] = MIDDLE
        state["joint"]["raw_position"] = command["mode"]
        now = len(self.sent) * CYCLE
        return Reply(state, now - CYCLE, now, len(self.sent), 1)


def drive(hand, plan, cycles):
    port, safety = Refusing(plan), Safety(hand, SafetyConfig())
    loop = ExchangeLoop(port, HandSensing(hand, HardwareConfig()), safety, 83.0, clock=lambda: CYCLE * len(port.sent))
    for _ in range(AGREEING):
        loop.cycle()
    loop.engage()
    found = []
    for _ in range(cycles):
        loop.cycle()
        found.append(safety.last)
    return port, safety, found


def test_a_hand_that_refuses_for_heat_is_turned_off_with_its_own_words(hand):
    hot = read_refusal((1501028).to_bytes(4, "little"))
    port, safety, _ = drive(hand, ["state"] * 15 + [hot, "state", hot, None, hot], 20)
    assert safety.latched == "the hand reports over-temperature (1501028)"
    on = [bool(np.all(command["mode"] == Mode.POSITION)) for command in port.sent]
    assert on[10:20] == [True] * 10 and not any(on[20:])


def test_a_busy_hand_is_held_then_relaxed_and_the_reason_is_shown(hand):
    """Silent first, then busy: the silence counts from its beginning."""
    busy = read_refusal(b"\x06\x00")
    _, safety, found = drive(hand, ["state"] * 35 + [None] * 50 + [busy], 150)
    assert not safety.latched and safety.last == (Reaction.RELAX, "no measurement: the hand reports busy (1501006)")
    held = [k for k, (reaction, _) in enumerate(found) if reaction == Reaction.HOLD]
    assert 0.9 < len(held) * CYCLE < 1.1 and (Reaction.HOLD, "no measurement") in found


@pytest.mark.parametrize(("between", "fatal"), [("", True), ("busy", False), ("answer", False)])
def test_only_serious_refusals_in_a_row_turn_the_motors_off(hand, bench, between, fatal):
    hot, alarms = read_refusal((1501028).to_bytes(4, "little")), Alarms(hand, SafetyConfig())
    alarms.refuse(hot)
    assert not alarms.fatal
    if between == "busy":
        alarms.refuse(read_refusal(b"\x06\x00"))
    if between == "answer":
        alarms.see(bench.now, reported(bench).measured, True)
    alarms.refuse(hot)
    assert bool(alarms.fatal) == fatal
