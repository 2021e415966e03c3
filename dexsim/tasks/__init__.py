"""The tasks by name."""

import dataclasses
from collections.abc import Callable
from typing import Any

from dexsim.core.errors import ConfigError


@dataclasses.dataclass(frozen=True)
class TaskEntry:
    """Where a task's configuration and rules lie."""

    config_class: type
    task_class: type
    config: Callable[[], Any]
    """Makes the configuration that the name stands for."""


def _tasks() -> dict[str, TaskEntry]:
    from dexsim.tasks.grasp.config import GraspConfig
    from dexsim.tasks.grasp.task import Grasp
    from dexsim.tasks.rotate.config import RotateConfig, clear_of_palm, paper, without_orientation
    from dexsim.tasks.rotate.task import Rotate

    def rotation(config: Callable[[], Any]) -> TaskEntry:
        return TaskEntry(RotateConfig, Rotate, config)

    return {
        "grasp": TaskEntry(GraspConfig, Grasp, GraspConfig),
        "rotate": rotation(RotateConfig),
        "rotate_paper": rotation(paper),
        "rotate_without_orientation": rotation(without_orientation),
        "rotate_clear": rotation(clear_of_palm),
    }


TASKS = _tasks()


def make(
    task: str, config: Any = None, *, backend: str = "auto", num_envs: int = 1, hand: Any = None, seed: int = 0
) -> Any:
    """An environment.

    Args:
      task: a name in `TASKS`.
      config: the task's config dataclass; what the name stands for when None.
      backend: physics, "auto", "jax" or "warp".
      num_envs: batch size that Warp's contact buffer is sized for.
      hand: a `Hand` from `load_hand`; the shipped one when None.
      seed: of the pool of start states.

    Raises:
      ConfigError: unknown task, or a config of another task.
    """
    from dexsim.env.env import Env
    from dexsim.hand.load import load_hand

    if task not in TASKS:
        raise ConfigError(f"unknown task {task!r}: choose from {', '.join(sorted(TASKS))}")
    entry = TASKS[task]
    config = entry.config() if config is None else config
    if not isinstance(config, entry.config_class):
        raise ConfigError(f"task {task!r} takes a {entry.config_class.__name__}, not a {type(config).__name__}")
    hand = load_hand() if hand is None else hand
    return Env(entry.task_class(config, hand), hand, backend=backend, num_envs=num_envs, seed=seed)
