"""A run or a calibration that lacks something says so and does not end with exit code 0."""

import dataclasses
import socket
import threading
import time

import numpy as np
import pytest

pytest.importorskip("serial")
from following_hand import FollowingHand, arguments, summary

from dexsim_real.control.controller import Controller
from dexsim_real.control.limits import SafetyConfig
from dexsim_real.control.safety import Reaction, Safety
from dexsim_real.core.log import LogWriter
from dexsim_real.run import __main__ as run
from dexsim_real.run.session import Outcome
from dexsim_real.sensors.camera import encode_mask
from dexsim_real.wire.link import Refusal

pytestmark = pytest.mark.usefixtures("jax_as_it_is")


def lines(capsys):
    return [line for line in capsys.readouterr().err.splitlines() if line.startswith("error: ")]


def test_a_hand_that_was_gone_for_most_of_the_run(tmp_path, capsys):
    """It answers again before the end, so that the motors are confirmed to be off."""
    begin = []

    def trouble(index, state):
        if peer.on().sum() > 30:
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
    mask = np.zeros((481, 643), bool)
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


def test_a_whole_run_lacks_nothing_and_what_may_be_missing(hand, tmp_path):
    """A tenth of the time without a measurement, half of it held or with the motors off."""
    with LogWriter(tmp_path / "a.log") as writer:
        pass
    safety = Safety(hand, SafetyConfig())

    def missing(blind=0, held=0, reaction=Reaction.HOLD, engaged=True):
        outcome, safety.engaged = Outcome(), engaged
        for k in range(100):
            safety.last = (reaction, "a joint is too fast") if k < held else (Reaction.CLIP, "")
            outcome.add(None if k < blind else np.zeros(12), safety)
        return outcome.missing(writer)

    assert missing() == missing(9, 49) == missing(held=100, engaged=False) == []
    assert missing(blind=11) == ["no measurement for 11 % of the run"]
    for reaction in (Reaction.HOLD, Reaction.RELAX):
        (line,) = missing(held=51, reaction=reaction)
        assert line == "the hand was held for 51 % of the run, last because: a joint is too fast"
    safety.refuse(Refusal("the hand reports busy", serious=False))
    assert missing(blind=50) == ["no measurement for 50 % of the run (the hand reports busy)"]
    writer.dropped, writer.failure = 3, "No space left on device"
    assert missing() == ["3 log records are lost (No space left on device)"]
