"""A run or a calibration that lacks something says so and does not end with exit code 0."""

import dataclasses
import errno
import os
import socket
import threading
import time

import numpy as np
import pytest
from calibrating import QUICK, plates
from calibrating import arguments as press_arguments
from calibrating import record as record_presses
from press_bench import BenchHand

pytest.importorskip("serial")
from following_hand import FollowingHand, arguments, summary

from dexsim_real.control.controller import Controller
from dexsim_real.control.limits import SafetyConfig
from dexsim_real.control.safety import Reaction, Safety
from dexsim_real.core import log
from dexsim_real.core.errors import HandError
from dexsim_real.core.log import LogWriter
from dexsim_real.replay import replay
from dexsim_real.run import __main__ as run
from dexsim_real.run.outcome import Outcome
from dexsim_real.sensors.camera import encode_mask

pytestmark = pytest.mark.usefixtures("jax_as_it_is")


def lines(capsys):
    return [line for line in capsys.readouterr().err.splitlines() if line.startswith("error: ")]


def test_a_hand_that_was_gone_for_most_of_the_run(tmp_path, capsys):
    """It answers again before the end, so that the motors are confirmed to be off."""
    begin = []

    def trouble(index, state):
        if index > 90:
            begin.append(time.monotonic())
            return b"" if time.monotonic() - begin[0] < 0.9 else None

    with FollowingHand(trouble) as peer:
        quick = {"--safety.stale": "0.1", "--link.margin": "0.02"}
        options = arguments(peer, tmp_path, "--seconds", "1.5", "--safety.patience", "0.2")
        options = [quick.get(before, text) for before, text in zip(["", *options], options, strict=False)]
        assert run.main(options) == 1
    assert summary(tmp_path)["end"] == "time is over" and summary(tmp_path)["motors_off"]
    (line,) = lines(capsys)
    assert "no measurement for " in line and "the policy were not finite" not in line


def test_a_hand_that_is_stopped_on_its_way_to_the_start_posture(tmp_path, capsys):
    """As in the run itself: its motors were on."""

    def heat(index, state):
        state["joint"]["temperature"] = 30 if index < 50 else 95

    with FollowingHand(heat) as peer:
        assert run.main(arguments(peer, tmp_path, "--place", "20")) == 1
        assert peer.on().any() and not peer.on()[-1]
    end = summary(tmp_path)["end"]
    assert end.startswith("stopped: too hot") and lines(capsys) == [f"error: {end}"]


def test_a_policy_whose_actions_are_not_finite(tmp_path, capsys, monkeypatch):
    real = Controller.tick

    def tick(self, *inputs):
        return dataclasses.replace(real(self, *inputs), target=np.full(12, np.nan, np.float32))

    monkeypatch.setattr(Controller, "tick", tick)
    with FollowingHand() as peer:
        assert run.main(arguments(peer, tmp_path, "--seconds", "0.5")) == 1
    (line,) = lines(capsys)
    number = summary(tmp_path)["missing"][0].split()[0]
    assert f"error: {number} of {number} actions of the policy were not finite; the hand was held for" in line
    assert "last because: target is not finite" in line


def test_a_camera_that_is_lost(tmp_path):
    """Its pictures end while the hand holds the object: hold, then motors off, as the manual says."""
    server = socket.socket(socket.AF_UNIX)
    server.bind(str(tmp_path / "masks"))
    server.listen()
    mask = np.zeros((480, 640), bool)
    mask[230:250, 310:330] = True

    def show():
        link = server.accept()[0]
        for _ in range(40):
            link.sendall(encode_mask(time.monotonic(), mask))
            time.sleep(0.03)
        link.close()

    thread = threading.Thread(target=show)
    thread.start()
    with FollowingHand() as peer:
        options = arguments(peer, tmp_path, "--seconds", "30", "--safety.patience", "0.3")
        options[options.index("--fixed-object")] = f"--camera=unix:{tmp_path / 'masks'}"
        assert run.main(options) == 1
        on, seconds = peer.on(), np.ptp(peer.times)
    thread.join()
    assert on.any() and not on[-1] and seconds < 20, "of 30: the pictures last 1.2 s, a busy machine some more"
    assert summary(tmp_path)["end"] == "stopped: the camera sends no more pictures for 0.3 s"


