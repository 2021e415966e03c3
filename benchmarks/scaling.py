"""The `c` backend with more cores and more environments: JSON lines.

    python benchmarks/scaling.py cores --cores 1 2      # speed by cores, and what it says of more
    python benchmarks/scaling.py memory                 # memory per 1,000 environments

`cores` runs `host_physics.py` and `throughput.py --train` in turn, each process bound to so many cores, and fits
t(n) = serial + parallel / n microseconds an env-step through the medians. The predictions for more cores know nothing
of memory bandwidth, clocks that fall with load, or a second socket: they are upper bounds.

`memory` steps environments with random actions. `rss_mb` is what the process grows by at most, compiled programs left
out; `engine_mb` is the host engine's share of it, its models and their arrays.
"""

import argparse
import json
import os
import statistics
import subprocess
import sys
from pathlib import Path

FOLDER = Path(__file__).parent
PREDICTED = (4, 8, 16, 32, 64)


def rates(task: str, cores: int, quick: bool) -> dict[str, float]:
    """Microseconds an env-step of a physics tick and of training, on the first cores that this process may use."""
    chosen = sorted(os.sched_getaffinity(0))[:cores]
    physics = ["--repeats", "2", "--ticks", "4", "--num-envs", "8"] if quick else []
    training = ["--train", "1", "--repeats", "1", "--num-envs", "8"] if quick else ["--train", "6", "--repeats", "3"]

    def lines(name: str, options: list[str]) -> list[dict]:
        command = [sys.executable, str(FOLDER / name), "--task", task, *options]
        bound = subprocess.run(
            command, capture_output=True, text=True, preexec_fn=lambda: os.sched_setaffinity(0, chosen)
        )
        if bound.returncode:
            raise SystemExit(f"{' '.join(command)}\n{bound.stderr}")
        return [json.loads(line) for line in bound.stdout.splitlines() if line.startswith("{")]

    tick = next(row for row in lines("host_physics.py", physics) if row["way"] == "tick in one call")
    train = lines("throughput.py", [*training, "--backends", "c"])[0]
    assert tick["threads"] == len(chosen), f"{tick['threads']} threads on {len(chosen)} cores"
    return {"tick": 1e6 / tick["env_ticks_per_s"], "training": 1e6 / train["env_steps_per_s"]}


def fit(times: dict[int, float]) -> tuple[float, float]:
    """Serial and parallel part, by least squares over t(n) = serial + parallel / n; neither is negative."""
    x, y = [1 / n for n in times], list(times.values())
    mean_x, mean_y = statistics.mean(x), statistics.mean(y)
    spread = sum((a - mean_x) ** 2 for a in x)
    parallel = sum((a - mean_x) * (b - mean_y) for a, b in zip(x, y, strict=True)) / spread
    parallel = min(max(parallel, 0.0), mean_y / mean_x)
    return mean_y - parallel * mean_x, parallel


def run_cores(options: argparse.Namespace) -> None:
    """The command `cores`."""
    found: dict[str, dict[int, list[float]]] = {}
    for _ in range(options.rounds):
        for cores in options.cores:
            for part, time in rates(options.task, cores, options.quick).items():
                found.setdefault(part, {}).setdefault(cores, []).append(time)
    for part, by_cores in found.items():
        times = {cores: statistics.median(values) for cores, values in by_cores.items()}
        for cores, time in times.items():
            show({"part": part, "task": options.task, "cores": cores, "us": time, "env_steps_per_s": 1e6 / time})
        if len(times) > 1:
            serial, parallel = fit(times)
            row = {"part": part, "task": options.task, "serial_us": serial, "parallel_us": parallel}
            show(row | {f"env_steps_per_s_{n}_cores": 1e6 / (serial + parallel / n) for n in PREDICTED})


def run_memory(options: argparse.Namespace) -> None:
    """The command `memory`."""
    import jax
    import mujoco

    import dexsim
    from dexsim.core.cli import enable_caches
    from dexsim.core.compilation import jit

    enable_caches()
    for count in options.num_envs:
        env = dexsim.make(options.task, backend="c", num_envs=count)
        keys = jax.random.split(jax.random.key(0), count)
        reset = jit(jax.vmap(env.reset), backend="c").lower(keys).compile()
        shape = jax.eval_shape(jax.vmap(env.reset), keys)
        actions = jax.random.uniform(keys[0], (count, env.action_size), minval=-1.0)
        step = jit(jax.vmap(env.step), backend="c", donate_argnums=0).lower(shape, actions).compile()
        before = peak(fresh=True)
        state = reset(keys)
        for _ in range(3):
            state = jax.block_until_ready(step(state, actions))
        rows = env.physics.engine._engine._batch(count)
        arrays = [
            *rows.states,
            rows.applied,
            rows.warmstart,
            rows.sensors,
            *rows._given.values(),
            *rows._whole.values(),
        ]
        engine = count * mujoco.mj_sizeModel(env.physics.mj_model) + sum(x.nbytes for x in arrays)
        grown, engine = (peak() - before) / 1e6, engine / 1e6
        show(
            {"task": options.task, "num_envs": count, "rss_mb": grown, "engine_mb": engine}
            | {"rss_mb_per_1000": 1e3 * grown / count, "engine_mb_per_1000": 1e3 * engine / count}
        )


def peak(fresh: bool = False) -> int:
    """Bytes that this process held at most since the last `fresh` call, which begins at what it holds now (Linux)."""
    if fresh:
        Path("/proc/self/clear_refs").write_text("5")
    lines = Path("/proc/self/status").read_text().splitlines()
    return 1024 * int(next(line.split()[1] for line in lines if line.startswith("VmHWM")))


def show(row: dict) -> None:
    """A JSON line."""
    print(json.dumps({key: round(x, 2) if isinstance(x, float) else x for key, x in row.items()}), flush=True)


def main(argv: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    commands = parser.add_subparsers(required=True)
    command = commands.add_parser("cores")
    command.set_defaults(run=run_cores)
    command.add_argument("--task", default="grasp")
    command.add_argument("--cores", type=int, nargs="+", default=[1, 2])
    command.add_argument("--rounds", type=int, default=3)
    command.add_argument("--quick", action="store_true", help="8 environments, to see that it works")
    command = commands.add_parser("memory")
    command.set_defaults(run=run_memory)
    command.add_argument("--task", default="grasp")
    command.add_argument("--num-envs", type=int, nargs="+", default=[256, 1024, 4096])
    options = parser.parse_args(argv)
    options.run(options)


if __name__ == "__main__":
    main()
