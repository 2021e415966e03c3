"""Runs of a policy on a scripted hand: what ends them turns the motors off, what they lack is said, what they show."""

import contextlib
import dataclasses
import io
import os
import re
import select
import socket
import sys
import threading
import time
from types import SimpleNamespace

import numpy as np
import pytest
from following_hand import FollowingHand, arguments, records, summary
from rich.console import Console
from scripted_driver import ScriptedDriver

import dexsim_real
from dexsim.calibration.maps import save_calibration
from dexsim.core import cli
from dexsim_ppo.policy import load_policy
from dexsim_real import replay, run
from dexsim_real.control.controller import Controller, limits_for
from dexsim_real.control.limits import SafetyConfig
from dexsim_real.control.safety import Reaction, Safety
from dexsim_real.core.errors import HandError
from dexsim_real.core.log import Kind, LogWriter
from dexsim_real.loop import TARE_SAMPLES
from dexsim_real.run import Outcome
from dexsim_real.sensors.camera import encode_mask
from dexsim_real.sensors.hand import HandSensing, HardwareConfig
from dexsim_real.twin.virtual import ideal_calibration
from dexsim_real.wire.frames import Command, Frame, empty_state
from dexsim_real.wire.link import LinkConfig, Refusal

pytest.importorskip("serial")
pytestmark = pytest.mark.usefixtures("jax_as_it_is")


@pytest.mark.parametrize("failure", ["raises", "hangs"])
def test_a_policy_that_dies_leaves_the_hand_safe(tmp_path, monkeypatch, virtual_time, failure):
    real, died = Controller.tick, []

    def tick(self, *inputs):
        if peer.on().sum() > 40:
            died.append(1)
            if failure == "raises":
                raise RuntimeError("the policy broke")
            if len(died) == 1:
                virtual_time.sleep(1.6)
        return real(self, *inputs)

    monkeypatch.setattr(Controller, "tick", tick)
    with FollowingHand() as peer:
        options = arguments(peer, tmp_path, "--seconds", "8", "--safety.watchdog", "0.08")
        if failure == "raises":
            with pytest.raises(RuntimeError, match="the policy broke"):
                run.main(options)
        else:
            assert run.main(options) == 1
            assert summary(tmp_path)["end"] == "stopped: no target for 1 s"
        assert peer.on().any() and not peer.on()[-1]
    assert records(tmp_path, Kind.END)


def error_bit(index, state):
    if index > 80:
        state["joint"]["joint_error"][8] = 4


def heat(index, state):
    state["joint"]["temperature"] = 30 if index < 50 else 95


@pytest.mark.parametrize(
    ("trouble", "more", "says"),
    [
        (heat, ("--place", "20"), "too hot: joint thumb_bend (thumb), 95 degC"),  # on its way to the start posture
        (error_bit, (), "error bits 0x0004 of the joint board, joint ring_joint1 (ring)"),
    ],
)
def test_an_alarm_ends_the_run_with_its_line_and_the_motors_off(tmp_path, capsys, virtual_time, trouble, more, says):
    with FollowingHand(trouble) as peer:
        assert run.main(arguments(peer, tmp_path, "--seconds", "20", *more)) == 1
        assert peer.on().any() and not peer.on()[-1]
    assert summary(tmp_path)["end"] == f"stopped: {says}" and summary(tmp_path)["seconds"] < 3
    assert capsys.readouterr().err == f"error: stopped: {says}\n", "also with --quiet"


HOT = Frame(0x80, 0xFE, Command.ERROR, (1501028).to_bytes(4, "little")).encode()


@pytest.mark.parametrize("first", [0, 10])
def test_over_temperature_is_not_taken_for_a_bad_cable(tmp_path, virtual_time, first):
    """From the start, and while the taxels are tared."""
    with FollowingHand(lambda index, state: HOT if index >= first else None) as peer:
        with pytest.raises(HandError, match=r"over-temperature \(1501028\)") as error:
            run.main(arguments(peer, tmp_path, "--link.handshake", "0.1"))
        assert "cable" not in str(error.value) and not peer.on().any()


