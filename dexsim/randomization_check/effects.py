"""What drawing a range changes: in the drive or the compiled model, and then in motion and readings.

Every range is drawn by itself, all others at their nominal values, and the same starts and actions are
run with and without it. A difference counts only in ticks in which it is larger than that of two runs of the same.
"""

import dataclasses
import functools
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from dexsim.core.pytree import align
from dexsim.objects.config import SHAPES, nominal
from dexsim.randomization import NOMINAL, Randomization, sample_hand
from dexsim.sensing.imu import ImuConfig, sample_imu
from dexsim.sensing.taxels import TaxelSensor

READINGS = ("joint_position", "joint_torque", "taxel_force", "object_position", "object_quat")
# What must be there for a range to show.
_AIDS: dict[str, dict[str, Any]] = {
    "ripple_count": {"ripple": (0.03, 0.03)},
    "hysteresis_time": {"hysteresis": (0.3, 0.3)},
}
_SHAPE_OF = {"sphere": "sphere", "cylinder": "cylinder", "neck": "composition"}
_WIDTHS = ("encoder_bias", "gravity_tilt", "com_offset", "bias", "drift")  # ranges given by one number


@dataclasses.dataclass(frozen=True)
class Effect:
    """What drawing one range does."""

    name: str
    changed: tuple[str, ...] = ()  # leaves of the draw, fields of the compiled model
    spread: float = 0.0  # largest standard deviation of such a leaf over the batch, over its size
    joint: float = 0.0  # rad, root mean square over batch and joints, in the tick where it is largest
    object: float = 0.0  # m, likewise
    reading: float = 0.0  # root mean square change of the readings it moves most, over their size
    which: str = ""  # that reading
    off: bool = False  # the range has no width: nothing to see

    @property
    def found(self) -> bool:
        """It reaches the drive or the model, and after it the motion or what is measured."""
        return self.off or (bool(self.changed) and max(self.joint, self.object, self.reading) > 0)


def check(
    env: Any, step: Callable, states: Any, *, key: jax.Array, ticks: int = 12, names: Sequence[str] | None = None
) -> list[Effect]:
    """Draw every range by itself and compare the motion.

    Args:
      env: an environment of `dexsim.env.env`.
      step: its compiled `step` over a batch.
      states: a batch of fresh states.
      key: of the draws and actions.
      ticks: length of the comparison.
      names: which ranges ("Randomization.x", "ObjectConfig.x", "push"); by default all.
    """
    bench = _Bench(env, step, states, key, ticks)
    tests: dict[str, Callable[[], Effect]] = {}
    for name in _ranges(env.config.randomization):
        tests[f"Randomization.{name}"] = functools.partial(bench.hand_range, name)
    for name in _ranges(env.config.sensing.orientation):
        tests[f"ImuConfig.{name}"] = functools.partial(bench.orientation_range, name)
    for name in _taxel_ranges(env.config.sensing.taxel):
        tests[f"TaxelSensor.{name}"] = functools.partial(bench.taxel_range, name)
    for path in env.task.object_ranges:
        owner, name = _owner(env.config, path)
        tests[f"{type(owner).__name__}.{name}"] = functools.partial(bench.object_range, path)
    tests["push"] = bench.push
    return [tests[name]() for name in names or tests]


def _ranges(config: Any) -> list[str]:
    """Names of (low, high) pairs, and of largest deviations from 0."""

    def is_range(name: str) -> bool:
        value = getattr(config, name)
        return value is not None and (
            name in _WIDTHS
            or (isinstance(value, tuple) and len(value) == 2 and all(isinstance(v, (int, float)) for v in value))
        )

    return [field.name for field in dataclasses.fields(config) if is_range(field.name)]


def _taxel_ranges(config: TaxelSensor) -> list[str]:
    """Names of the ranges of the taxels that are on."""
    return [name for name in _ranges(config) if name != "hysteresis_time" or config.hysteresis is not None]


