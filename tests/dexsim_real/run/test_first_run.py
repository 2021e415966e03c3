"""The first run on a hand: what is shown of it, and the question before the motors come on."""

import io
import os
import re
import select
from types import SimpleNamespace

import numpy as np
import pytest
from rich.console import Console

pytest.importorskip("serial")
from following_hand import FollowingHand, arguments, records

from dexsim.core import cli
from dexsim_real.core.errors import HandError
from dexsim_real.core.log import Kind
from dexsim_real.run import __main__ as run
from dexsim_real.run import consent, status
from dexsim_real.run.hand_view import HandState, hand_line
from dexsim_real.sensors.hand import HandSensing, HardwareConfig
from dexsim_real.wire.frames import empty_state

pytestmark = pytest.mark.usefixtures("jax_as_it_is")
FINGERS = ("thumb", "index", "middle", "ring", "pinky")


@pytest.fixture
def state(hand):
    """Every number differs, and is as wide as it can be."""
    block = empty_state()
    joint, tip = block["joint"], block["tip"]
    joint["position"] = np.linspace(-0.101, 1.9, 12)
    joint["current"] = -np.arange(1101, 1113)
    joint["temperature"] = np.arange(101, 113) + 256 * 42  # the palm's in the high byte
    joint["palm_error"][3], joint["joint_error"][3], joint["tip_error"][11] = 0x0101, 0xFFFF, 0x8000
    tip["taxel"]["z"][:, :3] = np.arange(200, 205)[:, None]
    tip["temperature"] = np.arange(121, 126)
    measured = HandSensing(hand, HardwareConfig()).measure(block)
    return HandState(hand, measured, np.linspace(-0.202, 1.8, 12), sent=True)


def picture(state, rows=12):
    """The view on a terminal of 100 columns, as text."""
    texts = {f"row {number}": "x" * 80 for number in range(rows)}
    view = status.StatusView("a title", lambda: status.Status(texts, state))
    view.console = Console(width=100, file=io.StringIO())
    view.show()
    return view.console.file.getvalue()


def test_the_view_shows_every_joint_and_finger_by_name_on_100_by_30(hand, state):
    shown = picture(state)
    lines = shown.splitlines()
    assert len(lines) <= 29 and "…" not in shown
    for joint, name in enumerate(hand.joint_names):
        (line,) = (line for line in lines if re.match(rf"\s*{joint} {name} ", line))
        angle, target, current, heat, *errors = line.split()[2:9]
        assert abs(float(angle) - state.measured.joint_position[joint]) < 6e-4
        assert abs(float(target) - state.target[joint]) < 6e-4
        assert (float(current), int(heat)) == (pytest.approx(1.101 + 0.001 * joint, abs=0.006), 101 + joint)
        assert errors == {3: ["0101", "ffff", "-"], 11: ["-", "-", "8000"]}.get(joint, ["-"] * 3)
    for finger, name in enumerate(FINGERS):
        assert re.search(rf"{name} +{60 + 0.3 * finger:.1f} +{121 + finger}$", shown, re.MULTILINE)
    assert re.search(r"sum +303.0 *$", shown, re.MULTILINE) and re.search(r"palm board +42$", shown, re.MULTILINE)


def test_targets_that_are_not_sent_are_called_so(hand, state):
    quiet = HandState(hand, state.measured, None, sent=False)
    assert "(not sent)" in picture(quiet) and "target" not in picture(quiet)
    assert "not sent" not in picture(state) and "  target  " in picture(state)


def test_without_a_terminal_the_same_is_one_line(state):
    words = hand_line(state)
    assert words["errors"] == "index_bend palm 0x0101, joint 0xffff; pinky_joint2 tip 0x8000"
    assert words["heat"] == "pinky_joint2 112, tip of the pinky 125, palm 42 degC"
    assert words["force"].startswith("thumb 60.0, index 60.3") and words["force"].endswith("sum 303.0 N")


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


@pytest.fixture
def asked(monkeypatch):
    """Run with somebody at the terminal; returns the exit code, None when refused, and the terminal."""

    def start(peer, folder, answer):
        terminal = Terminal(answer, peer)
        monkeypatch.setattr("sys.stdin", terminal)
        monkeypatch.setattr("sys.stderr", Terminal("", peer))
        options = [o for o in arguments(peer, folder, "--seconds", "0.2") if o != "--yes"]
        try:
            return run.main(options), terminal
        except HandError as error:
            assert "the motors stayed off" in str(error)
            return None, terminal

    return start


def test_the_motors_come_on_after_a_yes(tmp_path, asked):
    with FollowingHand() as peer:
        code, terminal = asked(peer, tmp_path, "y\n")
        assert (code, terminal.motors) == (0, False) and peer.on().any()


@pytest.mark.parametrize("answer", ["\n", "n\n", "", "yeah\n"])
def test_the_motors_stay_off_after_anything_else(tmp_path, asked, answer):
    with FollowingHand() as peer:
        code, terminal = asked(peer, tmp_path, answer)
        assert (code, terminal.motors) == (None, False)
        assert peer.commands and not peer.on().any()
    assert "not yes" in records(tmp_path, Kind.END)[0]["end"]


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
                consent.ask()
    finally:
        os.close(master)


@pytest.mark.parametrize("missing", ["stdin", "stderr"])
def test_a_script_must_say_yes(tmp_path, monkeypatch, capsys, missing):
    with FollowingHand() as peer:
        monkeypatch.setattr("sys.stdin" if missing == "stderr" else "sys.stderr", Terminal("y\n", peer))
        options = [o for o in arguments(peer, tmp_path) if o != "--yes"]
        with pytest.raises(HandError, match="give --yes .* or --motors-off"):
            run.main(options)
        assert not peer.commands


def test_the_refusal_is_one_line(tmp_path, capsys):
    with FollowingHand() as peer:
        options = [o for o in arguments(peer, tmp_path) if o != "--yes"]
        with pytest.raises(SystemExit) as stop:
            cli.run(lambda _: run.main(options))
    error = capsys.readouterr().err.strip().splitlines()
    assert stop.value.code == 2 and len(error) == 1 and error[0].startswith("error: nobody can be asked")


def test_a_closed_input_is_no_terminal(monkeypatch):
    monkeypatch.setattr("sys.stdin", None)
    with pytest.raises(HandError, match="--yes"):
        consent.check_terminal()