def test_a_calibration_of_another_hand_is_refused_before_anything_moves(hand, tmp_path, virtual_time):
    path = tmp_path / "hand.toml"
    save_calibration(path, dataclasses.replace(ideal_calibration(hand), serial="2R32OTHER", handedness="right"))
    with FollowingHand() as peer:
        options = [o for o in arguments(peer, tmp_path, "--calibration", str(path)) if o != "--uncalibrated"]
        with pytest.raises(HandError, match="this is hand 2R32SCRIPTED, the calibration is of hand 2R32OTHER"):
            run.main(options)
        assert not peer.on().any()


def test_motors_off_means_off_on_a_left_hand_and_a_right_one_is_refused(tmp_path, capsys, virtual_time):
    """With the policy of the right hand; the view says what is read."""
    with FollowingHand() as peer:
        options = ("--hand", "xhand_left", "--motors-off", "--seconds", "0.9")
        with pytest.raises(HandError, match="this is a right hand .* the model a left one"):
            run.main(arguments(peer, tmp_path / "refused", *options))
        peer.registers = {20: b"left", 21: b"2L32SCRIPTED"}
        assert run.main([o for o in arguments(peer, tmp_path, *options) if o != "--quiet"]) == 0
        assert peer.commands and not peer.on().any()
    shown = capsys.readouterr().err
    for text in ("firmware 1.3.9", "the policy starts", "exchange jitter", "end: time is over", "round trip"):
        assert text in shown, text
    again = replay.Replay(tmp_path / "run.log")
    assert again.hand.name == "xhand_left" and again.report["first_difference"] is None and again.report["ticks"] >= 5


@pytest.mark.parametrize(("rate", "watchdog"), [(5.0, 0.5), (20.0, 0.3)])
def test_a_target_stays_good_for_two_and_a_half_ticks_of_its_policy(hand, rate, watchdog):
    """At 5 Hz every second cycle would hold otherwise. Where the setting is longer, the setting counts."""
    slow = Controller(dataclasses.replace(load_policy("grasp"), control_rate=rate), hand)
    assert limits_for(SafetyConfig(watchdog=0.3), slow).watchdog == pytest.approx(watchdog)


def test_a_line_full_of_faults_does_not_end_the_run(hand, tmp_path, virtual_time):
    rng = np.random.default_rng(1)
    faults = []

    def trouble(index, state):
        if index < 60 or rng.random() > 0.1:
            return None
        faults.append(index)
        whole = bytearray(peer.whole())
        if rng.random() < 0.5:
            whole[int(rng.integers(len(whole)))] ^= 1 << int(rng.integers(8))
        else:
            del whole[int(rng.integers(len(whole))) :]
        return bytes(whole)

    with FollowingHand(trouble) as peer:
        assert run.main(arguments(peer, tmp_path, "--seconds", "1.5", "--link.margin", "0.06")) == 0
        sent = np.array([block["position"] for block in peer.commands])[peer.on()]
    assert np.all(sent >= hand.joint_lower - 1e-6) and np.all(sent <= hand.joint_upper + 1e-6)
    link = summary(tmp_path)["link"]
    assert link["corrupt"] + link["silent"] == len(faults) > 5 and link["late"] == 0
    assert link["sent"] == sum(link[end] for end in ("answered", "corrupt", "silent", "refused", "lost"))
    assert replay.Replay(tmp_path / "run.log").report["first_difference"] is None


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({}, "either --calibration FILE, or --uncalibrated"),
        ({"--uncalibrated": (), "--command": ("1.5",)}, "between 0 and 1"),
        ({"--uncalibrated": ()}, "cannot ask for confirmation without a terminal"),
        ({"--uncalibrated": (), "--yes": (), "--fixed-object": ()}, "there is no such port"),
        ({"--uncalibrated": (), "--yes": (), "--port": None}, "--camera, or --fixed-object"),
    ],
)
def test_what_is_missing_is_said_in_one_line(tmp_path, capsys, options, says):
    with FollowingHand() as peer:
        port = peer.port if "--port" in options else str(tmp_path / "none")
        words = ["grasp", "--port", port, "--quiet", "--no-guard", "--link.settle", "0", "--link.no-paced"]
        words += [word for name, more in options.items() if more is not None for word in (name, *more)]
        with pytest.raises(SystemExit) as stop:
            cli.run(lambda _: run.main([*words, "--log", str(tmp_path / "a.log")]))
        error = capsys.readouterr().err.strip().splitlines()[-1]
        assert stop.value.code == 2 and error.startswith("error: ") and says in error
        assert not peer.on().any()