class _Bench:
    """The same starts and actions for all ranges."""

    def __init__(self, env: Any, step: Callable, states: Any, key: jax.Array, ticks: int):
        self.env, self.step = env, step
        self.count = len(states.tick)
        self.key, action_key = jax.random.split(key)
        # Fingers close, and all joints are thrown about: contact, full torque and speed occur.
        throw = jax.random.uniform(action_key, (ticks, self.count, env.action_size), minval=-1.0)
        close = jnp.asarray([0.0 if low < 0 else 0.5 for low in env.hand.joint_lower])
        self.actions = jnp.clip(throw + align(close, throw), -1.0, 1.0)
        self.states = dataclasses.replace(
            states,
            episode=dataclasses.replace(
                states.episode,
                hand=self._hands(self._only()),
                imu=self._imus(_still_imu(env)),
                taxels=self._taxels(),
            ),
        )
        self.base = self._run(self.states)
        # Engine mjx on a GPU may add in another order each time: what is not well above that is no effect.
        self.floor = {name: 3.0 * apart for name, apart in self._distance(self._run(self.states)).items()}

    def _starts(self, **changes: Any) -> Any:
        """The starts with other parts of their episodes (`Episode`)."""
        return dataclasses.replace(self.states, episode=dataclasses.replace(self.states.episode, **changes))

    def _only(self, *names: str) -> Randomization:
        """The ranges with all but these at their nominal values."""
        config, fixed = self.env.config.randomization, {}
        for name in _ranges(config):
            if name not in names:
                centre = NOMINAL.get(name, 0.0)
                fixed[name] = (centre, centre) if isinstance(getattr(config, name), tuple) else 0.0
        for name in names:
            fixed |= _AIDS.get(name, {})
        return dataclasses.replace(config, scale=1.0, **fixed)

    def _hands(self, config: Randomization) -> Any:
        return jax.vmap(
            lambda key: sample_hand(
                key,
                config,
                self.env.hand,
                timestep=self.env.config.physics.timestep,
                control_period=self.env.control_period,
            )
        )(jax.random.split(self.key, self.count))

    def _imus(self, config: ImuConfig) -> Any:
        return jax.vmap(lambda key: sample_imu(key, config, 1.0, self.env.control_period))(
            jax.random.split(self.key, self.count)
        )

    def _taxels(self, *names: str, **aids: Any) -> Any:
        """Taxels that are perfect but for these ranges, with the structure of the environment's."""
        array, config = self.env.senses.taxels, self.env.config.sensing.taxel
        perfect = {"rate": 1 / self.env.control_period, "gain": 1.0, "hysteresis_time": config.hysteresis_time[0]}
        fixed = {name: (perfect.get(name, 0.0),) * 2 for name in _taxel_ranges(config) if name not in names}
        array = dataclasses.replace(array, sensor=dataclasses.replace(config, **fixed | aids))
        return jax.vmap(array.sample)(jax.random.split(self.key, self.count))

    def _run(self, states: Any) -> dict[str, np.ndarray]:
        """Tracks [T, ...] of what is compared."""
        physics, rows = self.env.physics, []
        for action in self.actions:
            states = self.step(states, action)
            qpos = np.asarray(states.physics.qpos, float)
            rows.append(
                {
                    "joint": qpos[:, physics.joint_qpos],
                    "object": qpos[:, physics.object_qpos[:3]],
                    **{name: np.asarray(getattr(states.readings, name), float) for name in READINGS},
                }
            )
        return {name: np.stack([row[name] for row in rows]) for name in rows[0]}

    def _distance(
        self, track: dict[str, np.ndarray], base: dict[str, np.ndarray] | None = None
    ) -> dict[str, np.ndarray]:
        """Root mean square [T, B] over components, by quantity."""
        base = self.base if base is None else base
        return {
            name: np.sqrt(np.mean((track[name] - base[name]) ** 2, tuple(range(2, track[name].ndim)))) for name in base
        }

    def _largest(self, name: str, distance: np.ndarray) -> float:
        """Root mean square over the batch, in the tick where it is largest, of `distance` [T, B] that counts."""
        above = distance > self.floor[name][: len(distance)]
        counts = np.any(above, 1)
        return float(np.max(np.sqrt(np.mean(distance**2, 1)), where=counts, initial=0.0))

    def _effect(
        self, name: str, before: Any, after: Any, states: Any, base: dict[str, np.ndarray] | None = None
    ) -> Effect:
        changed, spread = changes(before, after)
        distance = self._distance(self._run(states), base)
        largest = {name: self._largest(name, value) for name, value in distance.items()}
        size = {name: float(np.sqrt(np.mean(self.base[name] ** 2))) or 1.0 for name in READINGS}
        readings = {name: largest[name] / size[name] for name in READINGS}
        most = max(readings, key=readings.__getitem__)
        return Effect(name, changed, spread, largest["joint"], largest["object"], readings[most], most)

    def hand_range(self, name: str) -> Effect:
        """One field of `Randomization`."""
        label, ranges = f"Randomization.{name}", self.env.config.randomization
        if _width(getattr(ranges, name)) == 0:
            return Effect(label, off=True)
        base, before = None, self.states.episode.hand
        if name in _AIDS:
            before = self._hands(dataclasses.replace(self._only(), **_AIDS[name]))
            base = self._run(self._starts(hand=before))
        drawn = self._hands(self._only(name))
        return self._effect(label, before, drawn, self._starts(hand=drawn), base)

    def orientation_range(self, name: str) -> Effect:
        """One field of `ImuConfig`."""
        label, config = f"ImuConfig.{name}", self.env.config.sensing.orientation
        if _width(getattr(config, name)) == 0:
            return Effect(label, off=True)
        drawn = self._imus(dataclasses.replace(_still_imu(self.env), **{name: getattr(config, name)}))
        return self._effect(label, self.states.episode.imu, drawn, self._starts(imu=drawn))

    def taxel_range(self, name: str) -> Effect:
        """One field of `TaxelSensor`."""
        label, span = f"TaxelSensor.{name}", getattr(self.env.config.sensing.taxel, name)
        if _width(span) == 0:
            return Effect(label, off=True)
        base, before, aids = None, self.states.episode.taxels, _AIDS.get(name, {})
        if aids:
            before = self._taxels(**aids)
            base = self._run(self._starts(taxels=before))
        drawn = self._taxels(name, **aids)
        return self._effect(label, before, drawn, self._starts(taxels=drawn), base)

    def object_range(self, path: str) -> Effect:
        """One range of the object, on objects of a shape that has it."""
        env, (owner, name) = self.env, _owner(self.env.config, path)
        label = f"{type(owner).__name__}.{name}"
        if _width(getattr(owner, name)) == 0:
            return Effect(label, off=True)
        config = env.config
        for other in env.task.object_ranges:
            holder, field = _owner(config, other)
            centre = 0.0 if field in _WIDTHS else (nominal(holder, field),) * 2
            config = _with(config, other, centre)
        shape = jnp.int32(SHAPES.index(_SHAPE_OF.get(name.split("_")[0], "box")))
        keys = jax.random.split(self.key, self.count)
        before, after = (
            jax.vmap(lambda key, c=c: env.task.sample_object(key, c, shape))(keys)
            for c in (config, _with(config, path, getattr(owner, name)))
        )
        base = self._run(self._starts(object=before))
        effect = self._effect(label, before, after, self._starts(object=after), base)
        # What the physics is given must differ too, not only what was drawn.
        models = [env.physics.configure(jax.tree.map(lambda leaf: leaf[0], object)) for object in (before, after)]
        return dataclasses.replace(effect, changed=changes(*models)[0])

    def push(self) -> Effect:
        """Pushes by the task: starts whose first tick has one, against starts whose has none."""
        keys = jax.random.split(self.key, 8192)
        forces = np.asarray(
            jax.vmap(
                lambda key: self.env.task.push(
                    jax.random.split(key, 4)[1], jax.tree.map(lambda leaf: leaf[0], self.states.episode.object)
                )
            )(keys)
        )
        hit = np.any(forces != 0, -1)
        if not np.any(hit):
            return Effect("push", off=True)
        tracks = []
        for rows in (np.flatnonzero(~hit), np.flatnonzero(hit)):
            state = self.step(dataclasses.replace(self.states, key=keys[np.resize(rows, self.count)]), self.actions[0])
            tracks.append(np.asarray(state.physics.qpos, float)[:, self.env.physics.object_qpos[:3]])
        moved = np.sqrt(np.mean((tracks[1] - tracks[0]) ** 2, -1))
        return Effect(
            "push",
            ("xfrc_applied",),
            float(np.std(forces[hit])),
            object=self._largest("object", moved[None]),
        )


