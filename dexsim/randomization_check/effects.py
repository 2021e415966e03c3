"""What drawing a range by itself changes: in the draw or the compiled model, and then in motion and readings."""

import dataclasses
import functools
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from dexsim.core.pytree import align
from dexsim.env.env import Env
from dexsim.env.episode import EpisodeSampler
from dexsim.env.sensors import SensorSuite
from dexsim.env.state import Episode, State
from dexsim.objects.config import SHAPES, nominal
from dexsim.randomization import NOMINAL

READINGS = ("joint_position", "joint_torque", "taxel_force", "object_position", "object_quat", "palm_gravity")
_DEVIATIONS = ("encoder_bias", "gravity_tilt", "com_offset", "bias", "drift")  # where they are one number
_TAXELS = {"gain": 1.0, "hysteresis_time": 0.1}  # a perfect taxel array, where that is not 0; its rate is the control's
# What must be there for a range to show.
_AIDS = {
    "randomization.ripple_count": {"randomization.ripple": (0.03, 0.03)},
    "sensing.taxel.hysteresis_time": {"sensing.taxel.hysteresis": (0.3, 0.3)},
}
_SHAPE_OF = {"sphere": "sphere", "cylinder": "cylinder", "neck": "composition"}


@dataclasses.dataclass(frozen=True)
class Effect:
    """What drawing one range does."""

    name: str
    changed: tuple[str, ...] = ()  # leaves of the episode's draw and of the compiled model
    joint: float = 0.0  # rad, root mean square over hands and joints, in the tick where it is largest
    object: float = 0.0  # m, likewise
    reading: float = 0.0  # root mean square change of the reading that it moves most, over that reading's size
    which: str = ""  # that reading
    off: bool = False  # the range has no width

    @property
    def works(self) -> bool:
        """It reaches the model, and after it the motion or what is measured."""
        return self.off or bool(self.changed) and max(self.joint, self.object, self.reading) > 0


def range_paths(env: Env) -> list[str]:
    """Where in the configuration ranges are that are drawn: pairs (low, high), and largest deviations from 0."""
    paths = [
        f"{group}.{field.name}"
        for group in ("randomization", "sensing.orientation", "sensing.taxel")
        for field in dataclasses.fields(_at(env.config, group))
        if _is_range(field.name, _at(env.config, f"{group}.{field.name}"))
    ]
    if env.config.sensing.taxel.hysteresis is None:
        paths.remove("sensing.taxel.hysteresis_time")
    return [*paths, *env.task.object_ranges]


