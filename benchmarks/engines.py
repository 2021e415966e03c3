"""The engines side by side: motions against C MuJoCo in double precision.

    python benchmarks/engines.py --json motions.json

One JSON line a row, and tables at the end with a column for each engine that this machine can run: `c` on a CPU,
`cuda` on an NVIDIA GPU, `mjx` on both. What policies reach on an engine: `python -m dexsim_ppo.evaluate --backend`.

| motion | begins | gravity |
|---|---|---|
| grip | with fingers that hold the object still | out of the hand |
| slide | on the palm at 0.3 m/s, turned a little, without spin | onto the palm |
| roll | on the palm at 0.2 m/s, with the spin of rolling | onto the palm |
| drop | over the palm, between half-closed fingers | onto the palm |

Joints follow targets that do not change, and skin has one stiffness. The reference steps one model a row with
`mujoco.mj_step`, from the same numbers. "nudged" is the reference again, moved by 1 micrometre along each axis and
turned by some microradians: how far a motion itself spreads what rounding begins.
"""

import argparse
import contextlib
import copy
import dataclasses
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

import dexsim
from dexsim.core import cli
from dexsim.core.compilation import jit
from dexsim.core.pytree import pytree_dataclass
from dexsim.env.env import Env
from dexsim.errors import ConfigError
from dexsim.hand.kinematics import flexion_joints
from dexsim.objects.params import ObjectParams, extent
from dexsim.physics.interface import PhysicsState, StepResult, configured
from dexsim.physics.model import build_scene
from dexsim.physics.physics import BACKENDS, Physics, choose_backend
from dexsim.registry import TASKS
from dexsim.tasks.shared import palm_height

MOTIONS = ("grip", "slide", "roll", "drop")
STIFFNESS, DAMPING, REACH = 3.0, 0.1, 0.3  # Nm/rad, Nm s/rad, rad
TOUCHING = 0.01  # N
GAP = 1e-4  # m between palm and object: without one the first contact hangs on the last digit
NUDGE = 1e-6  # m, and of each part of the quaternion
CLOSING, TRIES = 100, 6  # sub-steps in which fingers close for a grip, and attempts with one object


@pytree_dataclass
class Begin:
    """Where motions begin, [B, ...] each."""

    object: ObjectParams
    state: PhysicsState
    target: jax.Array  # [J] rad, of the joints
    push: jax.Array  # [3] N on the object: what turns the scene's gravity into the motion's


Trace = tuple[np.ndarray, np.ndarray]
"""What motions were at the end of every control tick: place [T, B, 3] m of the object, and forces [T, B, F + 1, 3] N on
each finger at that moment, and on the object by the hand, mean of the tick."""