def full_after(monkeypatch, size):
    """A disk that takes this many bytes of logs."""
    real, left = log._write_all, [size]

    def write(file, data):
        left[0] -= len(data)
        if left[0] < 0:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        real(file, data)

    monkeypatch.setattr(log, "_write_all", write)


def test_a_full_disk(tmp_path, capsys, monkeypatch):
    full_after(monkeypatch, 100_000)
    with FollowingHand() as peer:
        assert run.main(arguments(peer, tmp_path, "--seconds", "0.5")) == 1
    (line,) = lines(capsys)
    assert f"{summary(tmp_path)['log_dropped']} log records are lost" in line and "No space left on device" in line


def test_a_calibration_whose_presses_are_lost_is_none(hand, tmp_path, monkeypatch):
    """While it presses, or in the end if the records reach the disk later than the presses are made."""
    full_after(monkeypatch, 100_000)
    options = press_arguments(tmp_path, press=QUICK, sides=False)
    with pytest.raises(HandError, match=r"(stopped: the log is|log records are) lost .*No space left"):
        record_presses(BenchHand(hand, plates(hand, "index pad")), hand, options)
    real = LogWriter.close

    def close(self):
        real(self)
        self.dropped = 7

    monkeypatch.undo()
    monkeypatch.setattr(LogWriter, "close", close)
    options = dataclasses.replace(options, log=tmp_path / "b.log")
    with pytest.raises(HandError, match="7 log records are lost .the disk is too slow."):
        record_presses(BenchHand(hand, plates(hand, "index pad")), hand, options)


def test_a_whole_run_lacks_nothing_and_what_may_be_missing(hand, tmp_path):
    """A tenth of the time without a measurement, half of it held."""
    with LogWriter(tmp_path / "a.log") as writer:
        pass
    safety = Safety(hand, SafetyConfig())
    safety.engaged = True

    def outcome(blind, held):
        found = Outcome(5.0)
        for k in range(100):
            safety.last = (Reaction.HOLD, "a joint is too fast") if k < held else (Reaction.CLIP, "")
            found.add(5.0 + (k + 1) / 100, k >= blind, safety)
            found.act(np.zeros(12))
        return found.missing(writer)

    assert outcome(0, 0) == outcome(9, 49) == []
    assert outcome(11, 0) == ["no measurement for 11 % of the run"]
    assert outcome(0, 51) == ["the hand was held for 51 % of the run, last because: a joint is too fast"]
    safety.engaged = False
    assert outcome(0, 100) == []


def test_a_taxel_that_gets_stuck_does_not_end_the_grasp(tmp_path, capsys):
    """It reads 25.5 N: above what a finger may press. The replay masks it at the same answer."""

    def trouble(index, state):
        state["tip"]["taxel"]["z"][3, 77] = 255 if index > 90 else 0
        state["tip"]["taxel"]["z"][1, 5] = 250

    with FollowingHand(trouble) as peer:
        options = arguments(peer, tmp_path, "--seconds", "2")
        assert run.main([option for option in options if option != "--quiet"]) == 0
    shown = capsys.readouterr().err
    for text in (
        "index: stuck and read as 0 from now on: taxel column 0 row 5",
        "ring: stuck and read as 0 from now on",
    ):
        assert f"warning: {text}" in shown
    held = summary(tmp_path)["safety"].get("the fingertip force is too high", 0)
    assert 10 < held < 40 and summary(tmp_path)["missing"] == []
    again = replay.replay(tmp_path / "run.log").report
    assert again["readings_same"] == again["ticks"] > 50 and again["first_difference"] is None
