"""`benchmarks/engines.py`, motions and policies, in a small form."""

import importlib
import json

import jax
import numpy as np
import pytest
from paths import ROOT

from dexsim.objects.config import ObjectConfig
from dexsim.registry import TASKS, TaskEntry
from dexsim.tasks.grasp.config import GraspConfig
from dexsim.tasks.grasp.task import Grasp


@pytest.fixture(scope="module")
def engines():
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(ROOT / "benchmarks"))
        yield importlib.import_module("engines")


@pytest.fixture(scope="module")
def bench(engines):
    config = GraspConfig(objects=ObjectConfig(shapes=("sphere", "box")))
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(TASKS, "grasp", TaskEntry(GraspConfig, Grasp, lambda: config))
        return engines.Motions("grasp", starts=1, seconds=0.18)


@pytest.fixture(scope="module")
def wanted(bench):
    return bench.reference()


@pytest.mark.slow
def test_an_engine_moves_as_c_mujoco_does(engines, bench, wanted):
    """With 20 evaluations of the line search boxes on the palm were off by 1 mm."""
    rows = bench.compare(bench.run("c"), wanted)
    assert {(row["motion"], row["shape"]) for row in rows} == {
        (m, s) for m in engines.MOTIONS for s in ("sphere", "box")
    }
    for row in rows:
        assert row["force_n"] > 0.1, row
        assert row["place_mm_max"] < 0.01 and row["turn_deg_max"] < 0.05 and row["force_error_n_max"] < 0.05, row


def test_the_reference_is_physics(bench, wanted):
    """A sphere that rolls keeps rolling; one that slides keeps its moment about the palm until it rolls."""
    speeds = np.diff(wanted.place[..., 1], axis=0) / bench.env.control_period
    np.testing.assert_allclose(speeds[:, bench.cases.index(("roll", "sphere"))], 0.2, rtol=0.02)
    row = bench.cases.index(("slide", "sphere"))
    object = jax.tree.map(lambda x: np.asarray(x)[row], bench.begin.object)
    radius, mass, inertia = object.size[1, 0], object.mass, object.inertia[2]
    assert speeds[-1, row] == pytest.approx(0.3 / (1 + inertia / (mass * radius**2)), rel=0.03)
    assert wanted.force[-1, row, -1, 0] == pytest.approx(9.81 * mass, rel=0.1)


def test_differences_are_found(bench, wanted, engines):
    """Of places in mm, of turns in degrees, of forces where something touches."""
    trace = engines.Trace
    upright, over = (np.broadcast_to(np.eye(4)[axis], wanted.quat.shape) for axis in (0, 3))
    shifted = trace(wanted.place + [0.003, 0, 0.004], upright, wanted.force + 0.5)
    turned = trace(wanted.place, over, wanted.force)
    (row, *_) = bench.compare(shifted, wanted)
    assert row["place_mm_max"] == pytest.approx(5.0) and row["force_error_n_p95"] == pytest.approx(0.5 * 3**0.5)
    (row, *_) = bench.compare(turned, shifted)
    assert row["turn_deg_max"] == pytest.approx(180.0)


def test_a_policy_is_measured_with_its_own_configuration(engines, monkeypatch):
    seen = []

    def evaluate(policy, *, env, episodes, chunk, baseline):
        seen.append((env.backend, env.config.physics.iterations, episodes, chunk))
        found = {"mean": 0.8, "low": 0.7, "high": 0.9}
        task = {"held": found, "r_resultant": found | {"r": 0.6}, "force_error_n": found}
        return {"task": task | {"seconds": env.config.evaluation_seconds, "non_finite": 0}}

    monkeypatch.setattr(engines, "evaluate_policy", evaluate)
    row = engines.policy_row("grasp", "c", episodes=5, seconds=0.3)
    assert seen == [("c", 0, 5, 5)]
    assert (
        row["seconds"] == 0.3
        and row["held"] == 0.8
        and row["r_resultant"] == 0.6
        and row["r_resultant_ci95"] == [0.7, 0.9]
    )


def test_tables_have_a_column_for_each_engine(engines, capsys, monkeypatch):
    def measure(policy, backend, episodes, seconds):
        row = {"policy": policy, "backend": backend, "r_resultant": None}
        return row | {"held": 0.5, "held_ci95": [0.25, 0.75]}

    monkeypatch.setattr(engines, "policy_row", measure)
    monkeypatch.setattr(engines.cli, "enable_caches", lambda: None)
    engines.main(["policies", "--policies", "grasp", "--backends", "c", "mjx"])
    *lines, title, _, held = [line for line in capsys.readouterr().out.splitlines() if line]
    assert [json.loads(line)["backend"] for line in lines] == ["c", "mjx"]
    assert title == "| policy | c | mjx |"
    assert held == "| grasp, held |" + " 0.5 (0.25–0.75) |" * 2
