"""Fields of older versions, so that their policies, checkpoints and logs still load.

A field that was renamed is moved to its new name; one that is gone is dropped. Either way the user gets one
warning line per file. A dropped field names its old value, since an environment made from the file may differ.
"""

import copy
import dataclasses
import math
import warnings
from collections.abc import Collection
from typing import Any

import jax

from dexsim import observation
from dexsim.control import Control
from dexsim.core.config import from_dict
from dexsim.core.errors import CheckpointError, OldFileWarning
from dexsim.task_spec import TaskSpec, TurnSpec

FIELDS: dict[str, str | None] = {
    "control.mode": None,
    "control.smoothing": None,
    "force_command": None,
    "goal_dwell": None,
    "leash": "drop_radius",
    "objects.bare_friction": "objects.link_friction",
    "objects.corners": "objects.extremes",
    "objects.mesh_touch": "touch_method",
    "physics.condim": None,
    "physics.cone": None,
    "physics.palm": None,
    "physics.tips": None,
    "randomization.corners": "randomization.extremes",
    "reward.fingertips": None,
    "reward.tips_by": None,
    "sensing.array.bias": "sensing.taxel.bias",
    "sensing.array.counts": None,
    "sensing.array.crosstalk": "sensing.taxel.crosstalk",
    "sensing.array.dead": "sensing.taxel.dead",
    "sensing.array.drift": "sensing.taxel.drift",
    "sensing.array.gain": "sensing.taxel.gain",
    "sensing.array.hysteresis": "sensing.taxel.hysteresis",
    "sensing.array.hysteresis_time": "sensing.taxel.hysteresis_time",
    "sensing.array.noise": None,
    "sensing.array.rate": "sensing.taxel.rate",
    "sensing.array.resolution": None,
    "sensing.array.scale": None,
    "sensing.array.threshold": None,
    "sensing.array": None,
    "skin.bare": "skin.untaxelled",
}
"""Fields of a task's configuration: path to new path, or None for one that is gone."""

VALUES: dict[str, dict[Any, Any]] = {
    "skin.total": {"skin": "pressing"},
    "touch_method": {"boxes": "closed_form"},
}
"""Values of today's fields that were renamed or are gone: path to new values by old ones."""

UNCHANGED: dict[str, Any] = {
    "control.mode": "delta",
    "control.smoothing": 0.4,
    "force_command": "finger",
    "goal_dwell": 0.0,
    "physics.condim": 3,
    "physics.cone": "elliptic",
    "physics.palm": "auto",
    "physics.tips": "skin",
    "reward.fingertips": 0.0,
    "reward.tips_by": "last",
    "sensing.array": {},
}
"""Dropped fields at the value that every environment has today: they are not reported."""

INACTIVE: dict[str, tuple[str, Any]] = {"sensing.array": ("scale", 0.0)}
"""Groups of fields that had no effect while this one of them had this value: dropped, and not reported."""

SPEC: dict[str, str | None] = {"force_command": None}
"""Fields of a task's specification, likewise."""

ARGUMENTS: dict[str, str | None] = {"corners": "extremes", "episode_seconds": None}
"""Options of a training run, likewise; those under `env` are in `FIELDS`."""

LEAVES: dict[str, str | None] = {
    ".env_state.array_params.noise": None,
    ".env_state.array_params.threshold": None,
    ".env_state.array": ".env_state.taxel_memory",
    ".env_state.array_params": ".env_state.episode.taxels",
    ".env_state.draw": ".env_state.episode.hand",
    ".env_state.goal.dwell": None,
    ".env_state.metrics['reward/fingertips']": None,
    ".env_state.metrics['squeeze_force']": None,
    ".env_state.metrics['squeeze_normal']": None,
    ".env_state.metrics['squeeze_taxels']": None,
    ".env_state.object_velocity": None,
    ".env_state.orientation_sensor": ".env_state.episode.imu",
    ".env_state.sample": ".env_state.sensor_input",
    ".env_state.tangential_force": None,
    ".env_state.target.bare_friction": ".env_state.episode.object.link_friction",
    ".env_state.target": ".env_state.episode.object",
}
"""Paths of a checkpoint's arrays and of groups of them, likewise; the first that fits holds."""