def check(
    env: Env, step: Callable, states: State, *, key: jax.Array, ticks: int = 12, names: Sequence[str] | None = None
) -> list[Effect]:
    """Draw every range (or those of `names`) by itself and compare the motion over some ticks, with an environment's
    compiled `step` over a batch of fresh states."""
    key, action_key = jax.random.split(key)
    # Fingers close, and all joints are thrown about: contact, full torque and speed occur.
    throw = jax.random.uniform(action_key, (ticks, len(states.tick), env.action_size), minval=-1.0)
    close = jnp.asarray([0.0 if low < 0 else 0.5 for low in env.hand.joint_lower])
    actions = jnp.clip(throw + align(close, throw), -1.0, 1.0)
    paths = range_paths(env)
    perfect: Any = dataclasses.replace(
        env.config, randomization=dataclasses.replace(env.config.randomization, scale=1.0)
    )
    for path in paths:
        perfect = _with(perfect, path, _nominal(env, path))

    def run(episode: Episode) -> dict[str, np.ndarray]:
        return _run(env, step, dataclasses.replace(states, episode=episode), actions)

    def draw(shape: str | None, config: Any) -> Episode:
        sampler = EpisodeSampler(config, env.hand, env.task, SensorSuite(config, env.hand, env.task))
        keys, objects = jax.random.split(key, (4, len(states.tick))), states.episode.object
        if shape is not None:
            index = jnp.int32(SHAPES.index(shape))
            objects = jax.vmap(lambda one: env.task.sample_object(one, config, index))(keys[3])
        return jax.vmap(sampler.sample)(keys[0], keys[1], keys[2], objects)

    @functools.cache
    def baseline(shape: str | None, config: Any) -> tuple[Episode, dict[str, np.ndarray]]:
        """The draw without any width, which most ranges have in common, and its motion."""
        episode = draw(shape, config)
        return episode, run(episode)

    def effect(path: str) -> Effect:
        span = _at(env.config, path)
        if (span[1] - span[0] if isinstance(span, tuple) else span) == 0:
            return Effect(path, off=True)
        config = perfect
        for aid, value in _AIDS.get(path, {}).items():
            config = _with(config, aid, value)
        shape = None
        if path in env.task.object_ranges:  # of a shape that has this range
            shape = _SHAPE_OF.get(path.split(".")[-1].split("_")[0], "box")
        before, base = baseline(shape, config)
        after = draw(shape, _with(config, path, span))
        size = {name: float(np.sqrt(np.mean(base[name] ** 2))) or 1.0 for name in READINGS}
        track = run(after)
        # Root mean square over hands and components, in the tick where it is largest.
        moved = {
            name: float(np.sqrt(np.mean((track[name] - base[name]) ** 2, tuple(range(1, base[name].ndim)))).max())
            for name in base
        }
        which = max(READINGS, key=lambda name: moved[name] / size[name])
        if path in env.task.object_ranges:  # What the physics is given must differ, not only what was drawn.
            models = [env.physics.configure(jax.tree.map(lambda leaf: leaf[0], e.object)) for e in (before, after)]
            changed = changes(*models)
        else:
            changed = changes(before, after)
        return Effect(path, changed, moved["joint"], moved["object"], moved[which] / size[which], which)

    return [effect(path) for path in names or paths]


def _run(env: Env, step: Callable, states: State, actions: jax.Array) -> dict[str, np.ndarray]:
    """Tracks [T, ...] of what is compared."""
    rows = []
    for action in actions:
        states = step(states, action)
        qpos = np.asarray(states.physics.qpos, float)
        motion = {"joint": qpos[:, env.physics.joint_qpos], "object": qpos[:, env.physics.object_qpos[:3]]}
        rows.append(motion | {name: np.asarray(getattr(states.readings, name), float) for name in READINGS})
    return {name: np.stack([row[name] for row in rows]) for name in rows[0]}


def changes(before: Any, after: Any) -> tuple[str, ...]:
    """Names of the leaves that differ."""
    pairs = zip(jax.tree_util.tree_flatten_with_path(before)[0], jax.tree.leaves(after), strict=True)
    return tuple(
        jax.tree_util.keystr(path, simple=True, separator=".")
        for (path, old), new in pairs
        if isinstance(old, (jax.Array, np.ndarray)) and not np.array_equal(old, new)
    )


def _is_range(name: str, value: Any) -> bool:
    pair = isinstance(value, tuple) and len(value) == 2 and all(isinstance(v, int | float) for v in value)
    return pair or name in _DEVIATIONS and isinstance(value, float)


def _nominal(env: Env, path: str) -> Any:
    """The value of a range without width."""
    group, _, name = path.rpartition(".")
    holder, value = _at(env.config, group), _at(env.config, path)
    if not isinstance(value, tuple):
        return 0.0
    if path in env.task.object_ranges:
        return (nominal(holder, name),) * 2
    if group == "randomization":
        return (NOMINAL.get(name, 0.0),) * 2
    return (1 / env.control_period if name == "rate" else _TAXELS.get(name, 0.0),) * 2


def _at(config: Any, path: str) -> Any:
    """The value at a dotted path."""
    for name in filter(None, path.split(".")):
        config = getattr(config, name)
    return config


def _with(config: Any, path: str, value: Any) -> Any:
    """`config` with a value at a dotted path."""
    head, _, rest = path.partition(".")
    return dataclasses.replace(config, **{head: _with(getattr(config, head), rest, value) if rest else value})
