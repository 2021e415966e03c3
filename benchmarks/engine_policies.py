"""Success of the shipped policies on each engine, for `engines.py policies`."""

import dataclasses
import time
from typing import Any

from engine_motions import CONVERGED

from dexsim.core.config import override
from dexsim_ppo import evaluate_policy, load_policy


def measure(name: str, backend: str, converged: bool, episodes: int, seconds: float) -> dict[str, Any]:
    """A row: what a policy reaches in the same episodes on an engine.

    Args:
      name: of the shipped policy.
      backend: the engine.
      converged: whether its solver has 50 iterations of 50 line-search steps, or those of training.
      episodes: their number, all side by side.
      seconds: their length; 0 for the task's own.
    """
    policy, start = load_policy(name), time.perf_counter()
    changes = [f"pool_size={max(episodes, 64)}"] + [f"evaluation_seconds={seconds}"] * bool(seconds)
    if converged:
        changes += [f"physics.{field}={value}" for field, value in CONVERGED.items()]
    policy = dataclasses.replace(policy, env_config=override(policy.env_config, changes))
    env = policy.make_env(backend=backend, num_envs=episodes)
    report = evaluate_policy(policy, env=env, episodes=episodes, chunk=episodes, baseline=False)
    task, spread = report["task"], {}
    if "successes_per_minute" in task:
        spread = {"kept": task["kept_to_the_end"], "successes_per_minute": task["successes_per_minute"]}
    else:
        spread = {"held": task["held"], "r": task["r_resultant"], "force_error_n": task["force_error_n"]}
    row = {"policy": name, "backend": backend, "converged": converged, "episodes": episodes, "seconds": task["seconds"]}
    for key, entry in spread.items():
        row[key] = entry["r" if key == "r" else "mean"]
        row[f"{key}_ci95"] = [entry["low"], entry["high"]]
    return row | {"non_finite": task["non_finite"], "took_s": time.perf_counter() - start}
