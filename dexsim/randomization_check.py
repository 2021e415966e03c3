"""Self-test of the randomisation: does drawing a range change the model, and then the motion?

    python -m dexsim.randomization_check --task grasp

Every range is drawn by itself, all others at their nominal values. The same starts and actions are
then run with and without it, and the table says what changed in the drive or the compiled model,
and by how much joints, object and readings went elsewhere. A range that changes nothing is an
error (exit code 2): somewhere between the configuration and the physics it was lost.
"""

import dataclasses
import sys
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from dexsim.config import setting, validate
from dexsim.errors import DexsimError
from dexsim.objects import SHAPES, ObjectConfig, sample_object
from dexsim.randomization import Randomization, sample

NOMINAL = {"stiffness_factor": 1.0, "damping_factor": 1.0, "torque_factor": 1.0,
           "speed_factor": 1.0, "efficiency": 1.0, "torque_gain": 1.0, "taxel_gain": 1.0}
"""Nominal values that are not 0."""

_AIDS = {"ripple_count": {"ripple": (0.03, 0.03)}}  # what must be there for a range to show
_SHAPE_OF = {"sphere": "sphere", "cylinder": "cylinder", "neck": "composition"}
_READINGS = ("joint_position", "joint_torque", "taxel_force", "object_position")


@dataclasses.dataclass(frozen=True)
class Effect:
    """What drawing one range does."""

    name: str
    changed: tuple[str, ...]  # leaves of the draw, fields of the compiled model
    spread: float  # largest standard deviation of such a leaf over the batch, over its size
    joint: float  # rad, root mean square over batch, ticks and joints
    object: float  # m, likewise
    reading: float  # root mean square change of the readings it moves most, over their size
    which: str  # that reading
    off: bool = False  # the range has no width: nothing to see

    @property
    def found(self) -> bool:
        """It reaches the drive or the model, and after it the motion or what is measured."""
        return self.off or (bool(self.changed) and max(self.joint, self.object, self.reading) > 0)


def check(env: Any, step: Callable, states: Any, *, key: jax.Array, ticks: int = 12,
          names: Sequence[str] | None = None) -> list[Effect]:
    """Draw every range by itself and compare the motion.

    Args:
      env: an environment of `dexsim.env`.
      step: its compiled `step` over a batch.
      states: a batch of fresh states.
      key: of the draws and actions.
      ticks: length of the comparison.
      names: which ranges ("Randomization.x", "ObjectConfig.x", "push"); all by default.
    """
    bench = _Bench(env, step, states, key, ticks)
    tests: dict[str, Callable[[], Effect]] = {}
    for field in dataclasses.fields(Randomization):
        if _is_range(env.config.randomization, field):
            tests[f"Randomization.{field.name}"] = lambda n=field.name: bench.hand_range(n)
    for field in dataclasses.fields(ObjectConfig):
        if _is_range(env.config.objects, field):
            tests[f"ObjectConfig.{field.name}"] = lambda n=field.name: bench.object_range(n)
    tests["push"] = bench.push
    return [tests[name]() for name in names or tests]


def _is_range(config: Any, field: dataclasses.Field) -> bool:
    """(low, high) pairs, and the largest deviations from 0."""
    value = getattr(config, field.name)
    pair = isinstance(value, tuple) and len(value) == 2 and all(
        isinstance(v, (int, float)) for v in value)
    return pair or field.name in ("encoder_bias", "gravity_tilt", "com_offset")


