"""Tasks by name: what `register` takes and refuses, and how a name is found."""

import dataclasses
import sys

import pytest

import dexsim
from dexsim import registry
from dexsim.errors import ConfigError
from dexsim.tasks.grasp.config import GraspConfig
from dexsim.tasks.grasp.task import Grasp


@pytest.fixture(autouse=True)
def same_tasks_afterwards(monkeypatch):
    monkeypatch.setattr(registry, "TASKS", dict(registry.TASKS))
    monkeypatch.setattr(registry, "_MODULES", dict(registry._MODULES))
    monkeypatch.delitem(sys.modules, "poke_task", raising=False)


class Mine(Grasp):
    """Grasp under another name."""

    name = "mine"

    def __init__(self, config: GraspConfig, hand: dexsim.Hand):
        super().__init__(config, hand)


def test_a_registered_task_is_made_by_name_with_its_annotated_configuration(hand):
    dexsim.register("mine", Mine)
    task = registry.make_task("mine", hand)
    assert isinstance(task, Mine)
    assert task.config == dataclasses.replace(GraspConfig(), posture=hand.grasp_posture, finger_force=(1.2, 4.8))
    assert registry.find_task("mine").config_class is GraspConfig


ODD = [
    ({"actor": ("command",)}, "'mine': fields\\['critic'\\] is missing or empty"),
    ({"actor": ("command", "smell"), "critic": ("command",)}, "'mine': no observation field 'smell': choose from"),
]


@pytest.mark.parametrize(("fields", "message"), ODD)
def test_what_a_task_lacks_is_named(hand, monkeypatch, fields, message):
    monkeypatch.setattr(Mine, "fields", fields)
    dexsim.register("mine", Mine)
    with pytest.raises(ConfigError, match=message):
        registry.make_task("mine", hand)


def test_a_module_is_named_with_the_task(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "poke_task.py").write_text("import dexsim, test_registry\ndexsim.register('poke', test_registry.Mine)")
    assert registry.find_task("poke_task:poke").task.__name__ == "Mine"
    with pytest.raises(ConfigError, match="task module 'no_such_module': cannot be imported"):
        registry.find_task("no_such_module:poke")
    with pytest.raises(ConfigError, match="unknown task 'prod': choose from grasp, grasp_paper, poke, rotate"):
        registry.find_task("poke_task:prod")
    with pytest.raises(ConfigError, match="rotate.*; poke_task neither registers it nor has a function of that name$"):
        registry.find_task("poke_task:__name__")  # A value that is no function.


def test_an_installed_package_brings_tasks_by_its_entry_point(monkeypatch, hand):
    class Point:
        def load(self):
            dexsim.register("mine", Mine)

    asked = []
    monkeypatch.setattr(registry.importlib.metadata, "entry_points", lambda *, group: asked.append(group) or [Point()])
    assert registry.find_task("mine").task is Mine and asked == ["dexsim.tasks"]
