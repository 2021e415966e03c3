"""Alarms of the hand itself: heat, current, error bits, control mode, motion, refusals. Each names joint and finger."""

import numpy as np
import pytest
from test_safety import AGREEING, CYCLE, FREE, MIDDLE, Bench, sample

from dexsim_real.control.alarms import Alarms, Lasting, joint_labels
from dexsim_real.control.limits import SafetyConfig
from dexsim_real.control.safety import Reaction
from dexsim_real.wire.frames import Mode
from dexsim_real.wire.link import read_refusal

ON = np.full(12, Mode.POSITION, np.uint8)
JOINTS = np.arange(12)


def cycle(bench, target=MIDDLE, **fields):
    """One exchange with other fields of the measurement."""
    return bench.cycle(target, **fields)


def changed(base, index, value):
    array = np.array(base)
    array[index] = value
    return array


@pytest.mark.parametrize(("pause", "seconds"), [(0.05, 0.29 - 0.05 + 0.29), (0.15, 0.29)])
def test_a_short_pause_is_subtracted_from_a_finding_and_a_long_one_ends_it(pause, seconds):
    """0.3 s with it, the pause, 0.3 s with it, in answers every 10 ms."""
    lasting, pattern = Lasting(), [True] * 30 + [False] * round(pause / 0.01) + [True] * 30
    for k, active in enumerate(pattern):
        lasted = lasting.update(1.0 + 0.01 * k, active)
    assert lasted == pytest.approx(seconds)


@pytest.mark.parametrize("part", [0, 12, 17])
def test_each_part_that_is_too_hot_turns_the_motors_off_by_its_name(hand, bench, part):
    """Any joint board, one fingertip alone, or the palm; in two answers in a row, for a single one may be wrong."""
    cold = np.full(18, 35.0, np.float32)
    for heat in (255.0, 35.0, 255.0):
        assert cycle(bench, temperature=changed(cold, part, heat)).mode == Mode.POSITION
    assert cycle(bench, temperature=changed(cold, part, 71.0)).mode == Mode.PASSIVE
    names = (*joint_labels(hand), *(f"fingertip of the {name}" for name in hand.finger_names), "palm board")
    assert bench.safety.latched == f"too hot: {names[part]}, 71 degC"
    bench.safety.engage()
    assert cycle(bench).mode == Mode.PASSIVE, "for good"


def test_current_of_one_joint_relaxes_only_when_it_lasts(bench):
    """Judged by itself, whatever the others draw; peaks of a gait, 0.9 s with pauses of 0.3 s, do not add up."""
    current = changed(np.zeros(12, np.float32), 7, 2.0)
    for k in range(round(3.6 / CYCLE)):
        assert cycle(bench, current=current * (k % 100 < 75)).mode == Mode.POSITION
    for _ in range(round(1.1 / CYCLE)):
        decision = cycle(bench, current=current)
    assert decision.mode == Mode.PASSIVE
    assert bench.safety.latched == "current too high: 2.00 A in joint mid_joint2 (middle)"


AHEAD = MIDDLE + np.float32(0.35) * (JOINTS == 5)  # commands to a joint without power


@pytest.mark.parametrize(
    ("trouble", "every", "within", "says"),
    [
        ({"current": changed(np.zeros(12, np.float32), 7, 2.0)}, 8, 2.0, "current too high"),
        ({"current": changed(np.zeros(12, np.float32), 7, 1.5)}, 8, 5.5, "stalled: joint mid_joint2"),
        ({"errors": changed(np.zeros((12, 3), np.uint16), (4, 1), 2)}, 5, 0.6, "error bits 0x0002"),
        ({"mode": changed(ON, 4, 0)}, 5, 0.6, "switched itself off"),
        ({"target": AHEAD, "follow": False, "current": np.zeros(12, np.float32)}, 8, 1.2, "does not follow"),
        ({"target": 2 * MIDDLE - AHEAD, "follow": False, "current": np.zeros(12)}, 8, 1.2, "does not follow"),
    ],
)
@pytest.mark.parametrize("wrong", ["measurement", "angle"])
def test_a_wrong_answer_now_and_then_hides_no_trouble(bench, trouble, every, within, says, wrong):
    """Every so many answers: one without the trouble, or one in which every joint reads 0.06 rad too much."""
    trouble, start = {"target": MIDDLE} | trouble, bench.now
    for k in range(1, 500):
        fields = dict(trouble)
        if k % every == 0 and wrong == "measurement":
            fields = {name: fields[name] for name in ("target", "follow") if name in fields}
        off = 0.06 if k % every == 0 and wrong == "angle" else 1e-3 * (k % 2)  # Angles that never change are frozen.
        read = MIDDLE + np.float32(off) * FREE
        cycle(bench, read=read, **fields)
        if bench.safety.latched:
            break
    assert says in bench.safety.latched and bench.now - start < within


