"""Faults of the emulated hand: lines, rates, and what the bridge counts."""

import numpy as np
import pytest

pytest.importorskip("serial")
from twin_pair import Pair
from twin_plant import REST

from dexsim_real.core.errors import HandError
from dexsim_real.twin.wire.faults import KINDS, Injector
from dexsim_real.wire.frames import Mode


def test_a_line_that_is_no_fault_is_an_error():
    lines = "5 melt,soon stall 1,,5 stall,5 stall 1 2,5 heat 12 60 1,5 stuck 0 120 9 1,5 stuck -1 7 9 1,5 heat 1.5 9 9"
    lines += ",5 error 4 65536 1,-1 stall 1,101% flip,nan flip,5 late nan"
    for line in lines.split(","):
        with pytest.raises(HandError, match="give a time in s or a percentage") as error:
            Injector([line])
        assert repr(line) in str(error.value) and "\n" not in str(error.value)
    Injector(["50% flip", "50% stall 1"])
    with pytest.raises(HandError, match="must not exceed 100"):
        Injector(["50% flip", "60% stall 1"])


def test_faults_come_at_their_times_or_at_their_rates_and_the_seed_repeats_them():
    injector = Injector(["2 stuck 4 7 88 1", "0.5 flip", "2 heat 3 40 1.5", "1 disconnect 0.7"])
    sampled = [(round(k * 0.1, 1), injector.sample(50 + k * 0.1)) for k in range(30)]
    found = [(time, fault.kind, tuple(fault.values.values())) for time, fault in sampled if fault]
    assert [row[1:] for row in found] == [
        ("flip", ()),
        ("disconnect", (0.7,)),
        ("stuck", (4, 7, 88, 1.0)),
        ("heat", (3, 40.0, 1.5)),
    ]
    assert [row[0] for row in found] == [0.5, 1.0, 2.0, 2.1]
    rates, runs = {"stall": 3, "late": 10, "off 4": 25}, []
    for seed in (1, 1, 2):
        injector = Injector([f"{rate}% {kind} 0.1" for kind, rate in rates.items()], seed)
        runs.append(([injector.sample(0.012 * k) for k in range(5_000)], injector.injected))
    assert runs[0] == runs[1] and runs[0] != runs[2]
    drawn, made = runs[0]
    for kind, rate in rates.items():
        assert made[kind.split()[0]] / 5_000 == pytest.approx(rate / 100, abs=5 * np.sqrt(rate / 100 / 5_000))
    assert sum(made.values()) == sum(fault is not None for fault in drawn)


def test_every_injected_fault_is_found_in_the_hosts_counters(monkeypatch):
    """Half of all exchanges go wrong in one way or another."""
    lines = ["20% flip", "4% late 0.12", "4% stall 0.1", "4% disconnect 0.1", "4% heat 4 40 0.05", "4% off 3 0.05"]
    lines += ["4% error 7 8 0.05", "3% refuse 28 0.05", "3% angle 4 1.3 0", "4% stuck 2 60 99 9"]
    pair = Pair(monkeypatch, lines, 1)
    answers = pair.run(25)
    pair.settle()
    made = pair.injector.injected
    assert set(made) == set(KINDS) and len(answers) > 250 and min(made.values()) > 5
    for name, (counted, injected) in pair.agreement().items():
        assert counted == injected, (name, pair.agreement(), made)
    # One that befalls the greeting itself makes two connections one.
    assert 0.8 * made["disconnect"] < pair.port.counts.reconnects <= made["disconnect"]


def test_faults_of_the_hand_reach_the_state_for_their_time(monkeypatch):
    lines = ["0.1 error 7 513 0.1", "0.3 off 4 0.1", "0.7 heat 7 45 0.1", "0.9 angle 4 1.3 0.1"]
    pair = Pair(monkeypatch, [*lines, "1.1 stuck 2 60 99 0.1"])
    states = [pair.exchange().state for _ in range(110)]
    joint = {name: np.array([state["joint"][name] for state in states]) for name in states[0]["joint"].dtype.names}
    taxels = np.array([state["tip"]["taxel"]["z"] for state in states])
    modes = joint["raw_position"] & 0xF
    found = {
        7: joint["joint_error"] == 513,
        4: modes != Mode.POSITION,
        (7, "heat"): joint["temperature"] & 0xFF == 80,
        (4, "angle"): np.abs(joint["position"] - REST) > 0.1,
    }
    for which, wrong in found.items():
        at = which if isinstance(which, int) else which[0]
        assert 8 <= wrong[:, at].sum() == wrong.sum() <= 10, which
    assert 8 <= (taxels[:, 2, 60] == 99).sum() <= 10 and (taxels == 99).sum() == (taxels[:, 2, 60] == 99).sum()
    np.testing.assert_allclose(pair.plant.angle, REST, atol=1e-3)  # The true ones.
    assert pair.board.faults == [], "all have ended"


def test_a_hand_that_refuses_to_be_driven_can_be_turned_off(monkeypatch):
    pair = Pair(monkeypatch, ["0.1 refuse 28 0.5"])
    pair.run(0.2)
    assert pair.board.on and pair.exchange() is None
    assert "over-temperature (1501028)" in pair.port.refusal.text
    assert pair.exchange(Mode.PASSIVE) is None and not pair.board.on