def changes(before: Any, after: Any) -> tuple[tuple[str, ...], float]:
    """Names of the leaves that differ, and the largest of their relative spreads."""
    names, spreads = [], [0.0]
    pairs = zip(jax.tree_util.tree_flatten_with_path(before)[0], jax.tree.leaves(after), strict=True)
    for (path, old), new in pairs:
        if not isinstance(old, (jax.Array, np.ndarray)) or old.dtype.kind not in "biuf":
            continue
        old, new = np.asarray(old, float), np.asarray(new, float)
        if np.array_equal(old, new):
            continue
        names.append(jax.tree_util.keystr(path, simple=True, separator="."))
        size = np.sqrt(np.mean(new**2, 0))
        spreads.append(float(np.max(np.std(new - old, 0) / np.where(size > 0, size, 1.0))))
    return tuple(names), max(spreads)


def _width(span: float | tuple[float, float]) -> float:
    return span[1] - span[0] if isinstance(span, tuple) else span


def _still_imu(env: Any) -> ImuConfig:
    return dataclasses.replace(env.config.sensing.orientation, bias=0.0, drift=0.0, delay=(0.0, 0.0))


def _owner(config: Any, path: str) -> tuple[Any, str]:
    """The dataclass that holds a dotted path, and the last name."""
    *parents, name = path.split(".")
    for parent in parents:
        config = getattr(config, parent)
    return config, name


def _with(config: Any, path: str, value: Any) -> Any:
    """`config` with a value at a dotted path."""
    head, _, rest = path.partition(".")
    return dataclasses.replace(config, **{head: _with(getattr(config, head), rest, value) if rest else value})