@pytest.mark.parametrize(("joint", "board", "bit"), [(0, 0, 0), (11, 2, 15)])
def test_an_error_bit_holds_then_turns_the_motors_off_by_its_name(bench, joint, board, bit):
    errors = changed(np.zeros((12, 3), np.uint16), (joint, board), 1 << bit)
    before = bench.position.copy()
    for _ in range(round(0.19 / CYCLE) + 1):
        decision = cycle(bench, MIDDLE + 0.05 * FREE, errors=errors)
        assert decision.reaction == Reaction.HOLD
        np.testing.assert_array_equal(decision.position, before)
    for _ in range(3):
        decision = cycle(bench, errors=errors)
    assert decision.mode == Mode.PASSIVE and bench.safety.latched == decision.reason
    name, finger = ("palm", "joint", "tip")[board], {0: "thumb", 11: "pinky"}[joint]
    assert f"error bits 0x{1 << bit:04x} of the {name} board, joint" in decision.reason
    assert f"({finger})" in decision.reason


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


@pytest.mark.parametrize("joints", [[4], range(12)])
def test_a_hand_that_switched_itself_off_is_not_driven(bench, hand, joints):
    mode = changed(ON, list(joints), 0)
    assert cycle(bench, mode=mode).reaction == Reaction.NONE, "one answer may be wrong"
    second = cycle(bench, mode=mode)
    assert second.reaction == Reaction.HOLD and "switched itself off" in second.reason
    for _ in range(round(0.25 / CYCLE)):
        decision = cycle(bench, mode=mode)
    assert decision.mode == Mode.PASSIVE
    who = "all joints report" if len(joints) == 12 else f"{joint_labels(hand)[joints[0]]} reports"
    assert bench.safety.latched == f"the hand switched itself off: {who} mode 0"


@pytest.mark.parametrize("mode", [lambda k: np.zeros(12, np.uint8), lambda k: ON * (k > 1)])
def test_a_hand_that_reports_no_mode_or_a_cycle_late_is_not_judged_by_it(hand, mode):
    bench = Bench(hand)
    bench.engage()
    reasons = {cycle(bench, mode=mode(k)).reason for k in range(100)}
    assert not any("switched" in reason for reason in reasons)


def test_a_stalled_joint_is_relaxed_and_named(bench):
    current, start = changed(np.full(12, 0.2, np.float32), 9, 1.5), bench.now
    while bench.safety.latched == "" and bench.now < start + 8.0:
        cycle(
            bench,
            MIDDLE + 0.3 * FREE,
            follow=False,
            read=MIDDLE + 0.02 * np.sin(10 * bench.now),  # It trembles.
            current=current,
        )
    assert 3.0 < bench.now - start < 3.1
    assert bench.safety.latched == "stalled: joint ring_joint2 (ring) draws 1.50 A without moving"


def test_a_joint_that_moves_at_high_current_or_rests_at_a_low_one_is_not_stalled(bench):
    current = changed(np.full(12, 1.25, np.float32), 9, 1.5)
    for k in range(round(8.0 / CYCLE)):
        bench.position = changed(MIDDLE, 9, MIDDLE[9] + 0.08 * np.sin(k * CYCLE))
        assert cycle(bench, bench.position, current=current).mode == Mode.POSITION


# --- angles that do not follow ---------------------------------------------------------------------


def wave(bench):
    """Targets of a policy that moves each finger in its own way."""
    return (MIDDLE + 0.5 * FREE * np.sin(bench.now + JOINTS)).astype(np.float32)


@pytest.mark.parametrize(
    "target",
    [
        wave,
        lambda bench: np.where(JOINTS == 4, wave(bench), MIDDLE),
        lambda bench: MIDDLE + np.float32(0.29) * (JOINTS == 4),
    ],
)
def test_frozen_encoders_are_noticed_whatever_current_is_reported(bench, target):
    """The hand squeezes, or its currents are frozen, too; all joints move, or one, or one by little."""
    frozen, start = bench.position.copy(), bench.now
    while not bench.safety.latched and bench.now < start + 2.5:
        cycle(bench, target(bench), read=frozen, current=np.full(12, 0.7, np.float32))
    assert bench.safety.latched == "no joint angle changes while the commands move"


