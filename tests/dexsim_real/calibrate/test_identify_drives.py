"""Identification of the drives: what is sent to the hand, and logs that are unusable."""

import dataclasses

import numpy as np
import pytest
from calibrating import arguments, off, on, operator
from press_bench import BenchHand

from dexsim.core.errors import CalibrationError
from dexsim_real.calibrate import identify_drives
from dexsim_real.calibrate.read import read_logs
from dexsim_real.core.errors import HandError
from dexsim_real.core.log import Kind, LogError, LogReader, LogWriter
from dexsim_real.twin.virtual import ideal_calibration


def identifying(bench, hand, folder, monkeypatch, **options):
    """Record with a fit that only keeps what it was given; the logs, by joint."""
    kept = {}

    def keep(log, start, **rest):
        kept[log.name] = log, start, rest
        raise CalibrationError("enough")

    monkeypatch.setattr(identify_drives, "identify", keep)
    options = arguments(folder, identify=True, output=folder / "hand.json", joints=("mid_joint1",), **options)
    with pytest.raises(CalibrationError, match="enough"):
        identify_drives.identify_hand(options, hand, operator(), port=bench, clock=bench.clock, sleep=bench.sleep)
    return kept["mid_joint1"]


def test_an_identification_gets_what_was_sent_and_answered(hand, tmp_path, monkeypatch):
    sign, offset = np.ones(12), np.zeros(12)
    sign[6], offset[6] = -1.0, 0.2
    hardware = dataclasses.replace(arguments(tmp_path).hardware, joint_sign=tuple(sign), joint_offset=tuple(offset))
    bench = BenchHand(hand, [])
    bench.position[6] = -0.3
    limits = dataclasses.replace(hand, joint_lower=np.full(12, -3.0), joint_upper=np.full(12, 3.0))
    bench.hand, states, exchange = limits, [], bench.exchange

    def lossy(command):
        reply = exchange(command)
        states.append(reply.state["joint"]["position"][6])
        return None if len(states) % 150 == 0 else reply

    bench.exchange = lossy
    log, start, rest = identifying(bench, hand, tmp_path, monkeypatch, hardware=hardware)
    assert off(bench) and bench.closed
    sent = np.array([command["position"][6] for command in bench.commands]) * -1.0 + 0.2
    answered = -np.array(states) + 0.2
    # The longest stretch of the commands that is the log's: every sample is there, also where no answer came.
    at = next(i for i in range(len(sent)) if np.allclose(sent[i : i + len(log.target)], log.target, atol=1e-6))
    wanted, lost = answered[at : at + len(log.target)], np.arange(at + 1, at + len(log.target) + 1) % 150 == 0
    np.testing.assert_allclose(log.position[~lost], wanted[~lost], atol=1e-6)
    assert 0 < lost.sum() < 20 and np.abs(log.position - wanted)[lost].max() < 0.05
    assert log.period == 1 / 83 and np.ptp(log.target) == pytest.approx(0.6, abs=0.01) and log.torque is None
    assert rest["holdout"] is not None and rest["dead_band"] is None and rest["substeps"] == 2
    # The inertia is the model's: a finger of 63 g and 56 mm with another link.
    assert 2e-4 < start["inertia"] < 2e-3 and start["stall_torque"] == pytest.approx(1.1)


def test_a_line_that_loses_too_much_identifies_nothing(hand, tmp_path):
    bench, count = BenchHand(hand, []), [0]
    exchange = bench.exchange

    def lossy(command):
        count[0] += 1
        reply = exchange(command)
        return None if count[0] % 20 == 0 else reply

    bench.exchange = lossy
    options = arguments(tmp_path, identify=True, output=tmp_path / "hand.json", joints=("mid_joint1",))
    with pytest.raises(LogError, match="mid_joint1: .* exchanges are missing"):
        identify_drives.identify_hand(options, hand, operator(), port=bench, clock=bench.clock, sleep=bench.sleep)
    with pytest.raises(LogError, match="this is a log of .identify."):
        read_logs([options.log], hand)
    with LogWriter(tmp_path / "forged.log") as log:
        log.add(Kind.META, {"task": "identify"})
    with pytest.raises(LogError, match="forged.log: a record is not as the bridge writes it"):
        identify_drives.read_logs([tmp_path / "forged.log"], hand, None)
    with pytest.raises(HandError, match="no joint 'knee'"):
        wrong = dataclasses.replace(options, joints=("knee",), log=tmp_path / "b.log")
        identify_drives.identify_hand(wrong, hand, operator())


def test_a_first_exchange_without_an_answer_is_a_lost_one(hand, tmp_path, monkeypatch):
    """Nothing was received before it."""
    bench = BenchHand(hand, [])
    whole = identifying(bench, hand, tmp_path, monkeypatch)[0]
    entries = list(LogReader(tmp_path / "hand.log"))
    first = next(entry.content[0] for entry in entries if entry.kind == Kind.SENT)
    with LogWriter(tmp_path / "cut.log") as log:
        for entry in entries:
            if entry.kind != Kind.RECEIVED or entry.content[0] != first:
                log.add(entry.kind, entry.content, entry.time)
    for calibration in (None, ideal_calibration(hand)):
        found, check = identify_drives.read_logs([tmp_path / "cut.log"], hand, calibration)["mid_joint1"]
        np.testing.assert_array_equal(found.target, whole.target)
        np.testing.assert_array_equal(found.position[1:], whole.position[1:])
        assert found.position[0] == whole.position[1] and check is not None
        assert (found.torque is None) == (calibration is None)
        assert found.torque is None or len(found.torque) == len(whole.target)


def test_a_hand_that_is_silent_while_it_is_tared_moves_nothing(hand, tmp_path):
    bench = BenchHand(hand, [])
    exchange = bench.exchange

    def answer(command):
        reply = exchange(command)
        return None if reply.sent < 1.0 else reply

    bench.exchange = answer
    options = arguments(tmp_path, identify=True, output=tmp_path / "hand.json", joints=("mid_joint1",))
    with pytest.raises(HandError, match="cannot tare the taxels: no usable answer in 0.5 s; check the cable"):
        identify_drives.identify_hand(options, hand, operator(), port=bench, clock=bench.clock, sleep=bench.sleep)
    assert not on(bench).any() and off(bench) and bench.closed
