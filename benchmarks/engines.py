"""The engines side by side: JSON lines, and a table at the end.

    python benchmarks/engines.py grips          # one sub-step of the shipped policy's grips against C MuJoCo; speed
    python benchmarks/engines.py motions        # grips, slides, rolling, drops of each shape against C MuJoCo in fp64
    python benchmarks/engines.py policies       # what the shipped policies reach on each engine

`grips`: the shipped grasp policy holds objects on the `c` backend. From its states each engine takes one sub-step, the
solver converged: the `jax` backend with its own contacts and solver (closed), the same with MJX's step (mjx), and `c`.
What is left are contact points and rounding. `n` counts fingers that touch, and differences are those of their force
vectors. Speeds are of a control tick of physics with the default iterations, measured in turn.

`motions` (see `engine_motions`) and `policies` measure every engine with the solver iterations of training, and with 50
of 50 line-search steps (converged). Warp runs on one CPU thread here.
"""

import argparse
import dataclasses
import functools
import json
import statistics
import time

import engine_motions
import engine_policies
import jax
import jax.numpy as jnp
import numpy as np
from throughput import seconds

from dexsim.core.cli import enable_caches
from dexsim.core.compilation import jit
from dexsim.env.env import Env
from dexsim.env.motors import JointCommand
from dexsim.env.state import State
from dexsim.objects.config import SHAPES
from dexsim.physics.physics import BACKENDS, Physics
from dexsim_ppo import Policy, load_policy

WAYS = {"closed": ("jax", "closed"), "mjx": ("jax", "mjx"), "c": ("c", "closed")}
TOUCHING = 0.01  # N


def grips(env: Env, policy: Policy, count: int, ticks: list[int]) -> State:
    """States [count times len(ticks)] of grips that are as old as `ticks`."""
    state = jit(jax.vmap(env.reset), backend="c")(jax.random.split(jax.random.key(0), count))
    step, carry, found = jit(jax.vmap(env.step), backend="c"), policy.initial_carry(count), []
    for tick in range(max(ticks)):
        carry, action = policy.act(carry, state.obs["actor"])
        state = step(state, action)
        if tick + 1 in ticks:
            found.append(state)
    return jax.tree.map(lambda *parts: jnp.concatenate(parts), *found)


def physics_tick(env: Env, way: str, **changes):
    """`tick(state)`: the state and the force [B, F, 3] N on the fingers after a tick of an engine, joints held."""
    backend, contacts = WAYS[way]
    config, task = dataclasses.replace(env.config.physics, contacts=contacts, **changes), env.task
    physics = Physics(
        env.hand, task.slots, task.largest, config, gravity=task.gravity, backend=backend, skin=env.config.skin
    )

    def one(s: State):
        target, valid = s.joint_target, jnp.ones((), bool)
        law = env.motors.law(
            s.episode.hand, JointCommand(action=0 * target, target=target, previous=target, valid=valid)
        )
        return physics.advance_motors(s.episode.object, s.physics, law, s.gear, jnp.zeros(3), s.episode.hand.cover)[:2]

    return jit(jax.vmap(one), backend=backend)


def forces(env: Env, state: State, way: str) -> np.ndarray:
    """Force [B, F, 3] N on the fingers after one sub-step of an engine, converged."""
    return np.asarray(physics_tick(env, way, substeps=1, iterations=50, line_search=50)(state)[1])


def speeds(env: Env, state: State, ways: list[str], repeats: int) -> dict[str, dict[str, float]]:
    """By engine: control ticks a second, their spread, and seconds to the first result."""
    ticks, times, first = {}, {way: [] for way in ways}, {}
    for way in ways:
        start = time.perf_counter()
        ticks[way] = physics_tick(env, way)
        jax.block_until_ready(ticks[way](state))
        first[way] = time.perf_counter() - start
    for _ in range(repeats):
        for way, tick in ticks.items():
            times[way].append(seconds(tick, state)[0])
    count = len(state.tick)
    return {
        way: {
            "ticks_per_s": round(count / statistics.median(taken)),
            "slowest_over_fastest": round(max(taken) / min(taken), 2),
            "first_s": round(first[way], 1),
        }
        for way, taken in times.items()
    }


def compare(found: np.ndarray, wanted: np.ndarray) -> dict[str, float]:
    """How far the forces [B, F, 3] N of fingers that touch by either are apart, and how strong they are."""
    strength = np.linalg.norm(wanted, axis=-1)
    touching = np.maximum(strength, np.linalg.norm(found, axis=-1)) > TOUCHING
    apart = np.linalg.norm(found - wanted, axis=-1)[touching]
    middle, most = np.percentile(apart, [50, 95])
    return {
        "n": int(touching.sum()),
        "force_n": float(strength[touching].mean()),
        "median_n": float(middle),
        "p95_n": float(most),
        "max_n": float(apart.max()),
    }


