"""Environment throughput: one JSON line per measurement, key `env_steps_per_s`.

    python benchmarks/throughput.py --backends warp jax --num-envs 4096 16384 32768
    python benchmarks/throughput.py --leave-out actuator randomization      # their shares alone
    python benchmarks/throughput.py --task rotate --split                   # where a training step goes
    python benchmarks/throughput.py --task rotate --train 6 --backends c jax

The first measures the full step of the task (action to observation, restarts included) under random
actions, and again with parts left out one at a time. All variants begin at the same states, take the
same actions and are timed in turn, so that what else the machine does falls on all of them; `share` is
the median over the rounds of 1 - (time without) / (time of the full step), with its quartiles.

| left out | what runs instead |
|---|---|
| touch | no taxels |
| observation | zeros |
| actuator | the torques of the full step, recorded beforehand: the same motion and the same contacts |
| redrawing | hands drawn once and kept: the same spread of hands, so the same contacts |
| randomization | scale 0: one nominal hand, nothing is drawn; contacts may differ a little |

`--train` measures training with the device's preset and nothing else, all backends in turn; `times_jax` is the median
over the rounds of the `jax` backend's time over this one's. `--split` measures the parts of a training step (see
`throughput_split`).
"""

import argparse
import dataclasses
import json
import statistics
import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

import dexsim
from dexsim.core.cli import enable_caches
from dexsim.core.compilation import collector_paused, jit
from dexsim.env.env import Env
from dexsim.env.motors import PhysicsTick, stay_finite
from dexsim.env.observer import Observer
from dexsim.registry import TASKS
from dexsim_ppo.learner.rollout import scan_restarting


class ZeroObserver:
    """In place of `Env.observer`: what follows sees zeros."""

    def __init__(self, observer: Observer):
        self.layout = observer.layout

    def observe(self, *_):
        return {group: jnp.zeros(sum(field.size for field in fields)) for group, fields in self.layout.items()}


class Around:
    """Stands in for another object, and passes on all that it does not do itself."""

    def __init__(self, inner: Any):
        self.inner = inner

    def __getattr__(self, name: str) -> Any:
        return getattr(self.inner, name)


class KeptHands(Around):
    """An environment in which a restarted episode keeps the hand and the IMU of the one before."""

    def __init__(self, env: Env):
        super().__init__(env)
        env.sampler = self.sampler = KeptSampler(env.sampler)

    def restart(self, state, done):
        self.sampler.kept = state.episode
        try:
            return self.inner.restart(state, done)
        finally:
            self.sampler.kept = None


class KeptSampler(Around):
    """In place of `Env.sampler`."""

    kept = None  # the episode before, while a restart is traced

    def sample(self, *arguments):
        drawn, kept = self.inner.sample(*arguments), self.kept
        return drawn if kept is None else dataclasses.replace(drawn, hand=kept.hand, imu=kept.imu)


class Recorder(Around):
    """An environment that also tells what a tick of physics was given."""

    def __init__(self, env: Env):
        super().__init__(env)
        env.motors.physics = self.tape = RecordingPhysics(env.physics)

    def recorded_step(self, state, action) -> tuple[Any, Any]:
        """`step`, and its tick: object, physics state, push, cover, joint torques [S + 1, J] Nm (the last: as read)."""
        after = self.inner.step(state, action)
        *given, tape = self.tape.given
        torque, self.tape.given = after.sensor_input.joint_torque * self.hand.torque_limit, None
        return after, (*given, tape.at[-1].set(torque))


class RecordingPhysics(Around):
    """In place of `Motors.physics`; keeps the last tick for the caller who is tracing `step`."""

    given = None

    def advance_motors(self, object, state, motors, memory, push, cover):
        def taped(substep, position, velocity, carried):
            tape, memory = carried
            torque, memory = motors(substep, position, velocity, memory)
            return torque, (tape.at[substep].set(torque), memory)

        tape = jnp.zeros((self.config.substeps + 1, len(self.joint_qpos)))
        after, force, (tape, memory) = self.inner.advance_motors(object, state, taped, (tape, memory), push, cover)
        self.given = object, state, push, cover, tape
        return after, force, memory


class Replay(Around):
    """An environment without an actuator: joint torques from a tape."""

    def __init__(self, env: Env):
        super().__init__(env)
        env.motors = self.motors = TapedMotors(env.motors)

    def replayed_step(self, state, action, tape):
        self.motors.tape = tape
        after, self.motors.tape = self.inner.step(state, action), None
        return after