def test_one_call_runs_a_policy_and_says_how_it_went(tmp_path, virtual_time):
    with FollowingHand() as peer:
        result = dexsim_real.run_policy(
            "grasp",
            peer.port,
            seconds=0.5,
            command=0.7,
            yes=True,
            fixed_object=True,
            approach=0.4,
            guard=False,
            realtime=False,
            quiet=True,
            link=LinkConfig(settle=0.0, paced=False, margin=0.2),
            safety=SafetyConfig(stale=1.0),
            log=tmp_path / "run.log",
        )
        assert peer.on().any() and not peer.on()[-1]
    assert (result.end, result.code, result.problem) == ("time is over", 0, "") and result.summary["motors_off"]
    assert result.summary["seconds"] >= 0.5 and result.summary["command"] == 0.7
    assert result.log == tmp_path / "run.log" and len(records(tmp_path, Kind.TICK)) > 5


class Driver(ScriptedDriver):
    """Answers until its taxels are tared; its motors must stay off."""

    def read(self):
        assert not any(targets.on for targets in self.sent)
        time.sleep(0.002)
        if len(self.sent) > TARE_SAMPLES:
            raise RuntimeError("the SDK broke")
        return self.state


def test_what_ends_the_exchanges_before_the_motors_come_on_is_told(hand, tmp_path, monkeypatch):
    """Not that the hand has stopped answering."""
    driver = Driver(hand)
    monkeypatch.setitem(sys.modules, "my_sdk", SimpleNamespace(open_hand=lambda hand, config: driver))
    with pytest.raises(HandError, match="the exchange thread failed: .*the SDK broke"):
        run.main(arguments(SimpleNamespace(port="sdk:my_sdk"), tmp_path))


def test_a_run_ends_when_its_exchange_thread_has_failed():
    def fail():
        raise HandError("the exchange thread failed")

    parts = SimpleNamespace(loop=SimpleNamespace(check=fail), safety=SimpleNamespace(latched=""))
    with pytest.raises(HandError, match="the exchange thread failed"):
        run.Session._check(parts)


def test_a_hand_that_was_gone_for_most_of_the_run_and_actions_that_are_not_finite(
    tmp_path, capsys, monkeypatch, virtual_time
):
    """It answers again before the end, so that the motors are confirmed to be off."""
    real, begin = Controller.tick, []

    def tick(self, *inputs):
        return dataclasses.replace(real(self, *inputs), target=np.full(12, np.nan, np.float32))

    def trouble(index, state):
        if peer.on().sum() > 30:
            begin.append(virtual_time.now)
            return b"" if virtual_time.now - begin[0] < 0.9 else None

    monkeypatch.setattr(Controller, "tick", tick)
    with FollowingHand(trouble) as peer:
        quick = {"--safety.stale": "0.1", "--link.margin": "0.02"}
        options = arguments(peer, tmp_path, "--seconds", "1.5", "--safety.patience", "0.2")
        options = [quick.get(before, text) for before, text in zip(["", *options], options, strict=False)]
        assert run.main(options) == 1
    assert summary(tmp_path)["end"] == "time is over" and summary(tmp_path)["motors_off"]
    (line,) = (line for line in capsys.readouterr().err.splitlines() if line.startswith("error: "))
    assert re.match(r"error: no measurement for \d+ % of the run; (\d+) of \1 actions of the policy were not fin", line)


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
    safety.alarms.refuse(Refusal("the hand reports busy", serious=False))
    assert missing(blind=50) == ["no measurement for 50 % of the run (the hand reports busy)"]
    writer.dropped, writer.failure = 3, "No space left on device"
    assert missing() == ["3 log records are lost (No space left on device)"]