class _Bench:
    """The same starts and actions for all ranges."""

    def __init__(self, env: Any, step: Callable, states: Any, key: jax.Array, ticks: int):
        self.env, self.step = env, step
        self.count = len(states.tick)
        self.key, action_key = jax.random.split(key)
        # Fingers close, and all joints are thrown about: contact, full torque and speed occur.
        throw = jax.random.uniform(action_key, (ticks, self.count, env.action_size), minval=-1.0)
        close = jnp.asarray([0.0 if low < 0 else 0.5 for low in env.hand.joint_lower])
        self.actions = jnp.clip(throw + close, -1.0, 1.0)
        self.states = dataclasses.replace(states, draw=self._draw(self._only()))
        self.base = self._run(self.states)
        again = self._run(self.states)
        # On the Warp backend two runs of the same differ: what is smaller than that is no effect.
        self.floor = [3.0 * value for value in self._distance(again)[:3]]

    def _only(self, *names: str) -> Randomization:
        """The ranges with all but these at their nominal values."""
        config, fixed = self.env.config.randomization, {}
        for field in dataclasses.fields(config):
            if field.name not in names and _is_range(config, field):
                centre = NOMINAL.get(field.name, 0.0)
                fixed[field.name] = (0.0 if not isinstance(getattr(config, field.name), tuple)
                                     else (centre, centre))
        for name in names:
            fixed |= _AIDS.get(name, {})
        return dataclasses.replace(config, scale=1.0, **fixed)

    def _draw(self, config: Randomization) -> Any:
        keys = jax.random.split(self.key, self.count)
        period = self.env.config.physics
        return jax.vmap(lambda key: sample(
            key, config, self.env.hand, timestep=period.timestep,
            control_period=self.env.control_period))(keys)

    def _run(self, states: Any) -> list[dict[str, np.ndarray]]:
        physics, track = self.env.physics, []
        for action in self.actions:
            states = self.step(states, action)
            qpos = np.asarray(states.physics.qpos, float)
            track.append({"joint": qpos[:, physics.joint_qpos],
                          "object": qpos[:, physics.object_qpos[:3]],
                          **{name: np.asarray(getattr(states.readings, name), float)
                             for name in _READINGS}})
        return track

    def _distance(self, track: list[dict[str, np.ndarray]],
                  base: list[dict[str, np.ndarray]] | None = None
                  ) -> tuple[float, float, float, str]:
        base = self.base if base is None else base

        def rms(name: str) -> float:
            return float(np.sqrt(np.mean([(a[name] - b[name]) ** 2
                                          for a, b in zip(track, base, strict=True)])))

        def size(name: str) -> float:
            return float(np.sqrt(np.mean([row[name] ** 2 for row in base]))) or 1.0

        readings = {name: rms(name) / size(name) for name in _READINGS}
        most = max(readings, key=readings.__getitem__)
        return rms("joint"), rms("object"), readings[most], most

    def _effect(self, name: str, before: Any, after: Any, states: Any,
                base: list[dict[str, np.ndarray]] | None = None) -> Effect:
        changed, spread = _changed(before, after)
        distances = self._distance(self._run(states), base)
        joint, thing, reading = (value if value > floor else 0.0 for value, floor in
                                 zip(distances[:3], self.floor, strict=True))
        return Effect(name, changed, spread, joint, thing, reading, distances[3])

    def hand_range(self, name: str) -> Effect:
        """One field of `Randomization`."""
        label = f"Randomization.{name}"
        if _width(getattr(self.env.config.randomization, name)) == 0:
            return Effect(label, (), 0.0, 0.0, 0.0, 0.0, "", off=True)
        base, before = None, self.states.draw
        aid = _AIDS.get(name)
        if aid:
            before = self._draw(dataclasses.replace(self._only(), **aid))
            base = self._run(dataclasses.replace(self.states, draw=before))
        draw = self._draw(self._only(name))
        return self._effect(label, before, draw, dataclasses.replace(self.states, draw=draw), base)

    def object_range(self, name: str) -> Effect:
        """One field of `ObjectConfig`, on objects of a shape that has it."""
        label, config = f"ObjectConfig.{name}", self.env.config.objects
        if _width(getattr(config, name)) == 0:
            return Effect(label, (), 0.0, 0.0, 0.0, 0.0, "", off=True)
        centre = {field.name: (0.0 if field.name == "com_offset"
                               else (float(np.mean(getattr(config, field.name))),) * 2)
                  for field in dataclasses.fields(config) if _is_range(config, field)}
        nominal = dataclasses.replace(config, **centre)
        only = dataclasses.replace(nominal, **{name: getattr(config, name)})
        shape = jnp.int32(SHAPES.index(_SHAPE_OF.get(name.split("_")[0], "box")))
        keys = jax.random.split(self.key, self.count)
        before, after = (jax.vmap(lambda key, c=c: sample_object(key, c, shape))(keys)
                         for c in (nominal, only))
        base = self._run(dataclasses.replace(self.states, target=before))
        effect = self._effect(label, before, after,
                              dataclasses.replace(self.states, target=after), base)
        # What the physics is given must differ too, not only what was drawn.
        models = [self.env.physics.configure(jax.tree.map(lambda leaf: leaf[0], target))
                  for target in (before, after)]
        return dataclasses.replace(effect, changed=_changed(*models)[0])

    def push(self) -> Effect:
        """Pushes by the task: starts whose first tick has one, against starts whose has none."""
        keys = jax.random.split(self.key, 8192)
        forces = jax.vmap(lambda key: self.env.task.push(
            jax.random.split(key, 4)[1], jax.tree.map(lambda leaf: leaf[0], self.states.target)))(
                keys)
        pushed = np.flatnonzero(np.any(np.asarray(forces) != 0, -1))
        if len(pushed) == 0:
            return Effect("push", (), 0.0, 0.0, 0.0, 0.0, "", off=True)
        quiet = np.flatnonzero(~np.any(np.asarray(forces) != 0, -1))
        tracks = []
        for rows in (quiet, pushed):
            rows = np.resize(rows, self.count)
            state = self.step(dataclasses.replace(self.states, key=keys[rows]), self.actions[0])
            place = np.asarray(state.physics.qpos, float)[:, self.env.physics.object_qpos[:3]]
            tracks.append(place)
        moved = float(np.sqrt(np.mean((tracks[1] - tracks[0]) ** 2)))
        size = float(np.std(np.asarray(forces)[pushed]))
        return Effect("push", ("xfrc_applied",), size, 0.0, moved, 0.0, "")


