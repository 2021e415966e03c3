"""A control tick of physics by our engines, by `mjx.step` and by `mujoco.rollout`, on the same grips and in turn."""

import statistics
from collections.abc import Callable
from typing import Any

import jax
import numpy as np
from engines import grips, physics_tick
from mujoco import MjData, rollout
from throughput import seconds

from dexsim.core.compilation import available_cores
from dexsim.env.env import Env
from dexsim.env.state import State
from dexsim.physics.c_backend import CBackend
from dexsim_ppo import load_policy

WAYS = {"ours, c": "c", "ours, jax": "closed", "mjx.step": "mjx"}


def measure(num_envs: int, age: int, repeats: int, ways: list[str]) -> dict[str, dict[str, Any]]:
    """By engine: physics steps a second and seconds to the first result.

    Args:
      age: ticks that the shipped policy has held its objects for.
      ways: keys of `WAYS`; "mujoco.rollout" is always measured.
    """
    policy = load_policy("grasp")
    env = policy.make_env(num_envs=num_envs, backend="c")
    state = grips(env, policy, num_envs, [age])
    calls: dict[str, tuple[Callable, ...]] = {way: (physics_tick(env, WAYS[way]), state) for way in ways}
    calls["mujoco.rollout"] = (bare_rollout(env, state),)
    first = {name: seconds(*call)[0] for name, call in calls.items()}
    times: dict[str, list[float]] = {name: [] for name in calls}
    for _ in range(repeats):
        for name, call in calls.items():
            times[name].append(seconds(*call)[0])
    steps = num_envs * env.config.physics.substeps
    return {
        name: {
            "physics_steps_per_s": steps / statistics.median(taken),
            "slowest_over_fastest": max(taken) / min(taken),
            "first_s": first[name],
        }
        for name, taken in times.items()
    }


def bare_rollout(env: Env, state: State) -> Callable[[], np.ndarray]:
    """The same models and states through `mujoco.rollout` on all cores, under no torques."""
    jax.block_until_ready(physics_tick(env, "c")(state))  # writes the objects into the models
    assert isinstance(env.physics.engine, CBackend)
    rows, substeps = env.physics.engine._engine._batch(len(state.tick)), env.config.physics.substeps
    model = env.physics.scene.model
    begin = np.zeros_like(rows.states[0])
    begin[:, 1 : 1 + model.nq], begin[:, 1 + model.nq : 1 + model.nq + model.nv] = (
        state.physics.qpos,
        state.physics.qvel,
    )
    threads = available_cores()
    datas, pool = [MjData(model) for _ in range(threads)], rollout.Rollout(nthread=threads if threads > 1 else 0)
    warmstart = np.asarray(state.physics.warmstart, float)
    return lambda: pool.rollout(rows.models, datas, begin, nstep=substeps, initial_warmstart=warmstart)[0]
