"""`benchmarks/zero_shot.py`: its metrics and what it writes."""

import importlib

import numpy as np
import pytest
from paths import ROOT


@pytest.fixture
def zero_shot(monkeypatch):
    # The flags that other tests compile with stay as they are.
    monkeypatch.setattr("dexsim_real.control.controller.prepare_jax", lambda: None)
    monkeypatch.syspath_prepend(str(ROOT / "benchmarks"))
    return importlib.import_module("zero_shot")


def test_metrics_of_rotations(zero_shot):
    keys = ("successes", "paper_successes", "seconds_to_fall", "fell", "joint_speed")
    rows = ((0, 1, 3.0, True, 0.5), (10, 11, 60.0, True, 0.5), (50, 51, 120.0, False, 0.5))
    metrics = zero_shot.rotate_metrics([dict(zip(keys, row, strict=True)) for row in rows])
    assert metrics["successes"]["mean"] == 20.0 and metrics["successes"]["median"] == 10.0
    assert metrics["seconds_to_fall"]["mean"] == 61.0
    assert metrics["successes_per_minute"]["mean"] == pytest.approx(60 / (183 / 60))  # stuck or not
    assert metrics["kept_to_the_end"]["mean"] == pytest.approx(1 / 3)
    text = zero_shot.table(metrics, zero_shot.simulated("rotate", "rotate"), {"successes": {"mean": 0.25}})
    assert len(text.splitlines()) == 7 and text.splitlines()[1].endswith("0.25")


def test_metrics_of_grasps_count_only_what_was_held(zero_shot):
    def report(c, shape, held):
        forces = {"force": 2 + 5 * c, "normal": (1 + c) ** 2, "taxels": 1 - c}
        report = {f"finger_{name}": value for name, value in forces.items()}
        report |= {"total_force": 9 + c, "total_torque": 0.5 + c, "torque_limited": 0.6 * (c == 1)}
        time = {"seconds": 8.0 if held else 5.5, "window_s": [3.0, 8.0]}
        return report | time | {"held": held, "command": c, "shape": shape}

    reports = [report(c, shape, held) for c in (0.0, 0.5, 1.0) for shape, held in (("box", True), ("sphere", c < 1))]
    metrics = zero_shot.grasp_metrics(reports, (2.0, 7.0))
    assert metrics["held"]["mean"] == pytest.approx(5 / 6)
    assert metrics["r_resultant"]["r"] == pytest.approx(1.0) and metrics["r_taxels"]["r"] == pytest.approx(-1.0)
    command = np.array([0.0, 0.0, 0.5, 0.5, 1.0])
    assert metrics["r_normal"]["r"] == pytest.approx(np.corrcoef(command, (1 + command) ** 2)[0, 1])
    assert [row["held"]["mean"] for row in metrics["by_command"]] == [1.0, 1.0, 0.5]
    assert [row["torque_limited"]["mean"] for row in metrics["by_command"]] == [0.0, 0.0, 0.6]
    # The lost object was pressed as wanted, 7 N, for half of the window.
    assert metrics["force_error_n"]["mean"] == pytest.approx(3.5 / np.sqrt(6))
    assert zero_shot.table(metrics, zero_shot.simulated("grasp", "grasp"), {}).count("command 1 (saturates)") == 3