def test_the_view_shows_every_joint_and_finger_by_name_on_100_by_30(hand):
    """Every number differs, and is as wide as it can be."""
    block = empty_state()
    joint, tip = block["joint"], block["tip"]
    joint["position"] = np.linspace(-0.101, 1.9, 12)
    joint["current"] = -np.arange(1110, 1230, 10)
    joint["temperature"] = np.arange(101, 113) + 256 * 42  # the palm's in the high byte
    joint["palm_error"][3], joint["joint_error"][3], joint["tip_error"][11] = 0x0101, 0xFFFF, 0x8000
    tip["taxel"]["z"][:, :3] = np.arange(200, 205)[:, None]
    tip["temperature"] = np.arange(121, 126)
    measured, targets = HandSensing(hand, HardwareConfig()).measure(block), np.linspace(-2, 1.8, 12)
    tables = run.hand_tables(hand, measured, targets, True)
    view = run.StatusView("a title", lambda: {f"row {number}": "x" * 80 for number in range(12)}, lambda: tables, False)
    view.console = Console(width=100, file=io.StringIO())
    view.show()
    shown = view.console.file.getvalue()
    lines = shown.splitlines()
    assert len(lines) <= 29 and "…" not in shown
    for number, name in enumerate(hand.joint_names):
        errors = {3: "0101 ffff -", 11: "- - 8000"}.get(number, "- - -")
        row = f"{number} {name} {joint['position'][number]:.3f} {targets[number]:.3f} {1.11 + 0.01 * number:.2f}"
        assert any(" ".join(line.split()).startswith(f"{row} {101 + number} {errors}") for line in lines), row
    for finger, name in enumerate(hand.finger_names):
        assert re.search(rf"{name} +{60 + 0.3 * finger:.1f} +{121 + finger}$", shown, re.MULTILINE)
    assert re.search(r"sum +303.0 *$", shown, re.MULTILINE) and re.search(r"palm board +42$", shown, re.MULTILINE)


@pytest.mark.parametrize("gone", ["window", "pipe"])
def test_a_terminal_that_is_gone_ends_no_run(monkeypatch, gone):
    """An SSH connection that broke, a `tee` that Ctrl-C ended: with Rich alone the exchange thread would end."""
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setattr(run, "_LIVE", 0.02)
    far, near = os.openpty() if gone == "window" else os.pipe()
    screen = os.fdopen(near, "w", buffering=1)
    monkeypatch.setattr("sys.stderr", screen)
    view = run.StatusView("a title", lambda: {"age": "3.1 ms"}, lambda: "", False)
    os.close(far)
    try:
        view.note("before")
        view.show()
        with pytest.raises(SystemExit, match="129"), view:
            time.sleep(0.1)
            raise SystemExit(129)
        view.note("end")
    finally:
        with open(os.devnull, "w") as nowhere:
            os.dup2(nowhere.fileno(), near)  # What the stream still holds can be written now.
        screen.close()


# --- the question --------------------------------------------------------------------------------


class Terminal(io.StringIO):
    """Somebody who types an answer; `motors` says whether they were on when the question came."""

    def __init__(self, answer, peer):
        super().__init__(answer)
        self.peer, self.motors = peer, None

    def isatty(self):
        return True

    def readline(self, *size):
        self.motors = bool(self.peer.on().any())
        return super().readline(*size)


@pytest.mark.parametrize(("answer", "moves"), [("y\n", True), ("", False), ("yeah\n", False)])
def test_the_motors_come_on_after_a_yes_and_after_nothing_else(tmp_path, monkeypatch, virtual_time, answer, moves):
    with FollowingHand() as peer:
        terminal = Terminal(answer, peer)
        monkeypatch.setattr("sys.stdin", terminal)
        monkeypatch.setattr("sys.stderr", Terminal("", peer))
        options = [o for o in arguments(peer, tmp_path, "--seconds", "0.2") if o != "--yes"]
        with contextlib.nullcontext() if moves else pytest.raises(HandError, match="the motors stayed off"):
            run.main(options)
        assert terminal.motors is False and peer.commands and peer.on().any() == moves
    assert moves or "not confirmed" in records(tmp_path, Kind.END)[0]["end"]


def test_what_was_typed_before_the_question_is_no_answer(monkeypatch):
    """The motors come on at a pose that has been shown."""
    master, slave = os.openpty()
    try:
        with os.fdopen(slave) as terminal:
            monkeypatch.setattr("sys.stdin", terminal)
            os.write(master, b"y\n")
            assert select.select([terminal], [], [], 5)[0]
            error = SimpleNamespace(write=lambda text: os.write(master, b"n\n"), flush=lambda: None)
            monkeypatch.setattr("sys.stderr", error)
            with pytest.raises(HandError, match="the motors stayed off"):
                run.ask()
    finally:
        os.close(master)
