"""Environment throughput: one JSON line per measurement, key `env_steps_per_s`.

    python benchmarks/throughput.py --backends warp jax --num-envs 4096 16384 32768

Measures the full step of the task (action to observation, restarts included) under random
actions, and again with touch, the actuator model and the observation left out one at a time:
the difference is the share of each. `--train` measures PPO on top.
"""

import argparse
import dataclasses
import json
import statistics
import time

import jax
import jax.numpy as jnp

import dexsim
from dexsim.env import Env
from dexsim.tasks import TASKS


class WithoutObservation(Env):
    """`observe` left out: what follows sees zeros."""

    def _observe(self, readings, moment, goal):
        return {group: jnp.zeros(sum(field.size for field in fields))
                for group, fields in self.observation_layout.items()}


class WithoutActuator(Env):
    """The actuator model left out: a constant torque instead."""

    def _torque(self, state, joint_target):
        return lambda substep, position, velocity: 0.05 * (joint_target - position)


VARIANTS = {"full": Env, "without touch": Env, "without observation": WithoutObservation,
            "without actuator": WithoutActuator}


def make(task: str, variant: str, backend: str, num_envs: int) -> Env:
    """The environment, whole or with one room left out."""
    entry = TASKS[task]
    config = entry.config()
    if variant == "without touch":
        config = dataclasses.replace(config, touch=False)
    hand = dexsim.load_hand()
    return VARIANTS[variant](entry.task_class(config, hand), hand, backend=backend,
                             num_envs=num_envs)


def measure(env: Env, num_envs: int, steps: int, repeats: int) -> dict:
    """Median seconds of `steps` steps of a batch, and the compile time."""
    def run(state, key):
        def body(carry, key):
            action = jax.random.uniform(key, (num_envs, env.action_size), minval=-1.0)
            after = jax.vmap(env.step)(carry, action)
            touched = jnp.mean(jnp.any(after.finger_force > 0, -1))
            return jax.vmap(env.restart)(after, after.terminated | after.truncated), touched
        return jax.lax.scan(body, state, jax.random.split(key, steps))

    run = jax.jit(run, donate_argnums=0)
    state = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(0), num_envs))
    start = time.perf_counter()
    state, touched = run(state, jax.random.key(1))
    jax.block_until_ready(touched)
    first = time.perf_counter() - start
    seconds = []
    for index in range(repeats):
        start = time.perf_counter()
        state, touched = run(state, jax.random.key(2 + index))
        jax.block_until_ready(touched)
        seconds.append(time.perf_counter() - start)
    median = statistics.median(seconds)
    return {"env_steps_per_s": round(num_envs * steps / median),
            "ms_per_step": round(1e3 * median / steps, 4),
            "spread": round((max(seconds) - min(seconds)) / median, 4),
            "first_call_s": round(first, 2), "share_touching": round(float(touched.mean()), 3)}


def measure_training(task: str, backend: str, num_envs: int, iterations: int) -> dict:
    """Env-steps per second of PPO's train step, compile excluded."""
    from dexsim_ppo.ppo import PPOConfig, make_train

    env = dexsim.make(task, backend=backend, num_envs=num_envs)
    config = dataclasses.replace(PPOConfig(), num_envs=num_envs)
    init, train_step = make_train(env, config)
    state = init(jax.random.key(0))
    state, metrics = train_step(state)
    jax.block_until_ready(metrics)
    start = time.perf_counter()
    for _ in range(iterations):
        state, metrics = train_step(state)
    jax.block_until_ready(metrics)
    seconds = time.perf_counter() - start
    steps = iterations * num_envs * config.rollout_length
    return {"env_steps_per_s": round(steps / seconds)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--task", default="grasp", choices=sorted(TASKS))
    parser.add_argument("--backends", nargs="+", default=["auto"])
    parser.add_argument("--num-envs", nargs="+", type=int, default=[256])
    parser.add_argument("--variants", nargs="+", default=list(VARIANTS), choices=list(VARIANTS))
    parser.add_argument("--steps", type=int, default=16)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--train", type=int, default=0, metavar="ITERATIONS")
    options = parser.parse_args()
    device = jax.devices()[0]
    common = {"task": options.task, "device": device.device_kind, "jax": jax.__version__}
    for backend in options.backends:
        for num_envs in options.num_envs:
            for variant in options.variants:
                env = make(options.task, variant, backend, num_envs)
                row = measure(env, num_envs, options.steps, options.repeats)
                print(json.dumps({"measure": "env", "variant": variant, "backend": env.backend,
                                  "num_envs": num_envs, **row, **common}), flush=True)
            if options.train:
                row = measure_training(options.task, backend, num_envs, options.train)
                print(json.dumps({"measure": "training", "backend": backend,
                                  "num_envs": num_envs, **row, **common}), flush=True)


if __name__ == "__main__":
    main()