def run_grips(options: argparse.Namespace) -> None:
    """The command `grips`."""
    policy = load_policy("grasp")
    env = policy.make_env(num_envs=options.num_envs, backend="c")
    state = grips(env, policy, options.num_envs, options.ticks)
    shape, wanted = np.asarray(state.episode.object.shape_index), forces(env, state, "c")
    for way in options.ways:
        found = forces(env, state, way)
        for index, name in enumerate(SHAPES):
            show({"way": way, "shape": name} | compare(found[shape == index], wanted[shape == index]))
    if options.repeats:
        for way, row in speeds(env, state, [*options.ways, "c"], options.repeats).items():
            show({"way": way, "environments": len(shape)} | row)


def run_motions(options: argparse.Namespace) -> None:
    """The command `motions`."""
    rows = []
    for task in options.tasks:
        bench = engine_motions.Bench(task, options.starts, options.seconds)
        wanted = bench.reference()
        found = {("nudged", True): lambda bench=bench: bench.reference(engine_motions.NUDGE)}
        for backend in options.backends:
            for converged in (False, True):
                changes = engine_motions.CONVERGED if converged else {}
                found[backend, converged] = functools.partial(bench.run, backend, changes)
        for (engine, converged), run in found.items():
            for row in bench.compare(run(), wanted):
                rows.append({"engine": engine, "converged": converged} | row)
                show(rows[-1])
    for title, name in (("object's place, mm", "place_mm"), ("forces, N", "force_error_n")):
        cells = [
            (f"{r['motion']}, {r['shape']}", way(r), f"{r[name + '_p95']:.2g} / {r[name + '_max']:.2g}") for r in rows
        ]
        print(table(f"{title}: 95 % / largest", cells))


def run_policies(options: argparse.Namespace) -> None:
    """The command `policies`."""
    cells = []
    for name in options.policies:
        for backend in options.backends:
            for converged in (False, True):
                row = engine_policies.measure(name, backend, converged, options.episodes, options.seconds)
                show(row)
                for key in ("held", "r", "successes_per_minute", "kept"):
                    if key in row:
                        low, high = row[f"{key}_ci95"]
                        text = "" if row[key] is None else f"{row[key]:.3g} ({low:.3g}–{high:.3g})"
                        cells.append((f"{name}, {key}", way(row), text))
    print(table("policy", cells))


def way(row: dict) -> str:
    """An engine and its iterations, as a column's title."""
    return row.get("engine", row.get("backend")) + (", converged" if row["converged"] else "")


def show(row: dict) -> None:
    """A JSON line."""
    rounded = {key: round(value, 5) if isinstance(value, float) else value for key, value in row.items()}
    print(json.dumps(rounded), flush=True)


def table(title: str, cells: list[tuple[str, str, str]]) -> str:
    """Markdown of (row, column, text)."""
    rows, columns = (list(dict.fromkeys(x)) for x in list(zip(*cells, strict=True))[:2])
    found = {(row, column): text for row, column, text in cells}
    lines = [[title, *columns], ["---"] * (1 + len(columns))]
    lines += [[row, *(found.get((row, column), "") for column in columns)] for row in rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines) + "\n"


def main(argv: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    commands = parser.add_subparsers(required=True)
    command = commands.add_parser("grips")
    command.set_defaults(run=run_grips)
    command.add_argument("--num-envs", type=int, default=200)
    command.add_argument("--ticks", type=int, nargs="+", default=[20, 40, 80], help="age of the grips")
    command.add_argument("--repeats", type=int, default=7, help="of the timing; 0 leaves it out")
    command.add_argument("--ways", nargs="+", default=["closed", "mjx"], choices=list(WAYS))
    command = commands.add_parser("motions")
    command.set_defaults(run=run_motions)
    command.add_argument("--tasks", nargs="+", default=["grasp", "rotate"])
    command.add_argument("--starts", type=int, default=4, help="of each motion and shape")
    command.add_argument("--seconds", type=float, default=0.6)
    command.add_argument("--backends", nargs="+", default=list(BACKENDS), choices=list(BACKENDS))
    command = commands.add_parser("policies")
    command.set_defaults(run=run_policies)
    command.add_argument("--policies", nargs="+", default=["grasp", "rotate"])
    command.add_argument("--episodes", type=int, default=64)
    command.add_argument("--seconds", type=float, default=0.0, help="length of an episode; 0 for the task's own")
    command.add_argument("--backends", nargs="+", default=list(BACKENDS), choices=list(BACKENDS))
    options = parser.parse_args(argv)
    enable_caches()
    options.run(options)


if __name__ == "__main__":
    main()
