"""Where metrics go, and that the learning curve says what it shows, in words and units."""

import importlib.util
import sys
import types

import matplotlib.pyplot as plt
import pytest
from tiny_env import SMALL, TinyConfig

from dexsim.core.errors import ConfigError
from dexsim_ppo.training import runlog
from dexsim_ppo.training.arguments import TrainArguments


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


def test_metrics_go_to_weights_and_biases(tmp_path, monkeypatch):
    said = []
    run = types.SimpleNamespace(log=lambda row, step: said.append((row, step)), finish=lambda: said.append("finished"))
    fake = types.SimpleNamespace(init=lambda **given: (said.append(given), run)[1])
    monkeypatch.setitem(sys.modules, "wandb", fake)
    arguments = TrainArguments(env=TinyConfig(), ppo=SMALL, wandb="hands", seed=3)
    log = runlog.MetricsLog(runlog.RunFolder(tmp_path), 0, arguments)
    log.write({"iteration": 1, "env_steps": 500, "reward": 0.5, "kl": float("nan")})
    log.close()
    begun, *logged = said
    assert begun["project"] == "hands" and begun["config"]["seed"] == 3 and begun["dir"] == tmp_path
    assert logged == [({"reward": 0.5}, 500), "finished"]


def test_weights_and_biases_are_asked_for_before_training_begins(monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    runlog.check_wandb("")
    with pytest.raises(ConfigError, match="--wandb hands: install the extra"):
        runlog.check_wandb("hands")
