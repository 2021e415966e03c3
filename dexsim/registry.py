"""Tasks by name: those of the library, those that installed packages bring, and the user's own; `dexsim tasks`.

dexsim.register("poke", Poke)        # Poke(config: PokeConfig, hand: Hand)
env = dexsim.make("poke")
"""

import dataclasses
import importlib
import importlib.metadata
import inspect
import typing
from collections.abc import Callable, Sequence
from typing import Any, cast

import jax

from dexsim.core import cli
from dexsim.core.assets import asset_path
from dexsim.core.config import NoSettings
from dexsim.env.config import EnvConfig
from dexsim.env.env import Env
from dexsim.env.task import Task, check_task
from dexsim.errors import ConfigError
from dexsim.hand.description import Hand
from dexsim.hand.load import DEFAULT, load_hand, shipped_hands
from dexsim.tasks.grasp import config as grasp
from dexsim.tasks.grasp.task import Grasp
from dexsim.tasks.rotate import config as rotate
from dexsim.tasks.rotate.task import Rotate


@dataclasses.dataclass(frozen=True)
class TaskEntry:
    """How a task is made."""

    task: Callable[[Any, Hand], Task]  # `task(config, hand)`: the rules; None with `environment`
    config: Callable[[], EnvConfig]  # makes the configuration that the name stands for
    environment: Callable[[], Any] | None = None  # makes one that is no task on a hand: no rules, no settings

    @property
    def config_class(self) -> type[EnvConfig]:
        """The class of its configuration."""
        return type(self.config())


TASKS: dict[str, TaskEntry] = {
    "grasp": TaskEntry(Grasp, grasp.GraspConfig),
    "grasp_paper": TaskEntry(Grasp, grasp.paper),
    "rotate": TaskEntry(Rotate, rotate.RotateConfig),
    "rotate_paper": TaskEntry(Rotate, rotate.paper),
    "rotate_without_orientation": TaskEntry(Rotate, rotate.without_orientation),
    "rotate_any": TaskEntry(Rotate, rotate.any_object),
    "rotate_clear": TaskEntry(Rotate, rotate.clear_of_palm),
}
OURS = tuple(TASKS)
_MODULES: dict[str, str] = {}  # that tasks were found in, by their names


def register(name: str, factory: Callable[[Any, Hand], Task]) -> None:
    """Add a task, so that `make`, training, evaluation and resuming find it by name.

    Commands find it too where `--task` names the module that registers it (`--task my_module:poke`), or where an
    installed package lists that module under the entry-point group `dexsim.tasks`.

    Args:
      name: a word; must be new, unless the same factory is registered again (a notebook cell that is run twice).
      factory: `factory(config, hand) -> Task`, usually the task's class. The type annotation of its first parameter
        is the task's configuration class, an `EnvConfig`.

    Raises:
      ConfigError: the name is taken or no word, or no configuration class can be found.
    """
    where = f"register({name!r}, ...)"
    if not name.isidentifier():
        raise ConfigError(f"{where}: the name must be a word, such as 'poke'")
    hints = typing.get_type_hints(factory.__init__ if inspect.isclass(factory) else factory)
    config = next(iter(hints.values()), None)
    if not (isinstance(config, type) and issubclass(config, EnvConfig)):
        raise ConfigError(f"{where}: annotate the factory's first parameter with its EnvConfig")
    taken = TASKS.get(name)
    if taken is not None and getattr(taken.task, "__qualname__", None) != getattr(factory, "__qualname__", ""):
        raise ConfigError(f"{where}: there is a task of that name already")
    TASKS[name] = TaskEntry(factory, config)


def find_task(name: str) -> TaskEntry:
    """The entry of a task by its name, or by `module:name` of the module that registers it, or that has a function of
    that name which makes an environment of another kind. Raises ConfigError: there is no such task or module, or the
    name is one of dexsim's own."""
    module, _, word = name.rpartition(":")
    if module:
        if word in OURS:
            raise ConfigError(f"task {name!r}: {word!r} is a task of dexsim; choose another name")
        try:
            makes = getattr(importlib.import_module(module), word, None)
        except ImportError as error:
            raise ConfigError(f"task module {module!r}: cannot be imported ({error})") from None
        # Many modules may have a `make_env`: the one that is named makes it.
        if callable(makes) and (word not in TASKS or TASKS[word].environment not in (None, makes)):
            TASKS[word] = TaskEntry(cast(Any, None), cast(Any, NoSettings), makes)
        if word in TASKS:
            _MODULES[word] = module
    if word not in TASKS:
        for plugin in importlib.metadata.entry_points(group="dexsim.tasks"):
            plugin.load()
    if word not in TASKS:
        lacks = f"{module} neither registers it nor has a function of that name"
        hint = lacks if module else f"a task of your own needs its module: --task my_module:{word}"
        raise ConfigError(f"unknown task {word!r}: choose from {', '.join(sorted(TASKS))}; {hint}")
    return TASKS[word]


def task_option(name: str) -> str:
    """ " --task my_module:name" of a task whose module was given to this program, else nothing."""
    return f" --task {_MODULES[name]}:{name}" if name in _MODULES else ""


def make(
    task: str, config: EnvConfig | None = None, *, backend: str = "auto", hand: Hand | None = None, seed: int = 0
) -> Env:
    """An environment. Compiled programs are kept between runs (`enable_caches`).

    Args:
      task: a name in `TASKS`, registered ones included.
      config: the task's config dataclass; None for what the name stands for.
      backend: physics, "auto", "c", "cuda" or "mjx".
      hand: a `Hand` from `load_hand`; None for the shipped one.
      seed: of the pool of start states.

    Raises:
      ConfigError: unknown task, or a config of another task.
    """
    if not jax.config.jax_compilation_cache_dir:  # type: ignore[attr-defined]
        cli.enable_caches()
    if (makes := find_task(task).environment) is not None:
        if not isinstance(config, NoSettings | None):
            raise ConfigError(f"task {task!r} takes no config: it is not a task on a hand")
        return makes()
    hand = load_hand() if hand is None else hand
    return Env(make_task(task, hand, config), hand, backend=backend, seed=seed)


def make_task(name: str, hand: Hand, config: EnvConfig | None = None) -> Task:
    """The rules of a task, without an environment round them; see `make`."""
    entry = find_task(name)
    config = entry.config() if config is None else config
    if not isinstance(config, entry.config_class):
        raise ConfigError(f"task {name!r} takes a {entry.config_class.__name__}, not a {type(config).__name__}")
    task = check_task(entry.task(config, hand))
    home = TASKS.get(task.name)
    if home is None or home.task not in (entry.task, type(task)):  # A policy's file has this name.
        raise ConfigError(f"task {name!r}: its class {type(task).__name__} has name = {task.name!r}; give it {name!r}")
    return task


def catalog() -> dict[str, list[str]]:
    """Names of tasks, hands and shipped policies."""
    policies = [path.stem for path in asset_path("policies").glob("*.msgpack")]
    return {"tasks": sorted(TASKS), "hands": sorted(shipped_hands()), "policies": sorted(policies)}


def main(argv: Sequence[str] | None = None) -> int:
    """The command `dexsim tasks`, which has no options. Returns its exit code."""
    for kind, names in catalog().items():
        print(f"{kind + ':':10}{', '.join(f'{name} (default)' if name == DEFAULT else name for name in names)}")
    return 0
