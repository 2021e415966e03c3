"""Identification of the drives: what is sent to the hand, and logs that are unusable."""

import dataclasses
import json

import numpy as np
import press_bench
import pytest
from calibrating import arguments, off, operator
from following_hand import rewritten
from press_bench import BenchHand

from dexsim.errors import CalibrationError
from dexsim_real.calibrate import identify_drives
from dexsim_real.calibrate.bench import CalibrateArguments
from dexsim_real.calibrate.identify_drives import identify_hand, joint_log, read_joints, record
from dexsim_real.core.errors import HandError
from dexsim_real.core.log import Kind, LogError, LogReader
from dexsim_real.twin.virtual import ideal_calibration


@pytest.fixture(scope="module", autouse=True)
def short_signals():
    """Every kind of signal, in a third of the time."""
    signals = {name: {**options, "seconds": 0.7, "steps": 2} for name, options in identify_drives._SIGNALS.items()}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(identify_drives, "_SIGNALS", signals)
        yield


def moved(hand, path, bench=None, **options):
    """The log of one joint."""
    bench = bench or BenchHand(hand, [])
    options = arguments(path.parent, identify=True, joints=("mid_joint1",), log=path, **options)
    return record(options, hand, operator(), port=bench, clock=bench.clock, sleep=bench.sleep)


@pytest.fixture(scope="module")
def recorded(hand, tmp_path_factory):
    return moved(hand, tmp_path_factory.mktemp("identify") / "whole.log")


def fitted_log(path, hand, calibration=None, signal="fit"):
    source, joints = read_joints([path], hand, calibration)
    return joint_log("mid_joint1", joints["mid_joint1"][signal], hand, source, calibration)


def test_an_identification_gets_what_was_sent_and_answered(hand, tmp_path, monkeypatch):
    """Every 150th answer is lost, an angle that cannot be true, or NaN: interpolated."""
    sign, offset = np.ones(12), np.zeros(12)
    sign[6], offset[6] = -1.0, 0.2
    hardware = dataclasses.replace(arguments(tmp_path).hardware, joint_sign=tuple(sign), joint_offset=tuple(offset))
    bench, states, given = BenchHand(hand, []), [], []
    bench.position[6] = -0.3
    bench.hand = dataclasses.replace(hand, joint_lower=np.full(12, -3.0), joint_upper=np.full(12, 3.0))
    exchange = bench.exchange

    def wrong(command):
        reply = exchange(command)
        states.append(reply.state["joint"]["position"][6])
        if len(states) % 150:
            return reply
        reply.state["joint"]["position"][6] += (0.0, 0.8, np.nan)[len(states) // 150 % 3]
        return reply if len(states) // 150 % 3 else None

    def keep(log, start, **rest):
        given.append((log, start, rest))
        raise CalibrationError("enough")

    bench.exchange = wrong
    monkeypatch.setattr(identify_drives, "identify", keep)
    options = arguments(
        tmp_path, identify=True, output=tmp_path / "hand.json", joints=("mid_joint1",), hardware=hardware
    )
    with pytest.raises(HandError, match="not identified: mid_joint1"):
        identify_hand(options, hand, operator(), port=bench, clock=bench.clock, sleep=bench.sleep)
    assert off(bench) and bench.closed
    log, start, rest = given[0]
    sent = np.array([command["position"][6] for command in bench.commands]) * -1.0 + 0.2
    answered = -np.array(states) + 0.2
    # The longest stretch of the commands that is the log's: every sample is there, also where no answer came.
    at = next(i for i in range(len(sent)) if np.allclose(sent[i : i + len(log.target)], log.target, atol=1e-6))
    expected, lost = answered[at : at + len(log.target)], np.arange(at + 1, at + len(log.target) + 1) % 150 == 0
    np.testing.assert_allclose(log.position[~lost], expected[~lost], atol=1e-6)
    assert 3 <= lost.sum() < 20 and np.abs(log.position - expected)[lost].max() < 0.05
    assert log.period == 1 / 83 and np.ptp(log.target) == pytest.approx(0.6, abs=0.01) and log.torque is None
    assert rest["dead_band"] is None and rest["substeps"] == 2 and np.ptp(rest["holdout"].target) < 0.5
    # The inertia is the model's: a finger of 63 g and 56 mm with another link.
    assert 2e-4 < start["inertia"] < 2e-3 and start["stall_torque"] == pytest.approx(1.1)


def test_a_first_exchange_without_an_answer_is_a_lost_one_and_many_lost_ones_identify_nothing(hand, recorded, tmp_path):
    def lose(name, which):
        ticks = iter(range(10_000))

        def change(entry):
            if entry.kind != Kind.TICK or not which(next(ticks)):
                return entry
            return dataclasses.replace(entry, content=entry.content | {"answer": b"", "measured": False})

        return rewritten(recorded, tmp_path / name, change)

    whole = fitted_log(recorded, hand)
    log = fitted_log(lose("cut.log", lambda number: number == 0), hand, ideal_calibration(hand))
    np.testing.assert_array_equal(log.target, whole.target)
    np.testing.assert_array_equal(log.position[1:], whole.position[1:])
    assert log.position[0] == whole.position[1] and whole.torque is None and len(log.torque) == len(whole.target)
    with pytest.raises(LogError, match="exchanges are missing"):
        fitted_log(lose("lossy.log", lambda number: number % 20 == 0), hand)


def test_exchanges_that_are_slow_or_missing_identify_nothing_and_a_late_one_does(hand, recorded, tmp_path, monkeypatch):
    """An adapter that waits 16 ms halves the rate, and the fit would take the motion for twice as fast."""
    times = [entry.time for entry in LogReader(recorded) if entry.kind == Kind.TICK]
    begin = times[200] - 0.001

    def cut(name, seconds):
        return rewritten(recorded, tmp_path / name, lambda e: None if begin <= e.time < begin + seconds else e)

    assert len(fitted_log(cut("late.log", 0.02), hand).target) > 0.99 * len(fitted_log(recorded, hand).target)
    with pytest.raises(LogError, match=r"\d+ ms are missing"):
        fitted_log(cut("damaged.log", 1.0), hand)
    monkeypatch.setattr(press_bench, "EXCHANGE", 0.020)
    with pytest.raises(LogError, match="exchanges took 24.1 ms, expected 12.0 ms"):
        fitted_log(moved(hand, tmp_path / "slow.log"), hand)


def test_a_joint_that_fails_leaves_those_of_the_others(hand, recorded, tmp_path, monkeypatch):
    """The exit code is not 0; a joint in several logs is taken from the last."""

    @dataclasses.dataclass
    class Result:
        joint: str

        def report(self):
            return "fine"

    def as_ring(entry):
        ticks = entry.kind == Kind.TICK and "joint" in entry.content
        return dataclasses.replace(entry, content={**entry.content, "joint": "ring_joint1"}) if ticks else entry

    ring = rewritten(recorded, tmp_path / "ring.log", as_ring)
    monkeypatch.setattr(identify_drives, "identify", lambda log, start, **rest: Result(log.name))
    who, output = operator(), tmp_path / "hand.json"
    options = CalibrateArguments(from_log=(ring, recorded, recorded), identify=True, output=output)
    with pytest.raises(HandError, match="not identified: ring_joint1$"):
        identify_hand(options, hand, who)
    assert list(json.loads(output.read_text())["joints"]) == ["mid_joint1"]
    assert "not identified: ring_joint1: ring_joint1: commanded over 0 rad, moved over" in who.out.getvalue()
