"""Weak scaling of training over devices and processes, and what an iteration communicates: one JSON line each.

    python benchmarks/devices.py --task rotate --devices 1 2 4 8    # devices of this process
    python benchmarks/devices.py --task grasp --processes 2         # two processes, cores and GPUs shared out

`--devices` measures training with so many devices in turn, the same environments on each. `--processes` measures so
many processes that train together, all their devices in one mesh, and beside it as many that train alone at the same
time: what machines share (memory, clock) falls on both. `efficiency` is a device's speed over that in the first row.

`received_bytes` is what each device receives in an iteration, from the compiled program: its collectives times the
trips of the loops around them, for ring algorithms.
"""

import argparse
import dataclasses
import json
import statistics
import sys
import time
from pathlib import Path
from typing import Any

import jax

import dexsim
from dexsim.core.cli import enable_caches
from dexsim.core.compilation import collector_paused
from dexsim.registry import TASKS
from dexsim_ppo.learner.ppo import make_train
from dexsim_ppo.learner.sharding import make_mesh
from dexsim_ppo.training import processes
from dexsim_ppo.training.presets import find_preset


def measure(options: argparse.Namespace, devices: int) -> dict[str, Any]:
    """Speed of training on the first devices, learner included and compilation excluded."""
    from collectives import received

    ppo = find_preset("gpu" if jax.default_backend() == "gpu" else "cpu", options.task).ppo
    each = options.num_envs or ppo.num_envs
    config = dataclasses.replace(ppo, num_envs=each * devices, iterations_per_call=options.iterations)
    if options.rollout_length:
        config = dataclasses.replace(config, rollout_length=options.rollout_length)
    env = dexsim.make(options.task, backend=options.backend, num_envs=each)
    mesh, begin = make_mesh(devices, config), time.perf_counter()
    training = make_train(env, config, mesh=mesh)
    state, shapes = training.init(jax.random.key(0)), training.shapes(jax.random.key(0))
    step = training.step.lower(shapes).compile()
    compiled, times = time.perf_counter() - begin, []
    for _ in range(options.warmup + options.repeats):
        with collector_paused():
            start = time.perf_counter()
            state, metrics = step(state)
            jax.block_until_ready(metrics)
            times.append(time.perf_counter() - start)
    seconds = statistics.median(times[options.warmup :])
    bytes_, counts = received(step.as_text())
    return {
        "devices": devices,
        "processes": jax.process_count(),
        "backend": env.backend,
        "num_envs_per_device": each,
        "env_steps_per_s": round(options.iterations * config.steps_per_iteration / seconds),
        "iteration_ms": round(1e3 * seconds / options.iterations, 2),
        "spread": round((max(times[options.warmup :]) - min(times[options.warmup :])) / seconds, 4),
        "received_bytes": round(bytes_ / options.iterations),
        "collectives": {name: round(count / options.iterations, 1) for name, count in counts.items()},
        "compile_s": round(compiled, 1),
        "first_call_s": round(times[0], 1),
        "reward": round(float(metrics["reward"][-1]), 4),
    }


def run_processes(argv: list[str], number: int, joined: bool) -> dict[str, Any]:
    """One row of processes that train together, or of as many that train alone at the same time."""
    import subprocess

    from launch import start

    command = [sys.executable, __file__, *argv, "--worker"]
    running = start(command, number, joined=joined, stdout=subprocess.PIPE, text=True)
    said = [process.communicate()[0] for process in running]
    if any(process.returncode for process in running):
        raise SystemExit(f"error: exit codes {[process.returncode for process in running]}")
    rows = [json.loads(text.splitlines()[-1]) for text in said]
    if joined:
        return rows[0] | {"together": True}
    total = {name: sum(row[name] for row in rows) for name in ("devices", "env_steps_per_s")}
    return rows[0] | total | {"processes": number, "together": False}


def parse(argv: list[str]) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--task", default="rotate", choices=sorted(TASKS))
    parser.add_argument("--backend", default="auto", choices=["auto", "jax", "warp", "c"])
    parser.add_argument("--devices", nargs="+", type=int, default=[1], metavar="N")
    parser.add_argument("--processes", type=int, default=1, metavar="N")
    parser.add_argument("--num-envs", type=int, default=0, help="environments on a device; 0 for the preset's")
    parser.add_argument("--rollout-length", type=int, default=0, help="0 for the preset's")
    parser.add_argument("--iterations", type=int, default=1, help="in one compiled call")
    parser.add_argument("--warmup", type=int, default=8, help="calls before the clock starts")
    parser.add_argument("--repeats", type=int, default=10)
    parser.add_argument("--output", type=Path, help="JSON file of all rows")
    parser.add_argument("--worker", action="store_true", help=argparse.SUPPRESS)
    return parser.parse_args(argv)


def main(argv: list[str]) -> None:
    options, rows = parse(argv), []
    if options.worker:
        processes.connect()
        with processes.leaving_at_once():
            enable_caches()
            return print(json.dumps(measure(options, jax.device_count())), flush=True)
    enable_caches()
    several = options.processes > 1
    for case in (False, True) if several else options.devices:
        row = run_processes(argv, options.processes, case) if several else measure(options, case)
        rows.append({"measure": "devices", "task": options.task} | row)
        speeds = [each["env_steps_per_s"] / each["devices"] for each in rows]
        rows[-1] |= {"env_steps_per_s_per_device": round(speeds[-1]), "efficiency": round(speeds[-1] / speeds[0], 4)}
        print(json.dumps(rows[-1]), flush=True)
    if options.output:
        about = {"command": ["python", "benchmarks/devices.py", *argv], "jax": jax.__version__}
        about |= {} if several else {"device": jax.devices()[0].device_kind}
        options.output.write_text(json.dumps(about | {"rows": rows}, indent=1))


if __name__ == "__main__":
    main(sys.argv[1:])
