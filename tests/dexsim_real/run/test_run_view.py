"""What is shown of a run, and the question before the motors come on."""

import contextlib
import io
import os
import re
import select
import time
from types import SimpleNamespace

import numpy as np
import pytest
from rich.console import Console

pytest.importorskip("serial")
from following_hand import FollowingHand, arguments, records

from dexsim_real.core.errors import HandError
from dexsim_real.core.log import Kind
from dexsim_real.run import __main__ as run
from dexsim_real.run import session, status
from dexsim_real.sensors.hand import HandSensing, HardwareConfig
from dexsim_real.wire.frames import empty_state

pytestmark = pytest.mark.usefixtures("jax_as_it_is")


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
    tables = status.hand_tables(hand, measured, targets, True)
    view = status.StatusView("a title", lambda: {f"row {number}": "x" * 80 for number in range(12)}, lambda: tables)
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
    assert "not sent" not in shown
    tables = status.hand_tables(hand, measured, None, False)
    view.show()
    assert "(not sent)" in view.console.file.getvalue()


def test_motors_off_means_off_and_the_view_says_what_is_read(tmp_path, capsys):
    with FollowingHand() as peer:
        options = [o for o in arguments(peer, tmp_path, "--seconds", "0.9", "--motors-off") if o != "--quiet"]
        assert run.main(options) == 0
        assert peer.commands and not peer.on().any()
    assert len(records(tmp_path, Kind.TICK)) >= 5
    shown = capsys.readouterr().err
    for text in ("firmware 1.3.9", "the policy starts", "exchange jitter", "end: time is over", "round trip"):
        assert text in shown, text


@pytest.mark.parametrize("gone", ["window", "pipe"])
def test_a_terminal_that_is_gone_ends_no_run(monkeypatch, gone):
    """An SSH connection that broke, a `tee` that Ctrl-C ended: with Rich alone the exchange thread would end."""
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setattr(status, "_LIVE", 0.02)
    far, near = os.openpty() if gone == "window" else os.pipe()
    screen = os.fdopen(near, "w", buffering=1)
    monkeypatch.setattr("sys.stderr", screen)
    view = status.StatusView("a title", lambda: {"age": "3.1 ms"}, lambda: "")
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
def test_the_motors_come_on_after_a_yes_and_after_nothing_else(tmp_path, monkeypatch, answer, moves):
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
                session.ask()
    finally:
        os.close(master)
