"""Progress: a bar on a terminal, lines where there is none."""

import io
import itertools

import pytest
from rich import console

from dexsim.core import progress


@pytest.fixture
def screen(monkeypatch):
    """What is written, on a terminal of 80 columns or not."""
    out, terminal = io.StringIO(), []

    class Screen(console.Console):
        def __init__(self, **_):
            super().__init__(file=out, width=80, force_terminal=bool(terminal))

    monkeypatch.setattr(console, "Console", Screen)
    monkeypatch.setenv("TERM", "xterm")
    return out, terminal


def test_a_bar_on_a_terminal_counts_and_goes(screen):
    out, terminal = screen
    terminal.append(True)
    with progress.progress("grasp", 128, "episodes") as show:
        show(64)
    assert "grasp" in out.getvalue()
    assert out.getvalue().rstrip().endswith("\x1b[2K"), "the bar is removed at the end"


def test_a_line_now_and_then_elsewhere(screen, monkeypatch):
    out, _ = screen
    clock = itertools.count(0, 12.0)
    monkeypatch.setattr(progress.time, "monotonic", lambda: next(clock))
    with progress.progress("grasp", 5, "episodes") as show:
        for done in range(1, 6):
            show(done)
    assert out.getvalue().splitlines() == [f"grasp: {done} of 5 episodes, {12 * done} s" for done in range(1, 5)]
