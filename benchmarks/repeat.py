"""Which part of a training repeats to the last bit: each is run again on the same inputs, one JSON line each.

    python benchmarks/repeat.py --task grasp --backend jax --deterministic

`differ` names the arrays that differ between the repetitions of this process, worst first. `digest` is that of the
first result: two runs of the command whose digests differ, where nothing differs within them, were compiled into
different programs.
"""

import argparse
import dataclasses
import functools
import hashlib
import json
from collections.abc import Callable, Iterator
from typing import Any

import jax
import numpy as np
from throughput import Recorder, make, preset
from throughput_split import record, replay

from dexsim.core.cli import enable_caches
from dexsim.core.compilation import collector_paused, jit, make_deterministic
from dexsim.registry import TASKS
from dexsim_ppo.learner import ppo


def parts(task: str, backend: str, num_envs: int, warmup: int) -> Iterator[tuple[str, Callable, Any]]:
    """Name, compiled function and its argument, in the order of a training."""
    env, recorder = make(task, "full", backend, num_envs), Recorder(make(task, "full", backend, num_envs))
    ppo_config = preset(task).ppo
    config = dataclasses.replace(ppo_config, num_envs=num_envs, iterations_per_call=1)
    training, compiled = ppo.make_train(env, config), functools.partial(jit, backend=env.backend)
    yield "pool of start states", lambda pool: pool, env.pool
    yield "initial state", training.init, jax.random.key(0)
    state = training.init(jax.random.key(0))
    for _ in range(warmup):  # else nothing touches anything
        state, _ = training.step(state)
    ticks, _ = compiled(lambda state: record(recorder, config, state))(state)
    first = jax.tree.map(lambda x: x[0], ticks)
    yield "physics of a tick", compiled(lambda tick: replay(env, tick)), first
    collect = compiled(lambda state: ppo.collect_rollout(env, config, state))
    yield "experience", collect, state
    (env_state, memory), rollout, tally = collect(state)
    state = dataclasses.replace(state, env_state=env_state, memory=memory)
    yield "update", compiled(lambda given: ppo.learn(env, config, *given)), (state, rollout, tally)


def arrays(tree: Any) -> dict[str, np.ndarray]:
    """Leaves by their path, keys of random numbers as plain ones."""
    found = {}
    for path, leaf in jax.tree_util.tree_leaves_with_path(tree):
        plain = jax.random.key_data(leaf) if jax.dtypes.issubdtype(leaf.dtype, jax.dtypes.prng_key) else leaf
        found[jax.tree_util.keystr(path)] = np.array(plain)
    return found


def compare(run: Callable, argument: Any, repeats: int) -> dict[str, Any]:
    """Run again and again; what differs from the first time."""
    with collector_paused():
        first, differ = arrays(run(argument)), dict[str, float]()
        for _ in range(repeats):
            for name, again in arrays(run(argument)).items():
                if again.tobytes() != first[name].tobytes():
                    far = float(np.nanmax(np.abs(again.astype(float) - first[name].astype(float))))
                    differ[name] = max(differ.get(name, 0.0), far)
    digest = hashlib.sha256(b"".join(x.tobytes() for x in first.values())).hexdigest()[:16]
    worst = dict(sorted(differ.items(), key=lambda item: -item[1])[:8])
    return {"arrays": len(first), "differing": len(differ), "differ": worst, "digest": digest}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--task", default="grasp", choices=sorted(TASKS))
    parser.add_argument("--backend", default="auto", choices=["auto", "jax", "warp", "c"])
    parser.add_argument("--num-envs", type=int, default=256)
    parser.add_argument("--warmup", type=int, default=4, help="iterations of training before what is compared")
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--deterministic", action="store_true", help="as in training")
    options = parser.parse_args()
    enable_caches()
    if options.deterministic:
        make_deterministic()
    for name, run, argument in parts(options.task, options.backend, options.num_envs, options.warmup):
        row = {"measure": "repeat", "part": name} | compare(run, argument, options.repeats)
        print(json.dumps(row), flush=True)


if __name__ == "__main__":
    main()