class TapedMotors(Around):
    """In place of `Env.motors`."""

    tape = None  # [S + 1, J] Nm, of the tick that is being traced

    def tick(self, episode, command, physics, gear, push):
        tape = self.tape
        after, force = self.physics.advance(
            episode.object, physics, lambda substep, position, velocity: tape[substep], push, episode.hand.cover
        )
        after, gear, force, finite = stay_finite(command.valid, (physics, gear), (after, gear), force)
        limited = jnp.zeros(tape[-1].shape, bool)  # what the tape does not tell; a metric
        return PhysicsTick(
            physics=after, finger_force=force, joint_torque=tape[-1], gear=gear, limited=limited, finite=finite
        )


PARTS = ("touch", "observation", "actuator", "redrawing", "randomization")


def make(task: str, left_out: str, backend: str, num_envs: int) -> Any:
    """The environment, whole ("full") or with one part left out."""
    config = TASKS[task].config()
    if left_out == "touch":
        config = dataclasses.replace(config, touch=False)
    if left_out == "randomization":
        config = dataclasses.replace(config, randomization=dataclasses.replace(config.randomization, scale=0.0))
    env = dexsim.make(task, config, backend=backend, num_envs=num_envs)
    if left_out == "observation":
        env.observer = ZeroObserver(env.observer)
    return {"actuator": Replay, "redrawing": KeptHands}.get(left_out, lambda env: env)(env)


def runner(env: Env, num_envs: int, steps: int, step: Callable | None = None) -> Callable:
    """Compiled: states, key and a tape to states, share of environments in contact, new tape."""
    step = step or (lambda state, action, tape: (env.step(state, action), tape))

    def run(state, key, tape):
        def body(carry, inputs):
            key, tape = inputs
            action = jax.random.uniform(key, (num_envs, env.action_size), minval=-1.0)
            after, tape = jax.vmap(step)(carry, action, tape)
            touched = jnp.mean(jnp.any(after.finger_force > 0, -1))
            return after, after.terminated | after.truncated, (touched, tape)

        restart = jax.vmap(env.restart)
        state, (touched, tape) = scan_restarting(restart, body, state, (jax.random.split(key, steps), tape))
        return state, jnp.mean(touched), tape

    return jit(run, backend=env.backend)


def seconds(run: Callable, *arguments: Any) -> tuple[float, Any]:
    """Time of a call, and its result."""
    with collector_paused():
        start = time.perf_counter()
        result = jax.block_until_ready(run(*arguments))
        return time.perf_counter() - start, result


def started(env: Env, num_envs: int, steps: int) -> Any:
    """States after some ticks, when hands and objects have met."""
    state = jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(0), num_envs))
    return runner(env, num_envs, steps)(state, jax.random.key(1), None)[0]


