"""Warp's graph modes: speed of physics and of training, graphs captured, and bare mujoco_warp beside them (GPU).

    python benchmarks/warp_graphs.py --task rotate --num-envs 16384 --modes WARP WARP_STAGED WARP_STAGED_EX

One iteration of PPO is recorded, then its ticks are run again: by the library in each mode of MJX's CUDA graphs, and by
mujoco_warp alone with the same states, objects, contact parameters and torques, each sub-step launched kernel by kernel
and as one graph. One JSON line per measurement; `captures` counts graphs captured per call once all programs have run
twice.
"""

import argparse
import dataclasses
import functools
import json
import statistics
import time
from collections.abc import Callable, Iterator
from typing import Any

import jax
import numpy as np
from throughput import Recorder, make
from throughput_split import physics, record

from dexsim.core.cli import enable_caches
from dexsim.core.compilation import collector_paused, jit
from dexsim.env.env import Env
from dexsim.physics.parameters import places, values
from dexsim.physics.warp_backend import constraint_rows
from dexsim.registry import TASKS
from dexsim_ppo.learner.config import PPOConfig
from dexsim_ppo.learner.ppo import make_train
from dexsim_ppo.training.presets import find_preset

TICKS = 2  # that are run again: each is an environment's whole model, for every environment


class Captures:
    """Counts the graphs that Warp captures from now on."""

    def __init__(self) -> None:
        import warp as wp

        self.count, begin = 0, wp.ScopedCapture.__enter__

        def counted(capture: Any) -> Any:
            self.count += 1
            return begin(capture)

        wp.ScopedCapture.__enter__ = counted


def use_mode(mode: str) -> None:
    """Have every environment made from now on use a mode of graphs."""
    from mujoco import mjx
    from mujoco.mjx.warp import types

    original = getattr(mjx.put_model, "func", mjx.put_model)
    mjx.put_model = functools.partial(original, graph_mode=getattr(types.GraphMode, mode))


def timed(run: Callable[[], Any], captures: Captures, repeats: int, steps: int) -> dict:
    """Median time of a call of so many environment steps after two, and captures of each."""
    for _ in range(2):
        jax.block_until_ready(run())
    counts, times = [], []
    for _ in range(repeats):
        before, start = captures.count, time.perf_counter()
        with collector_paused():
            jax.block_until_ready(run())
        times.append(time.perf_counter() - start)
        counts.append(captures.count - before)
    median = statistics.median(times)
    return {"ms": round(1e3 * median, 3), "env_steps_per_s": round(steps / median), "captures": counts}


def bare(env: Env, ticks: Any, in_graph: bool) -> Callable[[], None]:
    """The recorded ticks [T, B] in mujoco_warp alone; `in_graph`: a sub-step is one CUDA graph."""
    import mujoco.mjx.third_party.mujoco_warp as mjw
    import warp as wp

    scene, engine = env.physics.scene, env.physics.engine
    objects, states, pushes, stiffnesses, deltas, tapes = ticks

    def parameters(object: Any, stiffness: jax.Array, delta: jax.Array) -> dict[str, jax.Array]:
        contacts = env.physics.contact_params(object, stiffness, delta)
        where, given = places(scene), values(scene, object, contacts)
        return {name: getattr(engine.model, name).at[where[name]].set(value) for name, value in given.items()}

    given = jax.tree.map(np.asarray, jax.jit(jax.vmap(jax.vmap(parameters)))(objects, stiffnesses, deltas))
    wrench = np.zeros((*pushes.shape[:2], scene.model.nbody, 6), np.float32)
    wrench[:, :, scene.object_body, :3] = pushes
    applied = np.zeros((*tapes.shape[:3], scene.model.nv), np.float32)
    applied[..., scene.joint_dof] = tapes
    size = engine._contact_buffer
    model = mjw.put_model(scene.model)
    model.opt.warn_overflow = False
    model.opt.graph_conditional = False  # as MJX's
    rows = constraint_rows(scene.config, scene.hand)
    data = mjw.make_data(scene.model, nworld=tapes.shape[1], naconmax=size, naccdmax=size, njmax=rows)
    for name, value in given.items():  # a row for each world
        setattr(model, name, wp.array(value[0], dtype=getattr(model, name).dtype))
    fill = [(getattr(model, name), value) for name, value in given.items()]
    fill += [(data.qpos, states.qpos), (data.qvel, states.qvel), (data.qacc_warmstart, states.warmstart)]
    fill += [(data.xfrc_applied, wrench)]
    inputs = [[(to, wp.array(np.asarray(x[tick]), dtype=to.dtype)) for to, x in fill] for tick in range(len(tapes))]
    torque = [[wp.array(x) for x in tick[: scene.config.substeps]] for tick in applied.swapaxes(1, 2)]

    def advance(tick: int, step: Callable[[], Any]) -> None:
        for to, source in inputs[tick]:
            wp.copy(to, source)
        for each in torque[tick]:
            wp.copy(data.qfrc_applied, each)
            step()

    sub_step = functools.partial(mjw.step, model, data)
    advance(0, sub_step)  # loads the kernels outside of the capture
    if in_graph:
        with wp.ScopedCapture() as capture:
            sub_step()
        sub_step = functools.partial(wp.capture_launch, capture.graph)

    def run() -> None:
        for tick in range(len(tapes)):
            advance(tick, sub_step)
        wp.synchronize()

    return run


