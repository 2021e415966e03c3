"""Environment-steps a second by engine: the environment alone, or training with the learner.

    python benchmarks/throughput.py --task rotate --backends cuda mjx --num-envs 8192 32768
    python benchmarks/throughput.py --task grasp --train 6 --backends c mjx --json throughput.json
    python benchmarks/throughput.py --task rotate --train 10 --devices 1 2 4

One JSON line a row. Rows of one number of environments are measured in turn, so that whatever else the machine does
falls on all of them; figures are medians over the rounds. The environment alone is action to observation, restarts
included, under random actions. `--train ITERATIONS` is the device's preset without evaluation; on several devices
(`--devices`) each has as many environments as one alone, and `efficiency` is the speed of a device over that in the
first row. Compilation does not count.
"""

import argparse
import dataclasses
import json
import statistics
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax

import dexsim
from dexsim.core import cli
from dexsim.core.compilation import jit
from dexsim.physics.physics import BACKENDS
from dexsim.registry import TASKS
from dexsim_ppo.learner.config import PPOConfig
from dexsim_ppo.learner.ppo import make_train
from dexsim_ppo.learner.rollout import scan_restarting
from dexsim_ppo.learner.sharding import make_mesh
from dexsim_ppo.training.presets import device_preset, find_preset

SETTLING = 8  # iterations of training before the first measured one: objects settle, hands close

Case = tuple[dict[str, Any], Callable[[], Any], int]
"""(the row's facts, a call that is measured, environment-steps in it)"""


def environment(task: str, backend: str, num_envs: int, steps: int) -> Case:
    """The environment under random actions."""
    env = dexsim.make(task, backend=backend)

    def run(state: Any, key: jax.Array) -> Any:
        def body(state: Any, key: jax.Array) -> tuple[Any, None]:
            action = jax.random.uniform(key, (num_envs, env.action_size), minval=-1.0)
            state = jax.vmap(env.step)(state, action)
            return state, state.terminated | state.truncated, None

        return scan_restarting(jax.vmap(env.restart), body, state, jax.random.split(key, steps))[0]

    compiled, key = jit(run, backend=env.backend), jax.random.key(1)
    start = jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(0), num_envs))
    start = compiled(start, key)  # hands and objects have met
    return {"backend": env.backend, "num_envs": num_envs}, lambda: compiled(start, key), num_envs * steps


def training(task: str, backend: str, ppo: PPOConfig, devices: int, iterations: int) -> Case:
    """Iterations of training, with `ppo.num_envs` environments on each device."""
    env = dexsim.make(task, backend=backend)
    config = dataclasses.replace(ppo, num_envs=devices * ppo.num_envs, iterations_per_call=1)
    train = make_train(env, config, mesh=make_mesh(devices, config))
    state = train.init(jax.random.key(0))

    def run(count: int = iterations) -> Any:
        nonlocal state
        for _ in range(count):
            state, metrics = train.step(state)
        return metrics

    run(SETTLING)
    facts = {"backend": env.backend, "num_envs": config.num_envs, "devices": devices}
    return facts, run, iterations * config.steps_per_iteration


def measure(cases: Sequence[Case], repeats: int) -> list[dict[str, Any]]:
    """A row for each case."""
    times: list[list[float]] = [[] for _ in cases]
    for _ in range(1 + repeats):
        for (_, run, _), taken in zip(cases, times, strict=True):
            start = time.perf_counter()
            jax.block_until_ready(run())
            taken.append(time.perf_counter() - start)
    rows = []
    for (facts, _, steps), (_, *taken) in zip(cases, times, strict=True):  # the first round fills caches
        median = statistics.median(taken)
        speed = {"env_steps_per_s": round(steps / median), "spread": round((max(taken) - min(taken)) / median, 3)}
        rows.append(facts | speed)
    if "devices" in rows[0]:
        each = [row["env_steps_per_s"] / row["devices"] for row in rows]
        rows = [row | {"efficiency": round(own / each[0], 3)} for row, own in zip(rows, each, strict=True)]
    return rows


def main(argv: Sequence[str] | None = None) -> int:
    """The command. Returns its exit code."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--task", default="grasp", choices=sorted(TASKS))
    parser.add_argument("--backends", nargs="+", default=["auto"], choices=["auto", *BACKENDS])
    parser.add_argument("--num-envs", nargs="+", type=int, default=[], help="the preset's by default")
    parser.add_argument("--steps", type=int, default=16, help="of each environment in a measured call")
    parser.add_argument("--train", type=int, default=0, metavar="ITERATIONS", help="measure training instead")
    parser.add_argument("--devices", nargs="+", type=int, default=[1], metavar="N", help="with --train")
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--json", type=Path, help="file for all rows")
    options = parser.parse_args(argv)
    cli.enable_caches()
    ppo, rows = find_preset(device_preset(), options.task).ppo, []
    for num_envs in options.num_envs or [ppo.num_envs]:
        sized = dataclasses.replace(ppo, num_envs=num_envs)
        if options.train:
            chosen = [(backend, devices) for backend in options.backends for devices in options.devices]
            cases = [training(options.task, backend, sized, devices, options.train) for backend, devices in chosen]
        else:
            cases = [environment(options.task, backend, num_envs, options.steps) for backend in options.backends]
        for row in measure(cases, options.repeats):
            rows.append({"task": options.task, "measure": "training" if options.train else "environment"} | row)
            print(json.dumps(rows[-1]), flush=True)
    if options.json:
        cli.write_json(options.json, {"rows": rows} | cli.environment_report())
    return 0


if __name__ == "__main__":
    cli.run(main)
