"""Replays the iteration of a training run in which a gradient was not finite, and says where that began.

    python -m dexsim_ppo.reproduce runs/grasp-20260101-120000/reproduce-00000420.msgpack

Training writes the file: a checkpoint from before that iteration.
"""

import dataclasses
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Annotated

import jax
import jax.numpy as jnp
import numpy as np
import tyro

from dexsim.core import cli
from dexsim.registry import find_task
from dexsim_ppo import checkpoint
from dexsim_ppo.learner.config import PPOConfig
from dexsim_ppo.learner.ppo import TrainState, collect_rollout, make_train
from dexsim_ppo.learner.types import Environment
from dexsim_ppo.train import default_arguments, make_environment
from dexsim_ppo.training.arguments import find_hand
from dexsim_ppo.training.faults import keep


@dataclasses.dataclass(frozen=True, kw_only=True)
class ReproduceArguments:
    """Options of `python -m dexsim_ppo.reproduce`."""

    file: Annotated[Path, tyro.conf.Positional]
    """File that training wrote, reproduce-ITERATION.msgpack in the run's folder."""
    task: str = ""
    """Module and name of a task of your own, such as my_module:poke; the file names all others."""


def main(argv: Sequence[str] | None = None) -> int:
    """The command. Returns its exit code: 1 if every gradient is finite this time."""
    arguments = cli.parse(
        ReproduceArguments,
        sys.argv[1:] if argv is None else argv,
        prog="python -m dexsim_ppo.reproduce",
        description="Replay the iteration of a training run in which a gradient was not finite.",
    )
    cli.enable_caches()
    if arguments.task:
        find_task(arguments.task)
    file = checkpoint.load(arguments.file, kind="train")
    saved = default_arguments(None, "auto", file)
    env, config = make_environment(saved, find_hand(saved, file)), saved.ppo
    training = make_train(env, dataclasses.replace(config, iterations_per_call=1), saved.curriculum)
    restored = checkpoint.restore(file, training.shapes(jax.random.key(saved.seed)))
    state: TrainState = jax.tree.map(jnp.copy, restored)
    print(f"{file.path}: {file.task}, seed {saved.seed}, {config.num_envs} environments, {env.backend} physics")
    for _ in range(config.iterations_per_call):
        before = keep(state)
        state, _ = training.step(state)
        iteration, lost = int(before.iteration), int(state.skipped_updates) - int(before.skipped_updates)
        if lost:
            print(f"iteration {iteration}: {lost} of {config.epochs * config.minibatches} gradients are not finite")
            for line in findings(env, config, before):
                print(f"  {line}")
            return 0
        print(f"iteration {iteration}: every gradient is finite")
    print(f"not reproduced ({env.backend} on {jax.devices()[0].device_kind})")
    return 1


def findings(env: Environment, config: PPOConfig, state: TrainState) -> Iterator[str]:
    """What is not finite in the state before the iteration, and in the experience that it collects."""
    for path, leaf in jax.tree.leaves_with_path(state):
        if jnp.issubdtype(leaf.dtype, jnp.floating) and (count := int(jnp.sum(~jnp.isfinite(leaf)))):
            yield f"before it: state{jax.tree_util.keystr(path)}, {count} of {leaf.size} numbers"
    _, rollout, metrics = jax.jit(lambda state: collect_rollout(env, config, state))(state)
    for group, fields in env.observation_layout.items():
        bad, start = ~np.isfinite(np.asarray(rollout.obs[group])), 0
        for field in fields:
            steps, rows = np.nonzero(bad[..., start : start + field.size].any(-1))
            start += field.size
            if steps.size:
                numbers = np.unique(rows)
                some = ", ".join(map(str, numbers[:8]))
                yield (
                    f"{group} observation {field.name!r}: {numbers.size} of {bad.shape[1]} environments "
                    f"({some}), first at step {steps.min()}"
                )
    if count := int(metrics["nonfinite_rewards"]):
        yield f"rewards: {count} of {config.steps_per_iteration} (taken as 0)"
    for name in ("value", "next_value"):
        if count := int(jnp.sum(~jnp.isfinite(getattr(rollout, name)))):
            yield f"{name}: {count} of {config.steps_per_iteration}"


if __name__ == "__main__":
    cli.run(main)
