"""The grasp report on synthetic evaluations: arrays [T, N] whose answers are known beforehand."""

import functools

import numpy as np
import pytest
from scipy import stats

from dexsim.core import statistics
from dexsim.tasks.grasp import report

PERIOD = 0.1  # s
SPAN = (1.0, 5.0)  # N at command 0 and 1
COMMANDS = (0.0, 0.25, 0.5, 0.75, 1.0)


def evaluation(ticks=60, repeats=8, noise=0.0, slope=4.0, lost=(), settle_force=99.0, seed=0):
    """Metrics and `alive` of 5 commands x 5 shapes x `repeats` episodes of 60 ticks (6 s).

    A touching finger presses with 1 + slope * command N from tick 30 (3 s) on, and with
    `settle_force` before. Episodes in `lost` end at tick 20.
    """
    rng = np.random.default_rng(seed)
    command, shape, _ = (a.ravel() for a in np.meshgrid(COMMANDS, np.arange(5), np.arange(repeats), indexing="ij"))
    count = command.size
    force = np.where(np.arange(ticks)[:, None] < 30, settle_force, 1.0 + slope * command)
    force = force + noise * rng.normal(size=count)
    alive = np.ones((ticks, count), bool)
    alive[20:, list(lost)] = False
    flat = np.ones((ticks, count))
    metrics = {
        "command": flat * command,
        "shape": flat * shape,
        "finger_force": force,
        "finger_normal": force**2,
        "finger_taxels": np.sqrt(np.abs(force)),
        "torque_limited": flat * (command == 1.0),
        "total_force": 3 * force,
        "total_torque": 0.2 * force,
        "touching": flat * 3,
        "return": flat * 7.0,
        "joint_speed": np.where(alive, 0.1, 0.0),
        "non_finite": flat * 0,
    }
    return metrics, alive


class TestStatistics:
    def test_pearson(self):
        rng = np.random.default_rng(1)
        x = rng.normal(size=200)
        y = 0.6 * x + rng.normal(size=200)
        found = report.pearson(x, y, samples=2000)
        assert found["r"] == pytest.approx(stats.pearsonr(x, y).statistic, abs=1e-12)
        interval = stats.pearsonr(x, y).confidence_interval(0.95)  # Fisher's: another method
        assert (found["low"], found["high"]) == pytest.approx(tuple(interval), abs=0.03)

    @pytest.mark.parametrize("x, y", [([1, 1, 1, 1], [1, 2, 3, 4]), ([1, 2, 3], [5, 5, 5]), ([1, 2], [1, 2]), ([], [])])
    def test_pearson_undefined(self, x, y):
        assert report.pearson(np.array(x, float), np.array(y, float)) == {"r": None, "low": None, "high": None}


class TestSummary:
    @pytest.fixture(autouse=True)
    def few_draws(self, monkeypatch):
        """The intervals are tested above; here they only cost time."""
        few = functools.partial(statistics.interval, samples=10)
        for module in (statistics, report):
            monkeypatch.setattr(module, "interval", lambda function, count, name="mean", *_: few(function, count, name))

    def test_only_what_is_held_and_settled_counts(self):
        """Every 4th episode is lost at 2 s; the force of the others is 99 N before 3 s."""
        metrics, alive = evaluation(lost=range(0, 200, 4))
        for name in ("finger_force", "total_force"):
            metrics[name][:, ::4] = 1e6
        found = report.summarize(metrics, alive, PERIOD, SPAN)
        assert found["episodes"] == 200 and found["seconds"] == pytest.approx(6.0) and found["non_finite"] == 0
        assert found["held"]["mean"] == 0.75
        assert found["joint_speed_rad_s"]["mean"] == pytest.approx(0.1), "of the ticks that an episode lived"
        assert found["r_resultant"]["r"] > 0.9999
        # Root mean square; nothing presses where the object is lost, as if all of 1 to 5 N were missing.
        assert found["force_error_n"]["mean"] == pytest.approx(np.sqrt(0.25 * 11), rel=1e-4)
        for target, row in enumerate(found["by_command"], start=1):
            assert row["finger_force_n"]["mean"] == pytest.approx(target)
            assert row["total_force_n"]["mean"] == pytest.approx(3 * target)
            assert row["target_force_n"] == pytest.approx(target)
            assert row["touching_fingers"]["mean"] == pytest.approx(3.0)
        assert [row["saturates"] for row in found["by_command"]] == [False] * 4 + [True]
        assert found["slope_force_n"]["mean"] == pytest.approx(4.0)
        assert found["slope_torque"]["mean"] == pytest.approx(0.8)
        for row in found["by_shape"] + found["by_command"]:
            assert row["episodes"] == 40 and row["held"]["mean"] == 0.75

    def test_three_forces_under_three_names(self):
        """The whole contact force, its normal part and what taxels bear of that, over one window."""
        metrics, alive = evaluation(noise=0.3)
        rng = np.random.default_rng(7)
        worst = metrics["shape"][0] == 2
        metrics["finger_taxels"][:, worst] = rng.uniform(1, 5, worst.sum())
        found = report.summarize(metrics, alive, PERIOD, SPAN)
        assert found["window_s"] == pytest.approx([3.0, 6.0])
        late = {name: metrics[name][30:].mean(0) for name in ("finger_force", "finger_normal", "finger_taxels")}
        for name, metric in (("resultant", "force"), ("normal", "normal"), ("taxels", "taxels")):
            known = stats.pearsonr(metrics["command"][0], late[f"finger_{metric}"]).statistic
            assert found[f"r_{name}"]["r"] == pytest.approx(known), name
        assert found["by_command"][2]["finger_normal_n"]["mean"] == pytest.approx(late["finger_normal"][80:120].mean())
        headline = found["headline"]
        assert headline["r, force on the taxels"]["value"] == found["r_taxels"]["r"]
        assert headline["r, force on the taxels, worst shape"] == found["by_shape"][2]["r_taxels"]["r"] < 0.5
