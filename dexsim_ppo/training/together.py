"""Trainings of several seeds in one program: the training step, environments included, is vmapped over the seeds."""

import time
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp

from dexsim.core.compilation import collector_paused
from dexsim_ppo.learner.ppo import TrainState, make_train
from dexsim_ppo.policy import Policy
from dexsim_ppo.training import memory, programs
from dexsim_ppo.training.display import Display
from dexsim_ppo.training.faults import Faults, keep
from dexsim_ppo.training.runlog import MetricsLog, means
from dexsim_ppo.training.trainer import Run, due

# One seed's part of a tree [S, ...].
_part: Callable[[Any, int], Any] = jax.jit(lambda tree, index: jax.tree.map(lambda x: x[index], tree))


def train_together(runs: Sequence[Run], source: Policy | None, stopped: Callable[[], int]) -> bool:
    """Train one run for each seed, all at once. Each gets its share of the wall-clock time.

    Args:
      runs: alike but for their seeds and folders.
      source: a policy to fine-tune, or None to start from scratch.
      stopped: nonzero once the runs are to end early.

    Returns:
      False if they have to be trained in turn, which a printed line explains; nothing has happened then.
    """
    first = runs[0]
    if first.mesh is not None or first.env.backend == "warp":
        why = "several devices" if first.mesh is not None else "Warp, whose buffers have the size of one batch"
        print(f"{len(runs)} seeds in turn: {why}", flush=True)
        return False
    title = f"{first.arguments.task} on {jax.devices()[0].device_kind}, {first.env.backend}, {len(runs)} seeds"
    with Display(title) as display:
        display.note(f"{first.folder.path.parent}: {title}, {first.config.num_envs} environments each")
        display.working("compiling the training step; the second time it is read from the cache")
        training, begin = make_train(first.env, first.config, first.arguments.curriculum), time.perf_counter()
        keys = [jax.random.key(run.arguments.seed) for run in runs]
        shapes = jax.eval_shape(_stack, [training.shapes(key) for key in keys])
        step = programs.compile_step(
            jax.vmap(training.plain_step), shapes, first.identity(), lambda: None, first.env.backend
        )
        need, limit = memory.needed(step), memory.available()
        if need is not None and limit is not None and need > limit:
            display.note(f"{len(runs)} seeds in turn: at once they need {need / 2**30:.3g} GiB")
            return False
        states = _stack([run.begin(training.init(key), source) for run, key in zip(runs, keys, strict=True)])
        for run in runs:
            run.share, run.clock["compile_s"] = 1 / len(runs), time.perf_counter() - begin
        logs = [MetricsLog(run.folder, 0, run.arguments) for run in runs]
        try:
            _loop(runs, states, step, display, logs, stopped)
        finally:
            for log in logs:
                log.close()
    return True


def _loop(
    runs: Sequence[Run],
    states: TrainState,
    step: Callable,
    display: Display,
    logs: list[MetricsLog],
    stopped: Callable[[], int],
) -> None:
    arguments, config, per_call = runs[0].arguments, runs[0].config, runs[0].config.iterations_per_call
    faults = [Faults(config, run.folder, run.content(), _part(states, i)) for i, run in enumerate(runs)]
    iteration, evaluated, begin, steps_s = 0, True, time.perf_counter(), list[float]()
    while not stopped() and not all(run.is_over(iteration) for run in runs):
        call = time.perf_counter()
        with collector_paused():
            before = keep(states)
            states, metrics = step(states)
            metrics = jax.device_get(metrics)
        steps_s.append(time.perf_counter() - call)
        iteration += per_call
        evaluated = runs[0].is_evaluation_due(iteration, per_call * config.steps_per_iteration / steps_s[-1])
        logged = evaluated or iteration == per_call or due(iteration, per_call, arguments.log_every)
        rows = []
        for i, run in enumerate(runs):
            mine = {name: values[i] for name, values in metrics.items()}
            row = means(mine) | faults[i].check(_part(before, i), mine, iteration, display.note)
            row |= run.progress(iteration, steps_s[-1] / len(runs))
            if evaluated:
                row |= run.evaluate(_part(states, i), iteration, display)
            if logged:
                logs[i].write(row)
            if due(iteration, per_call, arguments.checkpoint_every):
                run.save(_part(states, i), iteration)
            rows.append(row)
        if logged:
            # A figure that a seed does not have, such as r of too few held objects, is left out of the mean.
            names = dict.fromkeys(name for row in rows for name in row)
            row = means({name: [row[name] for row in rows if name in row] for name in names})
            display.show(row | {name: len(runs) * row[name] for name in ("seconds", "seconds_left")})
    steps = iteration * config.steps_per_iteration
    timed = len(runs) * (steps - per_call * config.steps_per_iteration)
    for i, run in enumerate(runs):
        run.clock |= {
            "seeds_at_once": len(runs),
            "training_s": time.perf_counter() - begin,
            "step_s": sum(steps_s),
            "env_steps": steps,
            "env_steps_per_s": timed / max(sum(steps_s[1:]), 1e-9),
        }
        if run.best["return"] is not None and not stopped() and not evaluated:
            run.evaluate(_part(states, i), iteration, display)
        run.save(_part(states, i), iteration)


def _stack(trees: Sequence[Any]) -> Any:
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *trees)
