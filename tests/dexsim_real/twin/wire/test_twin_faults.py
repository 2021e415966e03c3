"""Faults of the emulated hand: lines, rates, damage, and what the bridge counts."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

pytest.importorskip("serial")
from twin_pair import Pair, command
from twin_plant import REST

from dexsim_real.core.errors import HandError
from dexsim_real.twin.wire.faults import ALL, BOARDS, BYTES, KINDS, Fault, Injector
from dexsim_real.wire import frames
from dexsim_real.wire.frames import HAND_REPLIES, Command, Frame, Mode, Parser


def test_a_line_that_is_no_fault_is_an_error():
    lines = "5 melt,soon stall,,5 stall 1 2,5 flip both,5 heat 12 60 1,5 stuck 0 120 9,5 angle 4 twisted 1 1"
    lines += ",5 error joint 4 65536 1,-1 stall,101% stall,nan drop,5 late nan"
    for line in lines.split(","):
        with pytest.raises(HandError, match="give a time in s or a percentage") as error:
            Injector([line])
        assert repr(line) in str(error.value) and "\n" not in str(error.value)
    Injector(["50% flip", "50% drop"])
    with pytest.raises(HandError, match="must not exceed 100"):
        Injector(["50% flip", "60% drop"])


def test_faults_at_given_times_come_in_order_with_their_values():
    lines = ["2 stuck 4 7 88", "0.5 drop request", "2 heat 3 40 1.5", "1 disconnect 0.7", "2.5 off -1", "9 late"]
    injector = Injector(lines)
    sampled = [(round(k * 0.1, 1), injector.sample(50 + k * 0.1)) for k in range(30)]
    (_, drop), (_, gone), (_, stuck), (when, heat), (_, off) = [(t, fault) for t, fault in sampled if fault]
    assert str(drop) == "drop request" and gone == Fault(kind="disconnect", seconds=0.7)
    assert stuck == Fault(kind="stuck", tip=4, taxel=7, count=88) and when == 2.1
    assert str(heat) == "heat 3 40.0 1.5" and off == Fault(kind="off", joint=ALL, seconds=2.0)
    assert injector.injected == {"drop request": 1, "disconnect": 1, "heat": 1, "stuck": 1, "off": 1}
    assert 0.1 <= injector.sample(60).seconds <= 0.15  # Drawn, where the line says nothing.


def test_random_faults_have_their_rates_and_the_seed_repeats_them():
    rates = dict(zip(KINDS, range(1, 1 + len(KINDS)), strict=True))  # percent
    runs = []
    for seed in (1, 1, 2):
        injector = Injector([f"{rate / 2}% {kind}" for kind, rate in rates.items()], seed)
        runs.append(([injector.sample(0.012 * k) for k in range(20_000)], injector.injected))
    assert runs[0] == runs[1] and runs[0] != runs[2]
    drawn, made = runs[0]
    for kind, rate in rates.items():
        share = sum(count for name, count in made.items() if name.startswith(kind)) / 20_000
        assert share == pytest.approx(rate / 200, abs=5 * np.sqrt(rate / 200 / 20_000)), kind
    assert sum(made.values()) == sum(fault is not None for fault in drawn)


@given(st.integers(0, 2**32 - 1), st.sampled_from(BYTES))
def test_no_damage_leaves_a_frame_that_passes(seed, kind):
    rng = np.random.default_rng(seed)
    state = np.frombuffer(rng.bytes(2208), frames.STATE_BLOCK).copy()
    state["joint"]["id"] = np.arange(12)
    frame = Frame(0x80, 0xFE, Command.EXCHANGE, state.tobytes()).encode()
    bad = Injector(seed=seed).damage(kind, frame)
    parser = Parser(HAND_REPLIES)
    assert bad != frame and frame not in bad and bad
    assert parser.feed(bad) + parser.expire() == []
    changed = abs(len(bad) - len(frame))
    assert (changed == 0) == (kind == "flip") and changed <= 40


@pytest.mark.parametrize("seed", range(2))
def test_every_injected_fault_is_found_in_the_hosts_counters(hand, monkeypatch, seed):
    """Two thirds of all exchanges go wrong in one way or another."""
    short = ("stall 0.1", "disconnect 0.1", "heat 4 40 0.05", "error joint 7 8 0.05", "off -1 0.05", "jam 9 1500 0.1")
    lines = ["10% flip", "10% drop", "10% duplicate", "4% late", *(f"4% {line}" for line in short)]
    lines += ["3% refuse 28 0.05", "3% angle 4 offset 1.3 0", "4% stuck"]
    pair = Pair(monkeypatch, lines, seed)
    answers = pair.run(40)
    pair.settle()
    made = pair.injector.injected
    assert set(made) == {*(f"{kind} {side}" for kind in BYTES for side in ("answer", "request")), *list(KINDS)[3:]}
    assert len(answers) > 400 and min(made.values()) > 5
    for name, (counted, injected) in pair.agreement().items():
        assert counted == injected, (name, pair.agreement(), made)
    # One that befalls the greeting itself makes two connections one.
    assert 0.8 * made["disconnect"] < pair.port.counts.reconnects <= made["disconnect"]
    assert pair.plant.violations(hand) == []
    pair.injector._random = []  # Nothing new befalls the last exchange.
    pair.wait(3.0)
    pair.exchange(Mode.PASSIVE)
    assert {fault.kind for _, fault in pair.board.faults} == {"stuck"}  # All others have ended.


def test_faults_of_the_hand_reach_the_state_for_their_time(monkeypatch):
    lines = ["0.1 heat tip3 60 0.1", "0.3 heat palm 50 0.1", "0.5 error joint 7 513 0.1", "0.7 off 4 0.1"]
    lines += ["0.9 off -1 0.1", "1.1 jam 9 1500 0.1", "1.3 heat 7 45 0.1", "1.5 angle 5 stuck 1.9 0.1"]
    lines += ["1.7 angle 4 offset 1.3 0", "1.8 stuck 2 60 99"]
    pair = Pair(monkeypatch, lines)
    states = [pair.exchange().state for _ in range(160)]

    def column(block, name):
        return np.array([state[block][name] for state in states])

    tips, temperature = column("tip", "temperature"), column("joint", "temperature")
    bits = np.stack([column("joint", f"{name}_error") for name in BOARDS], 1)
    modes, currents = column("joint", "raw_position") & 0xF, column("joint", "current")
    angles, taxels = column("joint", "position"), column("tip", "taxel")["z"]
    assert set(tips[:, 3]) == {31, 91} and set(np.delete(tips, 3, 1).flat) == {31}
    assert set((temperature >> 8).flat) == {38, 88} and set((temperature & 0xFF)[:, 7]) == {35, 80}
    assert set(bits[:, 1, 7]) == {0, 513} and bits.sum() == bits[:, 1, 7].sum()
    off = modes != Mode.POSITION
    assert off.sum() == off[:, 4].sum() + 11 * off.all(1).sum()
    wrong = np.abs(angles - REST) > 0.1
    assert wrong[:, 4].sum() == 1 and np.delete(wrong, [4, 5], 1).sum() == 0
    assert np.delete(np.abs(currents), 9, 1).max() < 1500
    for lasting in (tips[:, 3] == 91, temperature[:, 0] >> 8 == 88, bits[:, 1, 7] > 0, off.all(1), wrong[:, 5]):
        assert 8 <= lasting.sum() <= 10
    for lasting in (off[:, 4] & ~off.all(1), temperature[:, 7] & 0xFF == 80, currents[:, 9] == -1500):
        assert 8 <= lasting.sum() <= 10
    stuck = taxels[:, 2, 60].tolist()
    assert set(stuck) == {0, 99} and stuck == sorted(stuck)
    np.testing.assert_allclose(pair.board.angles, REST, atol=1e-3)  # The true ones.


def test_a_jammed_joint_does_not_move_while_the_others_do(monkeypatch):
    pair = Pair(monkeypatch, ["0.05 jam 9 1500 0.3"])
    goal = REST + 0.1 * (np.arange(12) != 3)
    for k in range(25):
        pair.port.exchange(command(REST if k < 6 else goal))
        pair.wait(0.003)
    moved = np.abs(pair.plant.angle - REST) > 0.05
    assert not moved[9] and np.delete(moved, [3, 9]).all()


def test_a_hand_that_refuses_to_be_driven_can_be_turned_off(monkeypatch):
    pair = Pair(monkeypatch, ["0.1 refuse 28 0.5"])
    pair.run(0.2)
    assert pair.board.on and pair.exchange() is None
    assert "over-temperature (1501028)" in pair.port.refusal.text
    assert pair.exchange(Mode.PASSIVE) is None and not pair.board.on
    pair.wait(0.5)
    assert pair.exchange() is not None and pair.port.refusal is None and pair.board.on
    assert all(counted == made for counted, made in pair.agreement().values())
