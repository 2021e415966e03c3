"""Identification of the drives: what is sent to the hand, and logs that are unusable."""

import dataclasses
import json

import numpy as np
import press_bench
import pytest
from calibrating import arguments, off, on, operator
from press_bench import BenchHand

from dexsim.calibration.maps import save_calibration
from dexsim.core.errors import CalibrationError
from dexsim_real.calibrate import identify_drives
from dexsim_real.calibrate.options import CalibrateArguments
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


@pytest.mark.parametrize("angle", [0.8, np.nan])
def test_an_angle_that_cannot_be_true_is_a_lost_one(hand, tmp_path, monkeypatch, angle):
    bench, count = BenchHand(hand, []), [0]
    exchange = bench.exchange

    def wrong(command):
        reply = exchange(command)
        count[0] += 1
        if count[0] % 150 == 0:
            reply.state["joint"]["position"][6] += angle
        return reply

    bench.exchange = wrong
    log, _, rest = identifying(bench, hand, tmp_path, monkeypatch)
    assert np.abs(np.diff(log.position)).max() < 0.1 and np.abs(np.diff(rest["holdout"].position)).max() < 0.1


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


@pytest.fixture(scope="module")
def recorded(hand, tmp_path_factory):
    """The log of one joint."""
    return moved(hand, tmp_path_factory.mktemp("identify") / "whole.log")


def moved(hand, path, **options):
    bench = BenchHand(hand, [])
    options = arguments(path.parent, identify=True, joints=("mid_joint1",), log=path, **options)
    return identify_drives.record(options, hand, operator(), port=bench, clock=bench.clock, sleep=bench.sleep)


def rewritten(source, path, change):
    """A log with changed records; a change to None drops one."""
    with LogWriter(path) as log:
        for entry in LogReader(source):
            if (new := change(entry)) is not None:
                log.add(new.kind, new.content, new.time)
    return path


def configured(**values):
    """A change of the configuration."""

    def change(entry):
        meta = entry.kind == Kind.META and "task" in entry.content
        return dataclasses.replace(entry, content={**entry.content, **values}) if meta else entry

    return change


def samples(*paths, hand, calibration=None):
    return len(identify_drives.read_logs(paths, hand, calibration)["mid_joint1"][0].target)


def test_exchanges_that_took_longer_than_their_period_identify_nothing(hand, tmp_path, monkeypatch):
    """An adapter that waits 16 ms halves the rate, and the fit would take the motion for twice as fast."""
    monkeypatch.setattr(press_bench, "EXCHANGE", 0.020)
    slow = moved(hand, tmp_path / "slow.log")
    with pytest.raises(LogError, match="slow.log: fit of mid_joint1: an exchange took 24.1 ms, 12.0 ms were expected"):
        samples(slow, hand=hand)


def test_a_stretch_that_is_missing_identifies_nothing_and_a_late_exchange_does(hand, recorded, tmp_path):
    times = [entry.time for entry in LogReader(recorded) if entry.kind == Kind.SENT]
    for seconds, name in ((0.02, "late.log"), (1.0, "damaged.log")):
        begin = times[200] - 0.001
        path = rewritten(
            recorded,
            tmp_path / name,
            lambda e: None if begin <= e.time < begin + seconds else e,  # noqa: B023
        )
        if name == "late.log":
            assert samples(path, hand=hand) > 0.99 * samples(recorded, hand=hand)
        else:
            with pytest.raises(LogError, match=r"damaged.log: fit of mid_joint1: \d+ ms of \d+ ms are missing"):
                samples(path, hand=hand)


def test_a_later_log_replaces_a_joint_and_other_logs_do_not_mix(hand, recorded, tmp_path):
    again = rewritten(recorded, tmp_path / "again.log", lambda entry: entry)
    assert samples(recorded, again, hand=hand) == samples(recorded, hand=hand)
    hardware = {**next(entry.content["hardware"] for entry in LogReader(recorded) if entry.kind == Kind.META)}
    for name, says, values in (
        ("rate", "other --hardware options or another --rate", {"rate": 82.0}),
        ("hardware", "other --hardware options", {"hardware": {**hardware, "taxel_floor": 2.0}}),
        ("serial", "is of another hand .right, serial number 2R32OTHER.", {"serial": "2R32OTHER"}),
    ):
        other = rewritten(recorded, tmp_path / f"{name}.log", configured(**values))
        with pytest.raises(LogError, match=f"{name}.log: .*{says}"):
            samples(recorded, other, hand=hand)


def test_a_calibration_of_another_hand_is_refused_for_a_log(hand, recorded, tmp_path):
    known = dataclasses.replace(ideal_calibration(hand), serial="2R32OTHER")
    save_calibration(tmp_path / "other.toml", known)
    options = CalibrateArguments(
        from_log=(recorded,), identify=True, calibration=tmp_path / "other.toml", output=tmp_path / "hand.json"
    )
    with pytest.raises(HandError, match="whole.log: this is hand 2R32BENCH, the calibration is of hand 2R32OTHER"):
        identify_drives.identify_hand(options, hand, operator())
    assert samples(recorded, hand=hand, calibration=dataclasses.replace(known, serial="2R32BENCH"))


@pytest.mark.slow
def test_a_joint_that_fails_leaves_those_of_the_others(hand, recorded, tmp_path, monkeypatch):
    """One has too little motion, another a log with a gap; the exit code is not 0."""

    @dataclasses.dataclass
    class Found:
        joint: str

        def report(self):
            return "fine"

    def fit(log, start, **rest):
        if log.name == "ring_joint1":
            raise CalibrationError("ring_joint1: moved over 0.001 rad")
        return Found(log.name)

    def as_joint(name):
        def change(entry):
            ticks = entry.kind == Kind.TICK and "joint" in entry.content
            return dataclasses.replace(entry, content={**entry.content, "joint": name}) if ticks else entry

        return change

    ring = rewritten(recorded, tmp_path / "ring.log", as_joint("ring_joint1"))
    times = [entry.time for entry in LogReader(recorded) if entry.kind == Kind.SENT]
    cut = rewritten(recorded, tmp_path / "gap.log", lambda e: None if 0 < e.time - times[200] < 1.0 else e)
    cut = rewritten(cut, tmp_path / "thumb.log", as_joint("thumb_bend"))
    monkeypatch.setattr(identify_drives, "identify", fit)
    who, output = operator(), tmp_path / "hand.json"
    options = CalibrateArguments(from_log=(ring, recorded, cut), identify=True, output=output)
    with pytest.raises(HandError, match="not identified: thumb_bend, ring_joint1 .*the other joints are in .*json"):
        identify_drives.identify_hand(options, hand, who)
    assert list(json.loads(output.read_text())["joints"]) == ["mid_joint1"]
    said = who.console.file.getvalue()
    assert "not identified: ring_joint1: moved over 0.001 rad" in said and "thumb.log: fit of thumb_bend: " in said
