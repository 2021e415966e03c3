"""Self-test of the randomisation: does drawing a range change the model, and then motion or readings?

    python -m dexsim.randomization_check --task grasp

Every range is drawn by itself, all others at their nominal values. The same starts and actions are run with and
without it. A range that changes nothing is an error (exit code 2): somewhere between the configuration and the physics
it was lost.
"""

import dataclasses
import sys
from collections.abc import Callable, Sequence
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np

from dexsim.core import cli
from dexsim.core.compilation import jit
from dexsim.core.config import Config, setting
from dexsim.core.errors import ConfigError
from dexsim.core.pytree import align
from dexsim.env.env import Env
from dexsim.env.episode import EpisodeSampler
from dexsim.env.senses import SensorSuite
from dexsim.env.state import Episode, State
from dexsim.objects.config import SHAPES, nominal
from dexsim.randomization import NOMINAL
from dexsim.registry import find_task, make

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
    """Draw every range by itself and compare the motion.

    Args:
      env: the environment.
      step: its compiled `step` over a batch.
      states: a batch of fresh states.
      key: of the draws and actions.
      ticks: length of the comparison.
      names: which ranges, of `range_paths`; by default all.
    """
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

    def effect(path: str) -> Effect:
        span = _at(env.config, path)
        if (span[1] - span[0] if isinstance(span, tuple) else span) == 0:
            return Effect(path, off=True)
        config = perfect
        for aid, value in _AIDS.get(path, {}).items():
            config = _with(config, aid, value)
        shape = jnp.int32(SHAPES.index(_SHAPE_OF.get(path.split(".")[-1].split("_")[0], "box")))
        before, after = (_draw(env, c, key, len(states.tick), shape) for c in (config, _with(config, path, span)))
        base = run(before)
        size = {name: float(np.sqrt(np.mean(base[name] ** 2))) or 1.0 for name in READINGS}
        moved = {name: float(np.max(values)) for name, values in _distance(run(after), base).items()}
        which = max(READINGS, key=lambda name: moved[name] / size[name])
        if path in env.task.object_ranges:  # What the physics is given must differ, not only what was drawn.
            models = [env.physics.configure(jax.tree.map(lambda leaf: leaf[0], e.object)) for e in (before, after)]
            changed = changes(*models)
        else:
            changed = changes(before, after)
        return Effect(path, changed, moved["joint"], moved["object"], moved[which] / size[which], which)

    return [effect(path) for path in names or paths]


def _draw(env: Env, config: Any, key: jax.Array, count: int, shape: jax.Array) -> Episode:
    """Episodes [count] as this configuration draws them."""
    sampler = EpisodeSampler(config, env.hand, env.task, SensorSuite(config, env.hand, env.task))

    def draw(key: jax.Array) -> Episode:
        keys = jax.random.split(key, 4)
        return sampler.sample(*keys[:3], env.task.sample_object(keys[3], config, shape))

    return jax.vmap(draw)(jax.random.split(key, count))


def _run(env: Env, step: Callable, states: State, actions: jax.Array) -> dict[str, np.ndarray]:
    """Tracks [T, ...] of what is compared."""
    rows = []
    for action in actions:
        states = step(states, action)
        qpos = np.asarray(states.physics.qpos, float)
        motion = {"joint": qpos[:, env.physics.joint_qpos], "object": qpos[:, env.physics.object_qpos[:3]]}
        rows.append(motion | {name: np.asarray(getattr(states.readings, name), float) for name in READINGS})
    return {name: np.stack([row[name] for row in rows]) for name in rows[0]}


def _distance(track: dict[str, np.ndarray], base: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Root mean square [T] over hands and components, by quantity."""
    return {name: np.sqrt(np.mean((track[name] - base[name]) ** 2, tuple(range(1, base[name].ndim)))) for name in base}


def changes(before: Any, after: Any) -> tuple[str, ...]:
    """Names of the leaves that differ."""
    pairs = zip(jax.tree_util.tree_flatten_with_path(before)[0], jax.tree.leaves(after), strict=True)
    return tuple(
        jax.tree_util.keystr(path, simple=True, separator=".")
        for (path, old), new in pairs
        if isinstance(old, (jax.Array, np.ndarray)) and not np.array_equal(old, new)
    )


def _is_range(name: str, value: Any) -> bool:
    pair = isinstance(value, tuple) and len(value) == 2 and all(isinstance(v, float) for v in value)
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


@dataclasses.dataclass(frozen=True, kw_only=True)
class CheckArguments(Config):
    """Show that every range of the randomisation has an effect."""

    task: str = "grasp"
    """Name of the task, which gets its default configuration; my_module:poke for a task of your own."""
    backend: Literal["auto", "c", "cuda", "mjx"] = setting("auto")
    """Physics backend. auto: c on a CPU, cuda on an NVIDIA GPU, otherwise jax."""
    num_envs: int = setting(16, unit="1", low=2, high=65536)
    """Hands sampled for each range."""
    ticks: int = setting(12, unit="1", low=1, high=1000)
    """Control ticks to compare."""
    seed: int = setting(0, unit="1", low=0, high=2**32 - 2)
    """Seed of starts, samples and actions."""


def conclude(effects: Sequence[Effect]) -> int:
    """Print the table; the exit code."""
    print(f"{'range':34}{'joints':>13}{'object':>12}{'reading':>9}  what changed")
    for effect in effects:
        verdict = "off: no width" if effect.off else ", ".join(effect.changed) or "nothing"
        verdict = verdict if effect.works else f"NO EFFECT ({verdict})"
        motion = f"{1e3 * effect.joint:8.3f} mrad{1e3 * effect.object:9.3f} mm{effect.reading:9.4f}"
        print(f"{effect.name:34}{motion}  {verdict}")
    lost = [effect.name for effect in effects if not effect.works]
    if lost:
        print(f"error: no effect on model or motion: {', '.join(lost)}", file=sys.stderr)
    return 2 if lost else 0


def main(argv: Sequence[str] | None = None) -> int:
    """The command. Returns its exit code: 0, or 2 where a range has no effect."""
    arguments = cli.parse(
        CheckArguments,
        sys.argv[1:] if argv is None else argv,
        prog="python -m dexsim.randomization_check",
        description="Show that every range of the randomisation has an effect.",
    )
    entry = find_task(arguments.task)
    if entry.environment:
        raise ConfigError(f"--task {arguments.task}: is no task on a hand: it has no randomisation to check")
    config = dataclasses.replace(entry.config(), pool_size=80)
    env = make(arguments.task, config, backend=arguments.backend)
    keys = jax.random.split(jax.random.key(arguments.seed), arguments.num_envs)
    states = jit(jax.vmap(env.reset), once=True)(keys)
    step = jit(jax.vmap(env.step), backend=env.backend)
    effects = check(env, step, states, key=jax.random.key(arguments.seed + 1), ticks=arguments.ticks)
    print(f"{arguments.task} on {env.backend}, {arguments.num_envs} hands, {arguments.ticks} ticks")
    return conclude(effects)


if __name__ == "__main__":
    cli.run(main)