def migrate_config(config: dict[str, Any], where: Any) -> dict[str, Any]:
    """A task's configuration from the file `where`, under today's names."""
    return _migrate(config, FIELDS, where)


def migrate_arguments(arguments: dict[str, Any], where: Any) -> dict[str, Any]:
    """The options of a training run, `env` included."""
    fields = ARGUMENTS | {f"env.{old}": new and f"env.{new}" for old, new in FIELDS.items()}
    arguments = _migrate(arguments, fields, where, "env.")
    if arguments.get("backend") == "auto" and jax.default_backend() == "cpu":
        arguments["backend"] = "jax"  # what it meant on a CPU when files still held it
    return arguments


def migrate_leaves(leaves: dict[str, Any], wanted: Collection[str]) -> dict[str, Any]:
    """A checkpoint's arrays by path, under today's paths; those that are `wanted` under the path they have stay."""
    moved = {path if path in wanted else _leaf_path(path): leaf for path, leaf in leaves.items()}
    return {path: leaf for path, leaf in moved.items() if path is not None}


def _leaf_path(path: str) -> str | None:
    for old, new in LEAVES.items():
        if path == old or path.startswith((f"{old}.", f"{old}[")):
            return None if new is None else new + path.removeprefix(old)
    return path


def read_spec(spec: dict[str, Any], where: Any) -> TaskSpec:
    """A task's specification from the file `where`.

    Raises:
      ConfigError: it is not one.
    """
    return from_dict(TaskSpec, _migrate(spec, SPEC, where))


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
    turn = from_dict(TurnSpec, config["turn"])
    return TaskSpec(
        fields=observation.ROTATE,
        gravity=(-level * math.cos(tilt), 9.81 * math.sin(roll), -level * math.sin(tilt)),
        reference=tuple(config["reference"]),
        turn=turn,
        **common,
    )


def _fields(cls: type) -> set[str]:
    return {field.name for field in dataclasses.fields(cls)}


def _migrate(config: dict[str, Any], fields: dict[str, str | None], where: Any, prefix: str = "") -> dict[str, Any]:
    """`prefix` leads to the task's configuration."""
    config, changes = copy.deepcopy(config), []
    for path, (switch, off) in INACTIVE.items():
        *groups, name = (prefix + path).split(".")
        parent = _group(config, groups)
        group = _group(parent, [name])
        if parent is not None and group is not None and group.get(switch) == off:
            del parent[name]
    for old, new in fields.items():
        *groups, name = old.split(".")
        group = _group(config, groups)
        if group is None or name not in group:
            continue
        value = group.pop(name)
        if new is None:
            if old.removeprefix(prefix) not in UNCHANGED or value != UNCHANGED[old.removeprefix(prefix)]:
                changes.append(f"{old} = {value!r} dropped")
        else:
            *groups, name = new.split(".")
            target = _group(config, groups)
            (config if target is None else target).setdefault(name, value)
            changes.append(f"{old} is now {new}")
    for path, values in VALUES.items():
        *groups, name = (prefix + path).split(".")
        group = _group(config, groups)
        if group is not None and isinstance(value := group.get(name), str) and value in values:
            group[name] = values[value]
            changes.append(f"{path} = {value!r} is now {values[value]!r}")
    if changes:
        warnings.warn(f"{where}: from an older version of dexsim: {', '.join(changes)}", OldFileWarning, stacklevel=4)
    return config


def _group(config: Any, names: list[str]) -> dict[str, Any] | None:
    for name in names:
        config = config.get(name) if isinstance(config, dict) else None
    return config if isinstance(config, dict) else None
