"""`benchmarks/throughput.py`: rows of engines in turn, over physics that compile in a second."""

import dataclasses
import importlib
import json

import pytest
from paths import ROOT
from simple_physics import SimplePhysics

from dexsim.objects.config import ObjectConfig
from dexsim.registry import TASKS, TaskEntry
from dexsim.tasks.grasp.config import GraspConfig
from dexsim.tasks.grasp.task import Grasp

WORLDS = 4


class Named(SimplePhysics):
    def __init__(self, hand, slots, largest, config, **options):
        super().__init__(hand, slots, largest, config, **options)
        self.backend = options["backend"]


@pytest.fixture
def throughput(monkeypatch):
    monkeypatch.syspath_prepend(str(ROOT / "benchmarks"))
    module = importlib.import_module("throughput")
    monkeypatch.setattr("dexsim.env.env.Physics", Named)
    config = GraspConfig(pool_size=16, objects=ObjectConfig(shapes=("sphere",)))
    monkeypatch.setitem(TASKS, "grasp", TaskEntry(GraspConfig, Grasp, lambda: config))
    preset = module.find_preset("cpu", "grasp")
    small = dataclasses.replace(preset, ppo=dataclasses.replace(preset.ppo, num_envs=WORLDS, rollout_length=4))
    monkeypatch.setattr(module, "find_preset", lambda device, task: small)
    monkeypatch.setattr(module.cli, "enable_caches", lambda: None)
    return module


@pytest.mark.slow
def test_a_row_for_each_engine_and_size(throughput, capsys, tmp_path):
    file = tmp_path / "rows.json"
    words = f"--backends c mjx --num-envs 4 8 --steps 4 --repeats 2 --json {file}"
    assert throughput.main(words.split()) == 0
    rows = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert [(row["backend"], row["num_envs"]) for row in rows] == [("c", 4), ("mjx", 4), ("c", 8), ("mjx", 8)]
    assert all(row["env_steps_per_s"] > 0 and row["measure"] == "environment" for row in rows)
    assert json.loads(file.read_text())["rows"] == rows


@pytest.mark.slow
def test_training_has_the_presets_size(throughput, capsys):
    throughput.main(["--train", "1", "--repeats", "2", "--backends", "c"])
    (row,) = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert (row["measure"], row["num_envs"], row["devices"], row["efficiency"]) == ("training", WORLDS, 1, 1.0)


def test_medians_and_efficiency(throughput, monkeypatch):
    """Two devices that take half as long again as one for twice the steps are 67 % efficient."""
    clock = iter([0.0, 9.0, 0.0, 9.0, 0.0, 2.0, 0.0, 3.0, 0.0, 2.0, 0.0, 3.0, 0.0, 4.0, 0.0, 7.0])
    monkeypatch.setattr(throughput.time, "perf_counter", lambda: next(clock))
    cases = [({"devices": 1}, lambda: 0, 100), ({"devices": 2}, lambda: 0, 200)]
    one, two = throughput.measure(cases, repeats=3)
    assert one == {"devices": 1, "env_steps_per_s": 50, "spread": 1.0, "efficiency": 1.0}
    assert two["env_steps_per_s"] == 67 and two["efficiency"] == 0.67