class Motions:
    """Motions of one task's objects.

    Args:
      task: its name.
      starts: of each motion and shape.
      seconds: that motions last.
    """

    def __init__(self, task: str, starts: int, seconds: float):
        shapes = len(TASKS[task].config().objects.shapes)
        config = dataclasses.replace(TASKS[task].config(), pool_size=max(2 * shapes * starts, 16))
        self.env: Env = dexsim.make(task, config)
        self.task, self.ticks = task, max(round(seconds / self.env.control_period), 1)
        self.exact = self.physics("auto")
        rules, physics = self.env.task, self.exact.config
        self.template = build_scene(self.env.hand, rules.slots, rules.largest, physics, rules.gravity, "c").model
        self.template.opt.iterations = 50
        pool, index = self.env.pool, np.asarray(self.env.pool.object.shape_index)
        names = {shape: rules.shape_names[shape] for shape in np.unique(index)}
        self.cases, begins = list[tuple[str, str]](), list[Begin]()
        for motion in MOTIONS:
            for shape in names:
                rows = np.flatnonzero(index == shape)
                for row in rows if motion == "grip" else rows[:starts]:
                    begin = self._begin(motion, jax.tree.map(lambda x, r=row: np.asarray(x)[r], pool))
                    if begin is not None and self.cases.count((motion, names[shape])) < starts:
                        self.cases.append((motion, names[shape]))
                        begins.append(begin)
        self.begin: Begin = jax.tree.map(lambda *rows: jnp.stack([jnp.asarray(x, x.dtype) for x in rows]), *begins)

    def physics(self, backend: str) -> Physics:
        """The scene on an engine."""
        task, config = self.env.task, self.env.config.physics
        return Physics(self.env.hand, task.slots, task.largest, config, gravity=task.gravity, backend=backend)

    def _begin(self, motion: str, start: Any) -> Begin | None:
        """A motion from a start state of the task; None for a grip that does not hold."""
        scene, hand = self.exact.scene, self.env.hand
        object = dataclasses.replace(start.object, com=np.zeros(3, np.float32))
        qpos, qvel = np.array(start.qpos, np.float64), np.zeros(scene.model.nv)
        target, place = qpos[scene.joint_qpos].copy(), scene.object_qpos[:3]
        gravity = np.array([9.81 if motion == "grip" else -9.81, 0.0, 0.0])
        push = np.float32(object.mass * (gravity - np.asarray(self.env.task.gravity)))
        if motion == "drop":
            qpos[place[0]] += 0.01
        if motion in ("slide", "roll"):
            target = np.clip(0.0, hand.joint_lower, hand.joint_upper)
            qpos[scene.joint_qpos] = target
            down = np.float32([-1.0, 0.0, 0.0])
            height = float(extent(object, down))
            # Where palms are half-spaces nothing else of the hand is near; boxes have the palm's middle.
            beside = (0.0, -0.5) if len(scene.slots) > 1 else (0.0, 0.085)
            # Boxes that are parallel to each other are a special case, whose contacts hang on the last digit.
            heading = 0.1 if motion == "slide" else 0.0
            qpos[scene.object_qpos] = palm_height(hand) + height + GAP, *beside, np.cos(heading), np.sin(heading), 0, 0
            speed = 0.3 if motion == "slide" else 0.2
            qvel[scene.object_dof] = 0, speed, 0, 0, 0, 0 if motion == "slide" else speed / height
        begin = Begin(object, PhysicsState(qpos, qvel, np.zeros(scene.model.nv)), target, push)
        if motion == "grip":
            tries = (self._closed(begin, np.random.default_rng(seed)) for seed in range(TRIES))
            begin = next((found for found in tries if found), None)
            if begin is None:
                return None
        single = jax.tree.map(np.float32, (begin.state, begin.target))
        return dataclasses.replace(begin, state=single[0], target=single[1])

    def _closed(self, begin: Begin, rng: np.random.Generator) -> Begin | None:
        """Fingers closed round the object, which weighs nothing until they are; None if they do not hold it."""
        hand, scene = self.env.hand, self.exact.scene
        free = -begin.object.mass * np.asarray(self.env.task.gravity)
        target = np.array(begin.target)
        for fingers, most in ((range(1), 0.5), (range(1, hand.num_fingers), 0.8)):
            joints = flexion_joints(hand, fingers)
            target[joints] += rng.uniform(0.3, most, len(joints))
        begin = dataclasses.replace(begin, target=np.clip(target, hand.joint_lower, hand.joint_upper))
        model = self.model(begin)
        data = self._run(dataclasses.replace(begin, push=free), model, CLOSING)
        data = self._run(begin, model, CLOSING // 2, data)
        touching = np.linalg.norm(data.sensordata.reshape(-1, 3), axis=-1) > 0.3
        if touching.sum() < 2 or np.linalg.norm(data.qvel[scene.object_dof[:3]]) > 0.03:
            return None
        state = PhysicsState(data.qpos.copy(), data.qvel.copy(), data.qacc_warmstart.copy())
        return dataclasses.replace(begin, state=state)

    # --- the reference --------------------------------------------------------------------------

    def model(self, begin: Begin) -> mujoco.MjModel:
        """C MuJoCo's model of one row."""
        scene, model = self.exact.scene, copy.copy(self.template)
        model.opt.tolerance = 1e-12
        # The compiler lets C MuJoCo skip offsets that are zero in the template. Objects bring others.
        model.geom_sameframe[scene.object_geoms] = mujoco.mjtSameFrame.mjSAMEFRAME_NONE
        model.body_sameframe[scene.object_body] = mujoco.mjtSameFrame.mjSAMEFRAME_NONE
        for name, values in configured(scene, self.exact.fields(begin.object)).items():
            getattr(model, name)[:] = values
        model.body_subtreemass[scene.object_body] = begin.object.mass
        return model

    def _run(self, begin: Begin, model: mujoco.MjModel, count: int, data: mujoco.MjData | None = None):
        """`count` sub-steps of C MuJoCo."""
        scene = self.exact.scene
        if data is None:
            data = mujoco.MjData(model)
            data.qpos[:], data.qvel[:] = begin.state.qpos, begin.state.qvel
            data.qacc_warmstart[:] = begin.state.warmstart
        data.xfrc_applied[scene.object_body, :3] = begin.push
        limit, armature = self.env.hand.torque_limit, self.template.dof_armature[scene.joint_dof]
        for _ in range(count):
            position, velocity = data.qpos[scene.joint_qpos], data.qvel[scene.joint_dof]
            reach = np.clip(begin.target - position, -REACH, REACH)
            torque = STIFFNESS * reach - DAMPING * velocity
            data.qfrc_applied[scene.joint_dof] = np.clip(torque, -limit, limit)
            # As `dexsim.physics.law.implicit`: half of a step's damping is an inertia, of a motor below its limit.
            slope = np.where(np.abs(torque) < limit, DAMPING, 0.0)
            model.dof_armature[scene.joint_dof] = armature + 0.5 * model.opt.timestep * slope
            mujoco.mj_step(model, data)
        return data

    def reference(self, nudge: float = 0.0) -> Trace:
        """All motions by `mujoco` alone."""
        traces = []
        for row in range(len(self.cases)):
            begin = jax.tree.map(lambda x, r=row: np.asarray(x)[r], self.begin)
            qpos = np.array(begin.state.qpos, np.float64)
            qpos[self.exact.object_qpos] += nudge
            begin = dataclasses.replace(begin, state=dataclasses.replace(begin.state, qpos=qpos))
            model, data, ticks = self.model(begin), None, []
            for _ in range(self.ticks):
                data = self._run(begin, model, self.env.config.physics.substeps, data)
                ticks.append((data.qpos.copy(), data.qvel.copy(), -data.sensordata.reshape(-1, 3)))
            traces.append([np.stack(x) for x in zip(*ticks, strict=True)])
        return self._trace(*(np.stack(x, 1) for x in zip(*traces, strict=True)))

    # --- the engines ----------------------------------------------------------------------------

    def run(self, backend: str) -> Trace:
        """All motions on an engine."""
        physics, limit = self.physics(backend), jnp.asarray(self.env.hand.torque_limit)

        def tick(begin: Begin) -> StepResult:
            def motors(substep: jax.Array, position: jax.Array, velocity: jax.Array) -> jax.Array:
                reach = jnp.clip(begin.target - position, -REACH, REACH)
                return jnp.clip(STIFFNESS * reach - DAMPING * velocity, -limit, limit)

            return physics.advance(motors, physics.fields(begin.object), begin.state, begin.push)

        def all_ticks(begin: Begin):
            def body(state: PhysicsState, _: None):
                after, force = jax.vmap(tick)(dataclasses.replace(begin, state=state))
                return after, (after.qpos, after.qvel, force)

            return jax.lax.scan(body, begin.state, length=self.ticks)[1]

        found = jit(all_ticks, backend=backend)(self.begin)
        return self._trace(*(np.asarray(x, np.float64) for x in found))

    def _trace(self, qpos: np.ndarray, qvel: np.ndarray, finger_force: np.ndarray) -> Trace:
        physics, begin = self.exact, self.begin
        velocity = np.concatenate([np.asarray(begin.state.qvel)[None], qvel])[..., physics.object_dof[:3]]
        acceleration = np.diff(velocity, axis=0) / self.env.control_period - np.asarray(self.env.task.gravity)
        on_object = np.asarray(begin.object.mass)[:, None] * acceleration - np.asarray(begin.push)
        return qpos[..., physics.object_qpos[:3]], np.concatenate([finger_force, on_object[:, :, None]], 2)

    def compare(self, found: Trace, wanted: Trace) -> list[dict[str, Any]]:
        """A row for each motion and shape: how far an engine's motions are from others."""
        place, force = (np.linalg.norm(x - y, axis=-1) for x, y in zip(found, wanted, strict=True))
        found_strength, strength = (np.linalg.norm(trace[1], axis=-1) for trace in (found, wanted))
        touching, rows = np.maximum(strength, found_strength) > TOUCHING, []
        for motion, shape in dict.fromkeys(self.cases):
            mine = [case == (motion, shape) for case in self.cases]
            row: dict[str, Any] = {"task": self.task, "motion": motion, "shape": shape, "n": sum(mine)}
            touched = touching[:, mine]
            row["force_n"] = float(strength[:, mine][touched].mean())
            for name, values in (("place_mm", 1e3 * place[:, mine]), ("force_error_n", force[:, mine][touched])):
                row |= {f"{name}_p95": float(np.percentile(values, 95)), f"{name}_max": float(values.max())}
            rows.append(row)
        return rows


def table(rows: list[dict[str, Any]], title: str, name: str) -> str:
    """Markdown with a line a motion and a column an engine: 95th percentile and maximum of a measure."""
    cells: dict[str, dict[str, str]] = {}
    for row in rows:
        line = cells.setdefault(f"{row['task']}: {row['motion']}, {row['shape']}", {})
        line[row["backend"]] = f"{row[name + '_p95']:.2g} / {row[name + '_max']:.2g}"
    engines = next(iter(cells.values())).keys()
    lines = [[f"{title}: 95 % / largest", *engines], ["---"] * (1 + len(engines))]
    lines += [[motion, *line.values()] for motion, line in cells.items()]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines) + "\n"