def measure(task: str, config: PPOConfig, modes: list[str], per_calls: list[int], repeats: int) -> Iterator[dict]:
    """Rows: physics and training in each mode, mujoco_warp alone after the first mode's physics."""
    captures, steps = Captures(), config.steps_per_iteration
    physics_steps = config.num_envs * min(TICKS, config.rollout_length)
    ticks: Any = None
    for mode in modes:
        use_mode(mode)
        env = make(task, "full", "warp", config.num_envs)
        if ticks is None:
            ticks = recorded(env, Recorder(make(task, "full", "warp", config.num_envs)), config)
        run = functools.partial(jit(functools.partial(physics, env)), ticks)
        yield {"measure": "physics", "mode": mode} | timed(run, captures, repeats, physics_steps)
        if mode == modes[0]:
            for in_graph in (False, True) if jax.default_backend() == "gpu" else (False,):
                row = {"measure": "bare", "in_graph": in_graph}
                try:
                    yield row | timed(bare(env, ticks[:5], in_graph), captures, repeats, physics_steps)
                except RuntimeError as error:  # Warp's, where CUDA refuses the graph
                    yield row | {"failed": str(error).splitlines()[0]}
        for per_call in per_calls:
            training = make_train(env, dataclasses.replace(config, iterations_per_call=per_call))
            run = functools.partial(iterate, training.step, [training.init(jax.random.key(0))])
            row = timed(run, captures, repeats, steps * per_call)
            yield {"measure": "training", "mode": mode, "iterations_per_call": per_call} | row


def recorded(env: Env, recorder: Recorder, config: PPOConfig) -> Any:
    """The first `TICKS` ticks [T, B] of a rollout after six iterations."""
    training = make_train(env, config)
    state = training.init(jax.random.key(0))
    for _ in range(6):
        state, _ = training.step(state)
    ticks = jit(functools.partial(record, recorder, config))(state)[0]
    return jax.block_until_ready(jax.tree.map(lambda x: x[:TICKS], ticks))


def iterate(step: Callable, holder: list) -> Any:
    """A training step; the state stays in the holder, whose buffers the step takes over."""
    holder[0], metrics = step(holder[0])
    return metrics


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--task", default="rotate", choices=sorted(TASKS))
    parser.add_argument("--num-envs", type=int, default=16384)
    parser.add_argument("--modes", nargs="+", default=["WARP", "WARP_STAGED", "WARP_STAGED_EX"])
    parser.add_argument("--rollout-length", type=int, default=8)
    parser.add_argument("--iterations-per-call", nargs="*", type=int, default=[1], help="none: physics only")
    parser.add_argument("--repeats", type=int, default=7)
    options = parser.parse_args()
    enable_caches()
    preset = find_preset("gpu", options.task).ppo
    config = dataclasses.replace(preset, num_envs=options.num_envs, rollout_length=options.rollout_length)
    common = {"task": options.task, "num_envs": options.num_envs, "device": jax.devices()[0].device_kind}
    for row in measure(options.task, config, options.modes, options.iterations_per_call, options.repeats):
        print(json.dumps(row | common | {"jax": jax.__version__}), flush=True)


if __name__ == "__main__":
    main()