def _width(span: float | tuple[float, float]) -> float:
    return span[1] - span[0] if isinstance(span, tuple) else span


def _changed(before: Any, after: Any) -> tuple[tuple[str, ...], float]:
    """Names of the leaves that differ, and the largest of their relative spreads."""
    names, spreads = [], [0.0]
    pairs = zip(jax.tree_util.tree_flatten_with_path(before)[0], jax.tree.leaves(after),
                strict=True)
    for (path, old), new in pairs:
        if not isinstance(old, (jax.Array, np.ndarray)) or not np.issubdtype(old.dtype, np.number):
            continue
        old, new = np.asarray(old, float), np.asarray(new, float)
        if np.array_equal(old, new):
            continue
        names.append(jax.tree_util.keystr(path).lstrip("."))
        size = np.sqrt(np.mean(new**2, 0))
        spreads.append(float(np.max(np.std(new - old, 0) / np.where(size > 0, size, 1.0))))
    return tuple(names), max(spreads)


def table(effects: Sequence[Effect]) -> str:
    """For people."""
    rows = [f"{'range':34}{'spread':>8}{'joints':>11}{'object':>10}{'reading':>9}  what changed"]
    for effect in effects:
        verdict = ("off: no width" if effect.off else ", ".join(effect.changed) or "nothing")
        if not effect.found:
            verdict = f"NO EFFECT ({verdict})"
        rows.append(f"{effect.name:34}{effect.spread:8.3f}{1e3 * effect.joint:8.3f} mrad"
                    f"{1e3 * effect.object:7.3f} mm{effect.reading:9.4f}  {verdict}")
    return "\n".join(rows)


def conclude(effects: Sequence[Effect]) -> int:
    """Print the table; the exit code."""
    print(table(effects))
    lost = [effect.name for effect in effects if not effect.found]
    if lost:
        print(f"error: no effect on model or motion: {', '.join(lost)}", file=sys.stderr)
    return 2 if lost else 0


@dataclasses.dataclass(frozen=True, kw_only=True)
class CheckArguments:
    """Show that every range of the randomisation has an effect."""

    task: str = setting("grasp")
    """Name of the task, with its default configuration."""
    backend: str = setting("auto", choices=("auto", "jax", "warp"))
    """Physics backend."""
    num_envs: int = setting(16, unit="1", low=2, high=65536)
    """Hands drawn for each range."""
    ticks: int = setting(12, unit="1", low=1, high=1000)
    """Control ticks that are compared."""
    seed: int = setting(0, low=0)
    """Of starts, draws and actions."""

    def __post_init__(self):
        validate(self)


def main(argv: Sequence[str] | None = None) -> int:
    """The command. Returns its exit code: 0, or 2 where a range has no effect."""
    import tyro

    import dexsim
    from dexsim.tasks import TASKS

    arguments = tyro.cli(CheckArguments, args=argv, prog="python -m dexsim.randomization_check",
                         description="Show that every range of the randomisation has an effect.")
    try:
        if arguments.task not in TASKS:
            raise DexsimError(f"no task {arguments.task!r}: choose from {', '.join(TASKS)}")
        config = dataclasses.replace(TASKS[arguments.task].config(), pool_size=80)
        env = dexsim.make(arguments.task, config, backend=arguments.backend,
                          num_envs=arguments.num_envs)
        keys = jax.random.split(jax.random.key(arguments.seed), arguments.num_envs)
        states = jax.jit(jax.vmap(env.reset))(keys)
        effects = check(env, jax.jit(jax.vmap(env.step)), states,
                        key=jax.random.key(arguments.seed + 1), ticks=arguments.ticks)
    except DexsimError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    print(f"{arguments.task} on {env.backend}, {arguments.num_envs} hands, {arguments.ticks} ticks")
    return conclude(effects)


if __name__ == "__main__":
    sys.exit(main())
