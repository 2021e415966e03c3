"""How many episodes are measured and which, and what is made of the totals of long ones."""

import dataclasses
from collections import namedtuple
from types import SimpleNamespace

import numpy as np
import pytest
from tiny_env import TinyEnv

from dexsim_ppo.evaluate import Evaluator, mean_interval, summarize


class Totals(TinyEnv):
    """Is asked for the metrics of last ticks only."""

    evaluation = "totals"

    def summarize(self, metrics, alive):
        return {"lived": alive.tolist()}


@pytest.fixture(scope="module")
def evaluator():
    return Evaluator(TinyEnv(), 4)


def test_whole_chunks_are_measured_and_the_seed_chooses_the_episodes(policy, evaluator):
    env = evaluator.env
    reports = [evaluator(policy.params, episodes=n, seed=seed, idle=True)[0] for n, seed in ((5, 1), (8, 1), (5, 2))]
    assert [report["episodes"] for report in reports] == [8, 8, 8] and [r["seed"] for r in reports] == [1, 1, 2]
    for report, seed in zip(reports, (1, 1, 2), strict=True):  # Standing still earns 32 (1 - distance).
        start = env.evaluation_starts(env.evaluation_plan(8, seed))
        returns = 32 * (1 - np.abs(np.asarray(start.x - start.target)))
        assert report["return"]["value"] == pytest.approx(returns.mean(), rel=1e-4)
        assert report["seconds"] > 0


def test_totals_are_those_of_the_series(policy, evaluator):
    """The same episodes, their last ticks kept on the way."""
    series, totals = (of(policy.params, episodes=8, seed=3)[0] for of in (evaluator, Evaluator(Totals(), 4)))
    for name in ("return", "held", "steps_held", "starts", "episodes", "steps"):
        assert totals[name] == pytest.approx(series[name], rel=1e-5), name
    assert totals["task"] == {"lived": [32] * 8}


Commanded = namedtuple("Commanded", "command")


class Commands(TinyEnv):
    """The target is what is commanded; every episode ends at step 7."""

    def snapshot(self, state):
        return Commanded(state.target)

    def step(self, state, action):
        state = super().step(state, action)
        return dataclasses.replace(state, terminated=state.metrics["length"] == 7)


def test_a_film_shows_the_lowest_and_the_highest_command_to_half_a_second_after_the_end(policy):
    """And at most a minute of each."""
    env = Commands()
    _, film = Evaluator(env, 8)(policy.params, episodes=8, seed=0)
    starts = np.asarray(env.evaluation_starts(env.evaluation_plan(8, 0)).target).reshape(8)
    shown = np.asarray(film.command).reshape(2, 6 + 5)
    np.testing.assert_allclose(shown[:, 0], [starts.min(), starts.max()], rtol=1e-6)
    env.control_period = 0.5
    assert Evaluator(env, 2)._film(np.zeros((130, 2)), np.zeros((130, 2), bool)).shape == (2 * 120,)


def test_intervals_are_by_start():
    """Copies of an episode add nothing: four starts sixteen times each are four samples."""
    entry = mean_interval(np.array([1.0, 2, 3, 4]), np.arange(4))
    assert entry["value"] == 2.5 and 1 < entry["low"] < 2 and 3 < entry["high"] < 4
    values, start = np.tile([1.0, 2, 3, 4], 16), np.tile(np.arange(4), 16)
    assert mean_interval(values, start) == pytest.approx(entry)
    uneven = mean_interval(np.array([0.0, 0.0, 0.0, 1.0]), np.array([7, 7, 7, 9]))
    assert uneven == {"value": 0.25, "low": 0.0, "high": 1.0}  # either start may be drawn twice
    terminated = np.tile(np.array([True, False, False, False]), 16)[None]
    report = summarize(TinyEnv(), {"return": values[None], "error": values[None]}, terminated, start)
    assert report["starts"] == 4 and report["held"]["value"] == 0.75
    assert report["held"]["low"] < 0.3 and report["held"]["high"] == 1.0
    held = np.array([False] * 8 + [True] * 2)
    report = summarize(TinyEnv(), {"return": held[None], "error": held[None]}, held[None], np.arange(10))
    assert (report["held"]["low"], report["held"]["high"]) == pytest.approx((0.4902, 0.9433), abs=2e-4)  # Wilson


def test_episodes_end_at_their_first_termination():
    """A step that diverges is counted although it ends the episode."""
    # Episode 0 terminates at step 1 (with a reward of 10 counted in), and "lives" again later.
    terminated = np.array([[0, 0], [1, 0], [0, 0]], bool)
    metrics = {
        "return": np.array([[1.0, 1], [11, 2], [99, 3]]),
        "error": np.array([[1.0, 1], [np.nan, 1], [np.nan, 4]]),
        "non_finite": np.array([[0.0, 0], [1, 0], [1, 0]]),
    }
    sums = lambda masked, alive: {name: masked[name].sum() for name in ("error", "non_finite")}  # noqa: E731
    report = summarize(SimpleNamespace(evaluation="series", summarize=sums), metrics, terminated, np.arange(2))
    assert report["held"]["value"] == 0.5
    assert report["return"]["value"] == pytest.approx((11 + 3) / 2)
    assert report["steps_held"]["value"] == pytest.approx((1 + 3) / 2)
    assert report["task"] == {"error": 1 + 1 + 1 + 4, "non_finite": 1}
