"""The training display at 80 columns, and as lines."""

import io

import pytest
from rich.console import Console

from dexsim_ppo.training import display

ROW = {
    "iteration": 1180,
    "env_steps": 4_833_280.0,
    "seconds": 271.3,
    "env_steps_per_s": 18412.0,
    "seconds_left": 208.7,
    "episode/return": 184.237,
    "episode/success": 0.981,
    "episode/length": 231.0,
    "reward": 0.812,
    "step/force_error": 0.741,
    "kl": 0.00812,
    "learning_rate": 0.0003,
    "action_std": 0.41,
    "skipped_updates": 2.0,
    "updates": 2360.0,
}


@pytest.fixture
def shown(monkeypatch):
    """A function that shows rows and returns what a reader sees at the end, lines of 80 columns."""

    def run(rows, terminal=True):
        out = io.StringIO()
        screen = Console(file=out, width=80, force_terminal=terminal, color_system=None, legacy_windows=False)
        monkeypatch.setattr(display, "Console", lambda: screen)
        with display.Display("grasp on cpu, c") as view:
            view.working("compiling the training step")
            for row in rows:
                view.show(row)
        if terminal:
            reader = Console(file=io.StringIO(), width=80, color_system=None)
            reader.print(view._live.renderable)
            return reader.file.getvalue().splitlines(), out.getvalue()
        return out.getvalue().splitlines(), out.getvalue()

    return run


def test_at_80_columns_nothing_is_cut_or_folded(shown):
    lines, _ = shown([ROW])
    assert max(map(len, lines)) <= 80 and "…" not in "".join(lines)
    text = " ".join(" ".join(lines).split())
    for entry in (
        "iteration 1180",
        "steps 4.83M",
        "steps/s 18.4k",
        "57%, elapsed 4:31, left 3:29",
        "return 184.24",
        "success 98.1%",
        "force error 0.741",
        "KL 0.0081",
        "lr 3.0e-04",
        "skipped updates 2 of 2360",
    ):
        assert entry in text, entry
    assert len(lines) <= 12


def test_without_a_budget_there_is_no_bar(shown):
    lines, _ = shown([ROW | {"seconds_left": float("inf")}])
    assert "elapsed 4:31" in lines[1] and not any("━" in line or "left" in line for line in lines)


def test_all_but_the_first_process_are_quiet(capsys):
    with display.Display("grasp on cpu, c", quiet=True) as view:
        view.working("compiling")
        view.show(ROW)
        view.note("a line")
    assert capsys.readouterr() == ("", "")
