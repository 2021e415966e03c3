"""Each engine on the same grips: forces of a sub-step against C MuJoCo, a JSON line a shape, and speed.

    python benchmarks/engines.py

The shipped grasp policy holds objects on the `c` backend. From its states each engine takes one sub-step, the solver
converged: the `jax` backend with its own contacts and solver (closed), the same with MJX's step (mjx), and `c`. What
is left are contact points and rounding. `n` counts fingers that touch, and differences are those of their force
vectors. Speeds are of a control tick of physics with the default iterations, measured in turn.
"""

import argparse
import dataclasses
import json
import statistics
import time

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
from dexsim.physics.physics import Physics
from dexsim_ppo import load_policy

WAYS = {"closed": ("jax", "closed"), "mjx": ("jax", "mjx"), "c": ("c", "closed")}
TOUCHING = 0.01  # N


def grips(env: Env, act, count: int, ticks: list[int]) -> State:
    """States [count times len(ticks)] of grips that are as old as `ticks`."""
    state = jit(jax.vmap(env.reset), backend="c")(jax.random.split(jax.random.key(0), count))
    step, found = jit(jax.vmap(env.step), backend="c"), []
    for tick in range(max(ticks)):
        state = step(state, act(state.obs["actor"]))
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


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--num-envs", type=int, default=200)
    parser.add_argument("--ticks", type=int, nargs="+", default=[20, 40, 80], help="age of the grips")
    parser.add_argument("--repeats", type=int, default=7, help="of the timing; 0 leaves it out")
    parser.add_argument("--ways", nargs="+", default=["closed", "mjx"], choices=list(WAYS))
    options = parser.parse_args()
    enable_caches()
    policy = load_policy("grasp")
    env = policy.make_env(num_envs=options.num_envs, backend="c")
    state = grips(env, policy, options.num_envs, options.ticks)
    shape, wanted = np.asarray(state.episode.object.shape_index), forces(env, state, "c")
    for way in options.ways:
        found = forces(env, state, way)
        for index, name in enumerate(SHAPES):
            mine = shape == index
            row = {key: round(value, 4) for key, value in compare(found[mine], wanted[mine]).items()}
            print(json.dumps({"way": way, "shape": name} | row), flush=True)
    if options.repeats:
        for way, row in speeds(env, state, [*options.ways, "c"], options.repeats).items():
            print(json.dumps({"way": way, "environments": len(shape)} | row), flush=True)


if __name__ == "__main__":
    main()
