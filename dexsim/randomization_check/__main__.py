"""Self-test of the randomisation: does drawing a range change the model, and then motion or readings?

    python -m dexsim.randomization_check --task grasp

Every range is drawn by itself, all others at their nominal values. The same starts and actions are run with and
without it. A range that changes nothing is an error (exit code 2): somewhere between the configuration and the physics
it was lost.
"""

import dataclasses
import sys
from collections.abc import Sequence
from typing import Literal

import jax

from dexsim.core import cli
from dexsim.core.compilation import jit
from dexsim.core.config import Config, setting
from dexsim.core.errors import ConfigError
from dexsim.randomization_check.effects import Effect, check


@dataclasses.dataclass(frozen=True, kw_only=True)
class CheckArguments(Config):
    """Show that every range of the randomisation has an effect."""

    task: str = "grasp"
    """Name of the task, which gets its default configuration; my_module:poke for a task of your own."""
    backend: Literal["auto", "c", "cuda", "mjx"] = setting("auto")
    """Physics backend. auto: c on a CPU, cuda on an NVIDIA GPU, otherwise mjx."""
    num_envs: int = setting(16, unit="1", low=2, high=65536)
    """Hands sampled for each range."""
    ticks: int = setting(12, unit="1", low=1, high=1000)
    """Control ticks to compare."""
    seed: int = setting(0, unit="1", low=0, high=2**32 - 2)
    """Seed of starts, samples and actions."""


def conclude(effects: Sequence[Effect]) -> int:
    """Print the table; the exit code."""
    print(f"{'range':34}{'joints':>13}{'object':>12}{'reading':>9}  what changed")
    for effect in effects:
        verdict = "off: no width" if effect.off else ", ".join(effect.changed) or "nothing"
        verdict = verdict if effect.works else f"NO EFFECT ({verdict})"
        motion = f"{1e3 * effect.joint:8.3f} mrad{1e3 * effect.object:9.3f} mm{effect.reading:9.4f}"
        print(f"{effect.name:34}{motion}  {verdict}")
    lost = [effect.name for effect in effects if not effect.works]
    if lost:
        print(f"error: no effect on model or motion: {', '.join(lost)}", file=sys.stderr)
    return 2 if lost else 0


def main(argv: Sequence[str] | None = None) -> int:
    """The command. Returns its exit code: 0, or 2 where a range has no effect."""
    from dexsim.registry import find_task, make

    description = "Show that every range of the randomisation has an effect."
    arguments = cli.parse(CheckArguments, argv, prog="python -m dexsim.randomization_check", description=description)
    entry = find_task(arguments.task)
    if entry.environment:
        raise ConfigError(f"--task {arguments.task}: is no task on a hand: it has no randomisation to check")
    config = dataclasses.replace(entry.config(), pool_size=80)
    env = make(arguments.task, config, backend=arguments.backend)
    keys = jax.random.split(jax.random.key(arguments.seed), arguments.num_envs)
    states = jit(jax.vmap(env.reset), once=True)(keys)
    step = jit(jax.vmap(env.step), backend=env.backend)
    effects = check(env, step, states, key=jax.random.key(arguments.seed + 1), ticks=arguments.ticks)
    print(f"{arguments.task} on {env.backend}, {arguments.num_envs} hands, {arguments.ticks} ticks")
    return conclude(effects)


if __name__ == "__main__":
    cli.run(main)
