"""The `c` backend's physics alone: physics steps per second, one JSON line for each way of calling it.

    python benchmarks/host_physics.py --num-envs 256

The shipped policy's hands in the same states, held grips for the most part, in turn: bare `mujoco.rollout` with the
same models and threads and torques that do not change; a control tick in one call, as the backend does it; a call for
each sub-step, as it does it for motor laws that the host cannot evaluate. Bind the process to fewer cores
(`taskset -c 0`) for fewer threads.
"""

import argparse
import json
import statistics

import jax
import jax.numpy as jnp
from throughput import seconds

from dexsim.core.cli import enable_caches
from dexsim.core.compilation import jit
from dexsim.env.motors import JointCommand
from dexsim.physics import c_backend
from dexsim.physics.host.engine import _APPLIED, pool
from dexsim_ppo import load_policy


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--task", default="grasp")
    parser.add_argument("--num-envs", type=int, default=256)
    parser.add_argument("--ticks", type=int, default=80, help="before the measurement")
    parser.add_argument("--repeats", type=int, default=15)
    options = parser.parse_args()
    enable_caches()
    policy, count = load_policy(options.task), options.num_envs
    env = policy.make_env(backend="c", num_envs=count)
    state = jit(jax.vmap(env.reset), backend="c")(jax.random.split(jax.random.key(0), count))
    advance, carry = jit(jax.vmap(env.step), backend="c"), policy.initial_carry(count)
    for _ in range(options.ticks):
        carry, action = policy.act(carry, state.obs["actor"])
        state = advance(state, action)

    def hold(s):
        return JointCommand(
            action=0 * s.joint_target, target=s.joint_target, previous=s.joint_target, valid=jnp.array(True)
        )

    def tick(state):
        return jax.vmap(lambda s: env.motors.tick(s.episode, hold(s), s.physics, s.gear, jnp.zeros(3)))(state)

    whole, known = jit(tick), c_backend.record

    def unknown(law, joints, memory):
        return known(law, joints, memory) if law.__module__ == c_backend.__name__ else None

    parts = jit(lambda state: tick(state))
    seconds(whole, state)
    c_backend.record = unknown
    seconds(parts, state)
    c_backend.record = known

    engine, substeps = env.physics.engine._engine, env.config.physics.substeps
    rows, workers = engine._batch(count), pool()
    applied = rows.applied[:, None].repeat(substeps, 1)
    after, sensors = (x[:, None].repeat(substeps, 1) for x in (rows.states[0], rows.sensors))
    begin, warmstart, chunk = rows.states[0].copy(), rows.warmstart.copy(), max(1, count // (10 * workers.threads))

    def bare():
        workers.rollout.rollout(
            rows.models, engine._datas, substeps, _APPLIED, begin, warmstart, applied, after, sensors, chunk
        )

    cases = {"rollout": (bare,), "tick in one call": (whole, state), "call for each sub-step": (parts, state)}
    times: dict[str, list[float]] = {name: [] for name in cases}
    for _ in range(options.repeats):
        for name, case in cases.items():
            times[name].append(seconds(*case)[0])
    for name, taken in times.items():
        ticks = count / statistics.median(taken)
        common = {
            "threads": workers.threads,
            "num_envs": count,
            "touching": round(float(jnp.mean(state.finger_force > 0)), 3),
        }
        speed = {"physics_steps_per_s": round(ticks * substeps), "env_ticks_per_s": round(ticks)}
        print(json.dumps({"way": name} | speed | common), flush=True)


if __name__ == "__main__":
    main()
