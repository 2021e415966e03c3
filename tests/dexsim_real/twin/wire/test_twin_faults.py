"""Faults of the emulated hand: scripts, rates, damage, and what the bridge counts."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

pytest.importorskip("serial")
from twin_pair import Pair
from twin_plant import REST

from dexsim_real.core.errors import HandError
from dexsim_real.twin.wire.faults import BOARDS, BYTES, KINDS, Fault, FaultConfig, Injector, parse_fault
from dexsim_real.wire import frames
from dexsim_real.wire.frames import HAND_REPLIES, Command, Frame, Mode, Parser


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("5 melt", "no kind 'melt'; choose from flip"),
        ("soon stall", "give a time in s"),
        ("", "give a time"),
        ("5 stall 1 2", "give a time"),
        ("5 flip both", "give a time"),
        ("5 heat 12 60 1", "give a time"),
        ("5 stuck 0 120 9", "give a time"),
        ("5 stuck 0 119 256", "give a time"),
        ("5 angle 4 twisted 1 1", "give a time"),
        ("5 angle 4 offset 1.3", "give a time"),
        ("5 error hand 4 1 1", "give a time"),
        ("5 error joint 4 65536 1", "give a time"),
        ("5 off -1 1", "give a time"),
        ("5 jam 12 1500 1", "give a time"),
        ("5 warm 5 60 1", "give a time"),
        ("5 refuse 28 60 1", "give a time"),
        ("-1 stall", "at least 0"),
        ("5 stall -1", "give a time"),
        ("nan drop", "at least 0"),
    ],
)
def test_a_script_that_cannot_be_meant_is_refused_in_one_line(line, message):
    with pytest.raises(HandError, match=message) as found:
        FaultConfig(script=(line,))
    assert repr(line) in str(found.value) and "\n" not in str(found.value)


def test_rates_must_fit_into_one():
    FaultConfig(flip=0.5, drop=0.5)
    with pytest.raises(HandError, match="must not exceed 1"):
        FaultConfig(flip=0.5, drop=0.4, late=0.2)


def test_scripted_faults_come_at_their_time_in_order():
    injector = Injector(
        FaultConfig(script=("2 stuck 4 7 88", "0.5 drop request", "2 heat 3 40 1.5", "1 disconnect 0.7", "9 late")), 0
    )
    found = [(k * 0.1, injector.sample(50 + k * 0.1)) for k in range(30)]
    found = [(round(when, 1), fault) for when, fault in found if fault]
    assert [(when, fault.kind) for when, fault in found] == [
        (0.5, "drop"),
        (1.0, "disconnect"),
        (2.0, "heat"),
        (2.1, "stuck"),
    ]
    assert found[0][1].on_request and found[1][1].seconds == 0.7
    assert (found[2][1].joint, found[2][1].degrees, found[2][1].seconds) == (3, 40, 1.5)
    assert (found[3][1].taxel, found[3][1].count) == ((4, 7), 88)
    assert injector.injected == {"drop request": 1, "disconnect": 1, "heat": 1, "stuck": 1}
    assert 0.1 <= injector.sample(60).seconds <= 0.15  # Drawn, where the script says nothing.


def test_random_faults_have_their_rates_and_the_seed_repeats_them():
    config = FaultConfig(
        flip=0.05,
        drop=0.04,
        duplicate=0.03,
        late=0.02,
        stall=0.015,
        disconnect=0.01,
        heat=0.008,
        stuck=0.006,
        angle=0.004,
        warm=0.005,
        error=0.007,
        off=0.009,
        jam=0.011,
        refuse=0.013,
        on_request=0.25,
    )
    runs = []
    for seed in (1, 1, 2):
        injector = Injector(config, seed)
        runs.append(([injector.sample(0.012 * k) for k in range(20_000)], injector.injected))
    assert runs[0] == runs[1] and runs[0] != runs[2]
    made = runs[0][1]
    for kind in KINDS:
        share = sum(made[name] for name in made if name.startswith(kind)) / 20_000
        rate = getattr(config, kind)
        assert share == pytest.approx(rate, abs=5 * np.sqrt(rate / 20_000)), kind
    requests = sum(made[f"{kind} request"] for kind in BYTES) / sum(
        made[f"{k} {s}"] for k in BYTES for s in ("request", "answer")
    )
    assert requests == pytest.approx(0.25, abs=0.05)
    assert sum(made.values()) == sum(fault is not None for fault in runs[0][0])


@given(st.integers(0, 2**32 - 1), st.sampled_from(BYTES), st.booleans())
def test_no_damage_leaves_a_frame_that_passes(seed, kind, request):
    rng = np.random.default_rng(seed)
    state = np.frombuffer(rng.bytes(2208), frames.STATE_BLOCK).copy()
    state["joint"]["id"] = np.arange(12)
    frame = Frame(0x80, 0xFE, Command.EXCHANGE, state.tobytes()).encode()
    lengths = HAND_REPLIES
    if request:
        block = frames.command_block(rng.normal(size=12), kp=100, ki=0, kd=0, torque_max=300)
        frame, lengths = Frame(0xFE, 0x80, Command.EXCHANGE, block.tobytes()).encode(), frames.HOST_REQUESTS
    bad = Injector(FaultConfig(), seed).damage(Fault(kind, request), frame)
    parser = Parser(lengths)
    assert bad != frame and frame not in bad and bad
    assert parser.feed(bad) + parser.expire() == []
    changed = abs(len(bad) - len(frame))
    assert (changed == 0) == (kind == "flip") and changed <= 40
    if kind == "flip":
        bits = sum((a ^ b).bit_count() for a, b in zip(bad, frame, strict=True))
        assert 1 <= bits <= 3


@pytest.mark.parametrize("seed", range(2))
def test_every_injected_fault_is_found_in_the_hosts_counters(hand, monkeypatch, seed):
    """Half of all exchanges go wrong in one way or another."""
    faults = FaultConfig(
        flip=0.1,
        drop=0.1,
        duplicate=0.1,
        late=0.04,
        stall=0.04,
        disconnect=0.04,
        stuck=0.05,
        heat=0.03,
        angle=0.03,
        warm=0.02,
        error=0.02,
        off=0.02,
        jam=0.02,
        refuse=0.02,
        alarm_seconds=0.05,
        jam_seconds=0.1,
        stall_seconds=(0.005, 0.2),
        away_seconds=(0.01, 0.2),
    )
    pair = Pair(hand, monkeypatch, faults, seed)
    answers = pair.run(40)
    pair.settle()
    made = pair.injector.injected
    assert set(made) == {*(f"{kind} {side}" for kind in BYTES for side in ("answer", "request")), *KINDS[3:]}
    assert len(answers) > 400 and min(made.values()) > 5
    for name, (found, injected) in pair.agreement().items():
        assert found == injected, (name, pair.agreement(), made)
    # One that befalls the greeting itself makes two connections one.
    assert 0.8 * made["disconnect"] < pair.port.counts.reconnects <= made["disconnect"]
    assert pair.check.report()["outside_limits"] == 0 and pair.check.checked == (
        pair.board.counts["exchange"] + pair.board.counts["refused"]
    )
    cable, heat = pair.cable, pair.plant.heat
    pair.injector._rates[:] = 0  # Nothing new befalls the last exchange.
    cable.wait(3.0)
    pair.exchange(Mode.PASSIVE)
    assert not pair.board.faults  # All faults of the board have ended.
    np.testing.assert_allclose(heat, 35.0)  # Every motor that was heated has cooled.


@pytest.mark.parametrize(
    ("name", "counter"),
    [
        ("flip answer", "corrupt"),
        ("drop answer", "corrupt"),
        ("duplicate answer", "corrupt"),
        ("flip request", "silent"),
        ("drop request", "silent"),
        ("duplicate request", "silent"),
        ("late 0.1", "silent"),
        ("stall 0.2", "silent"),
        ("disconnect 0.1", "lost"),
    ],
)
def test_each_fault_alone_has_its_effect_and_passes(hand, monkeypatch, name, counter):
    pair = Pair(hand, monkeypatch, FaultConfig(script=(f"1 {name}",)))
    pair.run(0.99)
    good = dataclasses.replace(pair.port.counts)
    assert good.sent == good.answered
    while pair.exchange() is not None:
        pass
    changed = {
        key: value - getattr(good, key)
        for key, value in dataclasses.asdict(pair.port.counts).items()
        if key not in ("sent", "answered", "crc_errors", "resyncs") and value != getattr(good, key)
    }
    assert changed == {counter: 1}
    start = pair.cable.now
    while pair.exchange() is None:
        pass
    assert pair.cable.now - start < 0.4
    pair.run(0.5)
    assert pair.port.counts.reconnects == (counter == "lost")
    assert pair.port.counts.late == name.startswith("late")
    assert all(found == made for found, made in pair.agreement().values())


def test_heat_and_stuck_taxels_reach_the_state(hand, monkeypatch):
    pair = Pair(hand, monkeypatch, FaultConfig(script=("0.1 heat 7 45 0.3", "0.2 stuck 2 60 99")))
    states = [pair.exchange().state for _ in range(60)]
    heat = np.array([state["joint"]["temperature"] & 0xFF for state in states])
    hot = np.flatnonzero(heat[:, 7] == 80)
    assert np.all(np.delete(heat, 7, 1) == 35) and set(heat[:, 7]) == {35, 80}
    assert 23 <= len(hot) <= 27 and np.all(np.diff(hot) == 1)
    stuck = [int(state["tip"]["taxel"]["z"][2, 60]) for state in states]
    assert set(stuck) == {0, 99} and stuck == sorted(stuck)


def test_wrong_angles_reach_the_state_for_their_time(hand, monkeypatch):
    script = ("0.1 angle 4 offset 1.3 0", "0.2 angle 5 stuck 1.9 0.2", "0.5 angle 6 stuck 1e30 0.01")
    pair = Pair(hand, monkeypatch, FaultConfig(script=script))
    replies = [pair.exchange().state["joint"]["position"] for _ in range(60)]
    off = np.abs(np.array(replies) - REST) > 0.1
    assert off[:, 4].sum() == off[:, 6].sum() == 1 and 16 <= off[:, 5].sum() <= 18
    assert not np.delete(off, [4, 5, 6], 1).any() and np.all(np.diff(np.flatnonzero(off[:, 5])) == 1)
    assert np.array(replies)[:, 4].max() == pytest.approx(REST[4] + 1.3, abs=1e-3)
    np.testing.assert_allclose(pair.board.angles, REST, atol=1e-3)
    injector = Injector(FaultConfig(), 3)
    kinds = {(fault.form, abs(fault.radians) > 1e29) for fault in (injector._random_fault("angle") for _ in range(50))}
    assert kinds == {("offset", False), ("stuck", False), ("stuck", True)}


def test_alarms_reach_the_state_for_their_time(hand, monkeypatch):
    script = (
        "0.1 warm 3 60 0.1",
        "0.3 warm palm 50 0.1",
        "0.5 error joint 7 513 0.1",
        "0.7 off 4 0.1",
        "0.9 off all 0.1",
        "1.1 jam 9 1500 0.1",
    )
    pair = Pair(hand, monkeypatch, FaultConfig(script=script))
    states = [pair.exchange().state for _ in range(110)]
    tips = np.array([state["tip"]["temperature"] for state in states])
    palms = np.array([state["joint"]["temperature"] >> 8 for state in states])
    boards = np.array([state["joint"]["temperature"] & 0xFF for state in states])
    bits = np.array([np.stack([state["joint"][f"{name}_error"] for name in BOARDS]) for state in states])
    modes = np.array([state["joint"]["raw_position"] & 0xF for state in states])
    currents = np.array([state["joint"]["current"] for state in states])
    assert set(tips[:, 3]) == {31, 91} and set(np.delete(tips, 3, 1).flat) == {31}
    assert set(palms.flat) == {38, 88} and set(boards.flat) == {35}
    assert np.all(palms == palms[:, :1])
    assert set(bits[:, 1, 7]) == {0, 513} and bits.sum() == bits[:, 1, 7].sum()
    off = modes != Mode.POSITION
    for what in (tips[:, 3] == 91, palms[:, 0] == 88, bits[:, 1, 7] > 0, off.all(1), off[:, 4] & ~off.all(1)):
        assert 8 <= what.sum() <= 10
    assert off.sum() == off[:, 4].sum() + 11 * off.all(1).sum()
    assert 8 <= (currents[:, 9] == -1500).sum() <= 10 and np.abs(np.delete(currents, 9, 1)).max() < 1500


def test_a_jammed_joint_does_not_move_while_the_others_do(hand, monkeypatch):
    pair = Pair(hand, monkeypatch, FaultConfig(script=("0.05 jam 9 1500 0.3",)))
    goal = REST + 0.1 * (np.arange(12) != 3)
    for k in range(25):
        pair.port.exchange(frames.command_block(REST if k < 6 else goal, kp=100, ki=0, kd=0, torque_max=300))
        pair.cable.wait(0.003)
        pair.plant.advance(0.012)
    moved = np.abs(pair.plant.angle - REST) > 0.05
    assert not moved[9] and np.delete(moved, [3, 9]).all()


def test_a_hand_that_refuses_to_be_driven_can_be_turned_off(hand, monkeypatch):
    pair = Pair(hand, monkeypatch, FaultConfig(script=("0.1 refuse 28 0.5",)), watchdog=0.0)
    pair.run(0.2)
    assert pair.board.on and pair.exchange() is None
    assert "over-temperature (1501028)" in pair.port.refusal.text
    assert pair.exchange(Mode.PASSIVE) is None and not pair.board.on
    pair.cable.wait(0.5)
    assert pair.exchange() is not None and pair.port.refusal is None and pair.board.on
    assert all(found == made for found, made in pair.agreement().values())


def test_the_hand_is_safe_within_a_tenth_of_a_second_of_losing_its_host(hand, monkeypatch):
    faults = FaultConfig(script=("0.3 disconnect 0.4", "1.2 stall 0.4", "2 late 0.2"))
    pair = Pair(hand, monkeypatch, faults)
    answered = pair.run(3.0)
    lost = [a for a, b in zip(answered, answered[1:], strict=False) if b - a > 0.15]
    trips = pair.board.trips
    assert len(trips) == len(lost) == 3
    for trip, last in zip(trips, lost, strict=True):
        assert 0 < trip - last < 0.1
    # In between and at the end the motors were on again, since somebody asked.
    assert [text for text in pair.notes if text == "motors on"] == ["motors on"] * 4
    # A host that is gone for good.
    pair.cable.wait(1.0)
    assert len(trips) == 4 and trips[-1] - answered[-1] < 0.1 and not pair.board.on


def test_a_hand_without_a_watchdog_stays_on_when_it_loses_its_host(hand, monkeypatch):
    pair = Pair(hand, monkeypatch, FaultConfig(), watchdog=0.0)
    pair.run(0.3)
    pair.cable.wait(5.0)
    assert pair.board.on and not pair.board.trips


def test_parse_gives_time_kind_and_values():
    assert parse_fault("12.5 stall 0.2") == (12.5, "stall", ("0.2",)) and parse_fault("3 drop") == (3.0, "drop", ())