def compare(task: str, backend: str, num_envs: int, parts: tuple[str, ...], steps: int, repeats: int) -> list[dict]:
    """A row for the full step and one for each part left out."""
    full = make(task, "full", backend, num_envs)
    state, key = started(full, num_envs, steps), jax.random.key(2)
    cases = {"nothing": (runner(full, num_envs, steps), state, None)}
    for part in parts:
        env, tape, step = make(task, part, backend, num_envs), None, None
        if part == "actuator":
            recorder = Recorder(make(task, "full", backend, num_envs))
            record = runner(
                recorder,
                num_envs,
                steps,
                lambda state, action, _, r=recorder: (lambda after, tick: (after, tick[-1]))(
                    *r.recorded_step(state, action)
                ),
            )
            tape = record(state, key, None)[2]
            step = lambda state, action, tape, e=env: (e.replayed_step(state, action, tape), tape[:0])  # noqa: E731
        begin = started(env, num_envs, steps) if part == "randomization" else state
        cases[part] = (runner(env, num_envs, steps, step), begin, tape)
    first, touched, times = {}, {}, {name: [] for name in cases}
    for name, (run, begin, tape) in cases.items():
        first[name], (_, touched[name], _) = seconds(run, begin, key, tape)
    for _ in range(repeats):
        for name, (run, begin, tape) in cases.items():
            times[name].append(seconds(run, begin, key, tape)[0])
    rows = []
    for name in cases:
        shares = sorted(1 - mine / whole for mine, whole in zip(times[name], times["nothing"], strict=True))
        rows.append(
            {"left_out": name, "backend": full.backend, "num_envs": num_envs}
            | timing(times[name], num_envs * steps, steps)
            | {"first_call_s": round(first[name], 2), "share_touching": round(float(touched[name]), 3)}
            | (
                {}
                if name == "nothing"
                else {
                    "share": round(statistics.median(shares), 4),
                    "share_quartiles": [round(shares[len(shares) // 4], 4), round(shares[-1 - len(shares) // 4], 4)],
                }
            )
        )
    return rows


def timing(times: list[float], env_steps: int, steps: int) -> dict:
    """What every row says."""
    median = statistics.median(times)
    return {
        "env_steps_per_s": round(env_steps / median),
        "ms_per_step": round(1e3 * median / steps, 4),
        "spread": round((max(times) - min(times)) / median, 4),
    }


def measure(env: Env, num_envs: int, steps: int, repeats: int) -> dict:
    """The full step alone."""
    run, state = runner(env, num_envs, steps), started(env, num_envs, steps)
    seconds(run, state, jax.random.key(2), None)
    return timing([seconds(run, state, jax.random.key(2), None)[0] for _ in range(repeats)], num_envs * steps, steps)


def preset(task: str) -> Any:
    """Training's preset for the device; of CPUs the one for few cores."""
    from dexsim_ppo.training.presets import find_preset

    return find_preset("gpu" if jax.default_backend() == "gpu" else "cpu", task)


def measure_training(task: str, backends: list[str], num_envs: int, iterations: int, repeats: int) -> list[dict]:
    """Env-steps per second of the device's training preset, learner included and compilation excluded; in turn."""
    from dexsim_ppo.learner.ppo import make_train

    config = dataclasses.replace(preset(task).ppo, num_envs=num_envs, iterations_per_call=1)
    runs = {}
    for backend in backends:
        env = dexsim.make(task, backend=backend, num_envs=num_envs)
        training = make_train(env, config)
        state, first = training.init(jax.random.key(0)), time.perf_counter()
        for _ in range(8):  # objects settle, hands close
            state, metrics = jax.block_until_ready(training.step(state))
        runs[env.backend] = [training.step, state, [], round(time.perf_counter() - first, 1)]
    for _ in range(repeats):
        for run in runs.values():
            with collector_paused():
                start = time.perf_counter()
                for _ in range(iterations):
                    run[1], metrics = run[0](run[1])
                jax.block_until_ready(metrics)
                run[2].append(time.perf_counter() - start)
    steps, rows = iterations * config.rollout_length, []
    for name, (_, _, times, first) in runs.items():
        row = {"backend": name, "num_envs": num_envs} | timing(times, num_envs * steps, steps)
        if name != "jax" and "jax" in runs:
            ratios = [theirs / mine for mine, theirs in zip(times, runs["jax"][2], strict=True)]
            row["times_jax"] = round(statistics.median(ratios), 2)
        rows.append(row | {"first_calls_s": first})
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--task", default="grasp", choices=sorted(TASKS))
    parser.add_argument("--backends", nargs="+", default=["auto"], choices=["auto", "jax", "warp", "c"])
    parser.add_argument("--num-envs", nargs="+", type=int, default=[], help="training's by default")
    parser.add_argument("--leave-out", nargs="*", default=list(PARTS), choices=PARTS)
    parser.add_argument("--steps", type=int, default=16)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--train", type=int, default=0, metavar="ITERATIONS", help="training, and nothing else")
    parser.add_argument("--split", action="store_true", help="the parts of a training step, and nothing else")
    options = parser.parse_args()
    enable_caches()
    device = jax.devices()[0]
    common = {"task": options.task, "device": device.device_kind, "jax": jax.__version__}

    def show(row: dict) -> None:
        print(json.dumps(row | common), flush=True)

    for num_envs in options.num_envs or [preset(options.task).ppo.num_envs]:
        if options.train:
            for row in measure_training(options.task, options.backends, num_envs, options.train, options.repeats):
                show({"measure": "training"} | row)
            continue
        for backend in options.backends:
            if options.split:
                from throughput_split import split

                for row in split(options.task, backend, num_envs, options.repeats):
                    show({"measure": "split"} | row)
                continue
            for row in compare(
                options.task, backend, num_envs, tuple(options.leave_out), options.steps, options.repeats
            ):
                show({"measure": "env"} | row)


if __name__ == "__main__":
    main()