def test_one_encoder_that_is_stuck_is_noticed_when_its_commands_have_passed_it(hand, bench):
    """Whatever current its motor draws."""
    start, squeeze = bench.now, np.full(12, 0.7, np.float32)
    while not bench.safety.latched and bench.now < start + 7.0:
        cycle(bench, wave(bench), read=changed(bench.position, 4, MIDDLE[4]), current=squeeze)
    assert f"{joint_labels(hand)[4]} does not follow its command" in bench.safety.latched


@pytest.mark.parametrize("pair", [[0, 1], [4, 9]])
def test_two_joints_that_are_swapped_are_noticed_within_a_second(hand, bench, pair):
    """From the moment at which they are far apart; nearly equal angles are no jump when they are swapped."""
    for _ in range(60):
        cycle(bench, changed(MIDDLE, pair, MIDDLE[pair].min()))
    began = None
    while not bench.safety.latched:
        seen = changed(bench.position, pair, bench.position[pair[::-1]])
        if began is None and np.abs(seen - bench.position).max() > 0.3:
            began = bench.now
        cycle(bench, wave(bench), read=seen, current=np.full(12, 0.05, np.float32))
    assert bench.now - began < 1.3 and "does not follow its command: at " in bench.safety.latched
    assert any(joint_labels(hand)[joint] in bench.safety.latched for joint in pair)


@pytest.mark.parametrize("speed", [0.2, 2.0])
def test_a_motor_that_runs_away_is_noticed_although_it_draws_current(hand, bench, speed):
    """No farther from its commands, which tremble, than commands may lead ahead of a joint that presses."""
    for k in range(round((0.4 / speed + 1.0) / CYCLE)):
        seen = changed(bench.position, 11, MIDDLE[11] + min(speed * CYCLE * k, 0.4))
        cycle(bench, MIDDLE + np.float32(0.05 * np.sin(k)), read=seen, current=np.full(12, 0.5, np.float32))
    assert f"{joint_labels(hand)[11]} does not follow its command" in bench.safety.latched


def test_a_hand_that_follows_late_or_squeezes_raises_no_alarm(bench):
    """A tenth of a second late; and held by an object against little current, as of weak motors."""
    past = [bench.position] * 8
    for _ in range(round(6.0 / CYCLE)):
        decision = cycle(bench, wave(bench), read=past.pop(0), current=np.full(12, 0.05, np.float32))
        past.append(bench.position)
        assert decision.reaction < Reaction.HOLD, decision.reason
    for k in range(round(2.0 / CYCLE)):
        seen = bench.position + np.float32(1e-3) * (k % 2)
        decision = cycle(bench, MIDDLE + 0.55 * FREE, read=seen, follow=False, current=np.full(12, 0.2, np.float32))
        assert decision.reaction < Reaction.HOLD, decision.reason


# --- refusals ------------------------------------------------------------------------------------


@pytest.mark.parametrize(("between", "fatal"), [("", True), ("busy", False), ("answer", False)])
def test_serious_refusals_turn_the_motors_off_in_a_row_or_as_every_other_answer(hand, between, fatal):
    hot, alarms = read_refusal((1501028).to_bytes(4, "little")), Alarms(hand, SafetyConfig())
    alarms.refuse(hot)
    assert not alarms.fatal
    if between == "busy":
        alarms.refuse(read_refusal(b"\x06\x00"))
    if between == "answer":
        alarms.update(1.0, sample(1.0).measured, None)
    alarms.refuse(hot)
    assert bool(alarms.fatal) == fatal
    for k in range(10):
        alarms.update(2.0 + k, sample(2.0 + k).measured, None)
    alarms.refuse(hot)
    assert not alarms.fatal, "forgiven"
    for k in range(2):
        alarms.update(20.0 + k, sample(20.0 + k).measured, None)
        alarms.refuse(hot)
    assert alarms.fatal == hot.text


def test_serious_refusals_as_every_fourth_answer_turn_the_motors_off_at_the_fifth(hand):
    hot, alarms, refused = read_refusal((1501028).to_bytes(4, "little")), Alarms(hand, SafetyConfig()), 0
    while not alarms.fatal and refused < 20:
        alarms.refuse(hot)
        refused += 1
        for k in range(3 * (not alarms.fatal)):
            alarms.update(refused + 0.1 * k, sample(refused + 0.1 * k).measured, None)
    assert refused == 5
