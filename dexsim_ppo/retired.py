"""Fields of older versions, so that their policies, checkpoints and logs still load.

A field that was renamed is moved to its new name; one that is gone is dropped. Either way the user gets one
warning line per file. A dropped field names its old value, since an environment made from the file may differ.
"""

import copy
import dataclasses
import math
import warnings
from typing import Any

from dexsim import observation
from dexsim.control import Control
from dexsim.core.config import from_dict
from dexsim.core.errors import CheckpointError, OldFileWarning
from dexsim.task_spec import TaskSpec, TurnSpec

FIELDS: dict[str, str | None] = {
    "leash": "drop_radius",
    "objects.bare_friction": "objects.link_friction",
    "objects.corners": "objects.extremes",
    "randomization.corners": "randomization.extremes",
    "skin.bare": "skin.untaxelled",
}
"""Fields of a task's configuration: path to new path, or None for one that is gone."""

ARGUMENTS: dict[str, str | None] = {"corners": "extremes"}
"""Options of a training run, likewise; those under `env` are in `FIELDS`."""

LEAVES: dict[str, str | None] = {}
"""Prefixes of the paths of a checkpoint's arrays, likewise."""


def migrate_config(config: dict[str, Any], where: Any) -> dict[str, Any]:
    """A task's configuration from the file `where`, under today's names."""
    return _migrate(config, FIELDS, where)


def migrate_arguments(arguments: dict[str, Any], where: Any) -> dict[str, Any]:
    """The options of a training run, `env` included."""
    fields = ARGUMENTS | {f"env.{old}": new and f"env.{new}" for old, new in FIELDS.items()}
    return _migrate(arguments, fields, where)


def migrate_leaves(leaves: dict[str, Any]) -> dict[str, Any]:
    """A checkpoint's arrays by path, under today's paths."""
    moved = {}
    for path, leaf in leaves.items():
        old = next((old for old in LEAVES if path.startswith(old)), None)
        if old is None:
            moved[path] = leaf
        elif (new := LEAVES[old]) is not None:
            moved[new + path.removeprefix(old)] = leaf
    return moved


def old_spec(task: str, config: dict[str, Any]) -> TaskSpec:
    """The task's specification for a file from before files carried one.

    Raises:
      CheckpointError: of a task that did not exist then.
    """
    if task not in ("grasp", "rotate"):
        raise CheckpointError(f"a policy of the task {task!r} without a task specification: train it with this version")
    sensing = config.get("sensing", {})
    common = {
        "name": task,
        "posture": tuple(config["posture"]),
        "control": from_dict(Control, {k: v for k, v in config["control"].items() if k in _fields(Control)}),
        "observation": from_dict(observation.ObservationConfig, config["observation"]),
        "object_axes": tuple(sensing.get("object_axes", (True, False, False))),
        "velocity_filter": sensing.get("velocity_filter", 0.5),
    }
    if task == "grasp":
        return TaskSpec(fields=observation.GRASP, gravity=(9.81, 0.0, 0.0), reference=(0.055, -0.005, 0.090), **common)
    tilt, roll = config["tilt"], config["roll"]
    level = 9.81 * math.cos(roll)
    turn = TurnSpec(
        axis=tuple(config["axis"]),
        step=config["direction"] * config["goal_step"],
        angle=config["goal_angle"],
        distance=config["goal_distance"],
        spin=config["goal_spin"],
    )
    return TaskSpec(
        fields=observation.ROTATE,
        gravity=(-level * math.cos(tilt), 9.81 * math.sin(roll), -level * math.sin(tilt)),
        reference=tuple(config["reference"]),
        turn=turn,
        **common,
    )


def _fields(cls: type) -> set[str]:
    return {field.name for field in dataclasses.fields(cls)}


def _migrate(config: dict[str, Any], fields: dict[str, str | None], where: Any) -> dict[str, Any]:
    config, changes = copy.deepcopy(config), []
    for old, new in fields.items():
        *groups, name = old.split(".")
        group = _group(config, groups)
        if group is None or name not in group:
            continue
        value = group.pop(name)
        if new is None:
            changes.append(f"{old} = {value!r} dropped")
        else:
            *groups, name = new.split(".")
            target = _group(config, groups)
            (config if target is None else target).setdefault(name, value)
            changes.append(f"{old} is now {new}")
    if changes:
        warnings.warn(f"{where}: from an older version of dexsim: {', '.join(changes)}", OldFileWarning, stacklevel=4)
    return config


def _group(config: Any, names: list[str]) -> dict[str, Any] | None:
    for name in names:
        config = config.get(name) if isinstance(config, dict) else None
    return config if isinstance(config, dict) else None
