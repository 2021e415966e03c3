"""What a task has, and what its rules give, checked before and while they are traced: a task may be anybody's."""

from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp

from dexsim.core.errors import ConfigError
from dexsim.env.task import GroundTruth, Task
from dexsim.observation import FIELDS


def check_members(task: Any) -> None:
    """Whether an object is a `Task`, and observes what there is.

    Raises:
      ConfigError: it lacks something, or a field that it observes does not exist.
    """
    members = (*Task.__annotations__, *(name for name in vars(Task) if not name.startswith("_")))
    if missing := [name for name in members if not hasattr(task, name)]:
        raise ConfigError(f"a task {type(task).__name__} has no {', '.join(missing)}; `dexsim.Task` says what they are")
    for group in ("actor", "critic"):
        names = task.fields.get(group) if isinstance(task.fields, Mapping) else None
        if not isinstance(names, tuple | list) or not names:
            raise _error(task, f"fields has no {group!r} with the names of what it observes")
        if unknown := [name for name in names if name not in FIELDS]:
            raise _error(task, f"fields: no field {unknown[0]!r:.80} to observe; choose from {', '.join(FIELDS)}")


def reward_of(task: Task, goal: Any, truth: GroundTruth, dropped: jax.Array) -> tuple[jax.Array, dict[str, jax.Array]]:
    """The reward [] of a tick as a float, whichever kind of number the task gives, and its metrics.

    Raises:
      ConfigError: something else than a number, or metrics that are none.
    """
    found: Any = task.reward(goal, truth, dropped)
    if not (isinstance(found, tuple) and len(found) == 2 and isinstance(found[1], dict)):
        raise _error(task, f"reward gives {type(found).__name__} where the reward and a dict of metrics are wanted")
    reward, metrics = found
    for what, value in (("reward", reward), *((f"reward: metric {name!r}", value) for name, value in metrics.items())):
        _check_scalar(task, what, value)
    # The state begins with a float, and a compiled loop carries it.
    return jnp.asarray(reward, jnp.result_type(float)), metrics


def dropped_of(task: Task, goal: Any, truth: GroundTruth) -> jax.Array:
    """Whether the task says that the episode has failed: bool [].

    Raises:
      ConfigError: it says something else.
    """
    found: Any = task.dropped(goal, truth)
    _check_scalar(task, "dropped", found)
    if jnp.result_type(found) != jnp.bool_:
        raise _error(task, f"dropped is {jnp.result_type(found)}, not bool")
    return jnp.asarray(found)


def updated_goal(task: Task, key: jax.Array, goal: Any, truth: GroundTruth) -> Any:
    """The goal after a tick.

    Raises:
      ConfigError: it is of another structure, shape or type than before.
    """
    new = task.update(key, goal, truth)
    flattened: Any = tuple(jax.tree_util.tree_flatten_with_path(tree) for tree in (goal, new))
    (before, old_structure), (after, structure) = flattened
    if structure != old_structure:
        raise _error(task, "update gives a goal of another structure than before")
    for (path, old), (_, leaf) in zip(before, after, strict=True):
        if _kind(old) != _kind(leaf):
            where = jax.tree_util.keystr(path)
            raise _error(task, f"update makes goal{where} {_kind(leaf)}, which was {_kind(old)}")
    return new


def _kind(leaf: Any) -> str:
    return f"{leaf.dtype if hasattr(leaf, 'dtype') else jnp.result_type(leaf)}{list(jnp.shape(leaf))}"


def _check_scalar(task: Task, what: str, value: Any) -> None:
    if not (hasattr(value, "dtype") or isinstance(value, bool | int | float)):
        raise _error(task, f"{what} is a {type(value).__name__}, not a number")
    if jnp.shape(value) != ():
        raise _error(task, f"{what} has the shape {jnp.shape(value)}, not ()")


def _error(task: Task, text: str) -> ConfigError:
    return ConfigError(f"task {task.name!r}: {text}")