def usable() -> list[str]:
    """The engines that run on this machine and device."""
    names = []
    for name in BACKENDS:
        with contextlib.suppress(ConfigError):
            names.append(choose_backend(name))
    return names


def main(argv: Sequence[str] | None = None) -> int:
    """The command. Returns its exit code."""
    parser, engines, rows = argparse.ArgumentParser(description=__doc__.splitlines()[0]), usable(), []
    parser.add_argument("--tasks", nargs="+", default=["grasp", "rotate"])
    parser.add_argument("--starts", type=int, default=4, help="of each motion and shape")
    parser.add_argument("--seconds", type=float, default=0.6)
    parser.add_argument("--backends", nargs="+", default=engines, choices=engines)
    parser.add_argument("--json", type=Path, help="file for all rows")
    options = parser.parse_args(argv)
    cli.enable_caches()
    for task in options.tasks:
        bench = Motions(task, options.starts, options.seconds)
        reference = bench.reference()
        for engine in ("nudged", *options.backends):
            found = bench.reference(NUDGE) if engine == "nudged" else bench.run(engine)
            for row in bench.compare(found, reference):
                rows.append({"backend": engine} | row)
                print(json.dumps(rows[-1]), flush=True)
    print(table(rows, "object's place, mm", "place_mm"), table(rows, "forces, N", "force_error_n"), sep="\n")
    if options.json:
        cli.write_json(options.json, {"rows": rows} | cli.environment_report())
    return 0


if __name__ == "__main__":
    cli.run(main)
