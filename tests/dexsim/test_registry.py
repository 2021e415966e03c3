"""Tasks by name: what `register` takes and refuses, and how a name is found."""

import dataclasses
import sys

import pytest

import dexsim
from dexsim import registry
from dexsim.env.config import EnvConfig
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
    assert task.config == dataclasses.replace(GraspConfig(), posture=hand.grasp_posture)
    assert registry.find_task("mine").config_class is GraspConfig


class Nameless(Grasp):
    """Has the name of the task that it is derived from."""

    def __init__(self, config: GraspConfig, hand: dexsim.Hand):
        super().__init__(config, hand)


def test_a_task_must_have_a_name_by_which_its_policies_find_it(hand):
    dexsim.register("nameless", Nameless)
    with pytest.raises(ConfigError, match="Nameless has the name 'grasp', by which another task is registered"):
        registry.make_task("nameless", hand)
    dexsim.register("other", Mine)
    with pytest.raises(ConfigError, match="Mine has the name 'mine', by which no task is registered; .*'other'"):
        registry.make_task("other", hand)
    dexsim.register("mine", Mine)
    assert registry.make_task("other", hand).name == "mine", "one task may have several names, as rotate has"


ODD = {
    "nothing of a task": (object(), "object: expected a subclass of dexsim.Task"),
    "one group": ({"fields": {"actor": ("command",)}}, "'mine': fields\\['critic'\\] is missing or empty"),
    "an unknown field": (
        {"fields": {"actor": ("command", "smell"), "critic": ("command",)}},
        "'mine': no observation field 'smell': choose from joint_position, ",
    ),
}


@pytest.mark.parametrize("what", ODD)
def test_what_a_task_lacks_is_named(hand, what):
    change, message = ODD[what]
    dexsim.register("mine", lambda config, hand: made, config=GraspConfig)
    made = change
    if isinstance(change, dict):
        made = Mine(GraspConfig(), hand)
        vars(made).update(change)
    with pytest.raises(ConfigError, match=message) as error:
        registry.make_task("mine", hand)
    assert "\n" not in str(error.value)


def test_a_factory_without_annotations_names_its_configuration(hand):
    default = dataclasses.replace(GraspConfig(), push_speed=0.1)
    with pytest.raises(ConfigError, match="annotate the factory's first parameter"):
        dexsim.register("mine", lambda config, hand: Mine(config, hand))
    dexsim.register("mine", lambda config, hand: Mine(config, hand), config=lambda: default)
    assert registry.make_task("mine", hand).config == dataclasses.replace(default, posture=hand.grasp_posture)


def test_the_same_task_may_be_registered_again_and_no_other(hand):
    dexsim.register("mine", Mine)
    dexsim.register("mine", Mine)
    with pytest.raises(ConfigError, match="'grasp'.*there is a task of that name"):
        dexsim.register("grasp", Mine)


@pytest.mark.parametrize("name", ["", "two words", "a:b", "a/b", None, 3])
def test_a_name_is_a_word(name):
    with pytest.raises(ConfigError, match="must be a word"):
        dexsim.register(name, Mine)


def test_a_configuration_is_an_env_config():
    with pytest.raises(ConfigError, match="is a dict, not an EnvConfig"):
        dexsim.register("mine", Mine, config=dict)
    with pytest.raises(ConfigError, match=r"config = GraspConfig.*: give its class or a function"):
        dexsim.register("mine", Mine, config=GraspConfig())
    assert issubclass(GraspConfig, EnvConfig)


def test_a_module_is_named_with_the_task(hand):
    assert registry.find_task("poke_task:poke").config().gain == 3.0
    assert registry.make_task("poke", hand).name == "poke"
    with pytest.raises(ConfigError, match="task module 'no_such_module': cannot be imported"):
        registry.find_task("no_such_module:poke")
    with pytest.raises(ConfigError, match="unknown task 'prod': choose from grasp, poke, rotate"):
        registry.find_task("poke_task:prod")
    with pytest.raises(ConfigError, match="rotate.*; poke_task neither registers it nor has a function of that name$"):
        registry.find_task("poke_task:__name__")  # A value that is no function.


def test_functions_of_one_name_in_two_modules_are_told_apart(tmp_path, monkeypatch):
    for name in ("first_place", "second_place"):
        (tmp_path / f"{name}.py").write_text(f"def make_env():\n    raise ValueError('{name}')\n")
    monkeypatch.syspath_prepend(tmp_path)
    for name in ("first_place", "second_place", "first_place"):
        with pytest.raises(ConfigError, match=f"making it fails: ValueError: {name}"):
            registry.make(f"{name}:make_env")
        assert registry.task_option("make_env") == f" --task {name}:make_env"


def test_what_the_users_module_or_function_raises_is_told_in_one_line(tmp_path, monkeypatch):
    (tmp_path / "poke_task.py").write_text("def poke():\n    raise RuntimeError('no\\nlicence')\n")
    (tmp_path / "half_task.py").write_text("def poke(:\n")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(ConfigError, match="--task poke_task:poke: making it fails: RuntimeError: no licence"):
        registry.make("poke_task:poke")
    (tmp_path / "script_task.py").write_text("import sys\nsys.exit(0)\n")
    with pytest.raises(ConfigError, match="task module 'script_task': importing it fails: SystemExit: 0"):
        registry.make("script_task:poke")
    with pytest.raises(ConfigError, match="task module 'half_task': importing it fails: SyntaxError"):
        registry.make("half_task:poke")


def test_an_installed_package_brings_tasks_by_its_entry_point(monkeypatch, hand):
    class Point:
        def load(self):
            dexsim.register("mine", Mine)

    asked = []
    monkeypatch.setattr(registry.importlib.metadata, "entry_points", lambda *, group: asked.append(group) or [Point()])
    assert registry.find_task("mine").task is Mine and asked == ["dexsim.tasks"]


def test_an_installed_package_that_fails_is_told_and_hides_no_other(monkeypatch):
    class Point:
        value = "their_tasks"

        def load(self):
            raise ImportError("no module\nnamed torch")

    class Other(Point):
        def load(self):
            dexsim.register("mine", Mine)

    monkeypatch.setattr(registry.importlib.metadata, "entry_points", lambda *, group: [Point(), Other()])
    assert registry.find_task("mine").task is Mine
    with pytest.raises(ConfigError, match="unknown task 'juggle'.*; their_tasks, .* fails: ImportError: no module"):
        registry.find_task("juggle")


def test_what_make_refuses():
    for name, options, message in (
        ("juggle", {}, "unknown task 'juggle': choose from grasp, rotate.*--task my_module:juggle"),
        ("rotate", {"config": GraspConfig()}, "takes a RotateConfig, not a GraspConfig"),
        ("grasp", {"seed": 1.5}, r"seed=1.5\): must be a whole number$"),
        ("os:getcwd", {}, "it makes a str, which has no reset and step"),
        ("os:grasp", {}, "os has no 'grasp'; dexsim's own task is grasp, without a module"),
        ("grasp", {"hand": "xhand"}, r"make\('grasp', hand='xhand'\): must be a Hand, such as dexsim.load_hand"),
    ):
        with pytest.raises(ConfigError, match=message):
            dexsim.make(name, options.pop("config", None), **options)
