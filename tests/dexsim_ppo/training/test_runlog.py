"""The learning curve says what it shows, in words and units."""

import matplotlib.pyplot as plt
import pytest

from dexsim_ppo.training import runlog


@pytest.fixture
def figure(tmp_path, monkeypatch):
    """The figure of rows of metrics."""
    drawn = []
    monkeypatch.setattr(plt, "close", drawn.append)

    def draw(rows):
        runlog.draw_curve(rows, tmp_path / "curve.png", "grasp")
        return drawn[-1] if drawn else None

    return draw


def row(iteration, **more):
    steps = 500_000 * iteration
    return {"iteration": iteration, "env_steps": steps, "seconds": 60.0 * iteration, "episode/return": iteration} | more


def test_axes_have_words_and_units(figure):
    rows = [row(i, **{"step/force_error": 1.0, "episode/success": 0.5, "step/own_error": 2.0}) for i in (1, 2, 3)]
    axes = figure(rows).axes
    words = [" ".join(axis.get_ylabel().split()) for axis in axes]
    assert words == ["return of an episode", "success [share of episodes]", "force error [N]"]
    assert axes[-1].get_xlabel() == "environment steps [million]"
    assert not any("/" in word or "_" in word for word in words)
    assert list(axes[0].lines[0].get_xdata()) == [0.5, 1.0, 1.5]


def test_evaluations_are_marked_and_unknown_errors_are_named(figure):
    axes = figure([row(1, **{"step/own_error": 2.0}), row(2, **{"evaluation/return": 7.0})]).axes
    assert axes[1].get_ylabel() == "own error\nof a tick"
    (mark,) = [line for line in axes[0].lines if line.get_label() == "evaluation"]
    assert list(mark.get_ydata()) == [7.0]


def test_nothing_to_show_draws_nothing(figure):
    assert figure([{"iteration": 1, "env_steps": 1}]) is None
