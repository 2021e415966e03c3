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
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
from collectives import received
from launch import start
from throughput import preset

import dexsim
from dexsim.core.cli import enable_caches
from dexsim.core.compilation import collector_paused
from dexsim.registry import find_task
from dexsim_ppo.learner.adapter import adapt
from dexsim_ppo.learner.ppo import make_train
from dexsim_ppo.learner.sharding import make_mesh
from dexsim_ppo.training import processes


class Case:
    """A training, compiled and ready to be timed.

    Args:
      options: of the command.
      devices: how many of this process's, or of all processes together.
    """

    def __init__(self, options: argparse.Namespace, devices: int):
        ppo = preset(options.task).ppo
        each = options.num_envs or ppo.num_envs
        self.config = dataclasses.replace(ppo, num_envs=each * devices, iterations_per_call=options.iterations)
        if options.rollout_length:
            self.config = dataclasses.replace(self.config, rollout_length=options.rollout_length)
        env = adapt(dexsim.make(options.task, backend=options.backend, num_envs=each), options.task)
        begin, self.times = time.perf_counter(), list[float]()
        training = make_train(env, self.config, mesh=make_mesh(devices, self.config))
        self.state = training.init(jax.random.key(0))
        self.step = training.step.lower(training.shapes(jax.random.key(0))).compile()
        bytes_, counts = received(self.step.as_text())
        self.row = {
            "devices": devices,
            "processes": jax.process_count(),
            "backend": env.backend,
            "num_envs_per_device": each,
            "compile_s": round(time.perf_counter() - begin, 1),
            "received_bytes": round(bytes_ / options.iterations),
            "collectives": {name: round(count / options.iterations, 1) for name, count in counts.items()},
        }

    def run(self) -> None:
        """One call."""
        with collector_paused():
            start = time.perf_counter()
            self.state, metrics = self.step(self.state)
            jax.block_until_ready(metrics)
            self.times.append(time.perf_counter() - start)
        self.reward = float(metrics["reward"].mean())


def measure(options: argparse.Namespace, *cases: Case) -> list[dict[str, Any]]:
    """A row for each case; they are run in turn, so that what else the machine does falls on all of them."""
    for _ in range(options.warmup + options.repeats):
        for case in cases:
            case.run()
    rows = []
    for case in cases:
        times = case.times[options.warmup :]
        seconds = statistics.median(times)
        speed = options.iterations * case.config.steps_per_iteration / seconds
        rows.append(
            case.row
            | {
                "env_steps_per_s": round(speed),
                "iteration_ms": round(1e3 * seconds / options.iterations, 2),
                "spread": round((max(times) - min(times)) / seconds, 4),
                "first_call_s": round(case.times[0], 1),
                "reward": round(case.reward, 4),
            }
        )
    return rows


def run_processes(argv: list[str], number: int, joined: bool) -> dict[str, Any]:
    """One row of processes that train together, or of as many that train alone at the same time."""
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
    parser.add_argument("--task", default="rotate", help="as in training")
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


def rows(options: argparse.Namespace, argv: list[str]) -> Iterator[dict[str, Any]]:
    """What is measured, one after another."""
    if options.processes > 1:
        for together in (False, True):
            yield run_processes(argv, options.processes, together)
    else:
        for devices in options.devices:
            yield from measure(options, Case(options, devices))


def main(argv: list[str]) -> None:
    options, found = parse(argv), list[dict[str, Any]]()
    find_task(options.task)
    options.task = options.task.rpartition(":")[2]
    if options.worker:
        processes.connect()
        with processes.exit_on_error():
            enable_caches()
            return print(json.dumps(measure(options, Case(options, jax.device_count()))[0]), flush=True)
    enable_caches()
    for row in rows(options, argv):
        found.append({"measure": "devices", "task": options.task} | row)
        speeds = [each["env_steps_per_s"] / each["devices"] for each in found]
        found[-1] |= {"env_steps_per_s_per_device": round(speeds[-1]), "efficiency": round(speeds[-1] / speeds[0], 4)}
        print(json.dumps(found[-1]), flush=True)
    if options.output:
        about = {"command": ["python", "benchmarks/devices.py", *argv], "jax": jax.__version__}
        # The processes have the devices; asking for them here would take their memory.
        about |= {} if options.processes > 1 else {"device": jax.devices()[0].device_kind}
        options.output.write_text(json.dumps(about | {"rows": found}, indent=1))


if __name__ == "__main__":
    main(sys.argv[1:])
