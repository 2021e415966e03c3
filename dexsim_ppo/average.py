"""Averages the weights of policies that were fine-tuned from one, or of one run's checkpoints.

    python -m dexsim_ppo.average runs/a/best.msgpack runs/b/best.msgpack --output rotate.msgpack

What the policies share stays, and much of what each has learned by chance goes; the result runs as fast as one of them
(Wortsman et al. 2022, "Model soups"; Nikishin et al. 2018, "Improving stability in deep reinforcement learning with
weight averaging").
"""

import dataclasses
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import jax
import numpy as np
import tyro

from dexsim.core import cli
from dexsim.core.errors import ConfigError
from dexsim_ppo.policy import Policy, load_policy

# Two fine-tunings of rotate are 0.17 apart, checkpoints of one training 0.38, policies that were trained from scratch
# 1.3 to 2 (record average-39971f3-distances).
FARTHEST = 1.0


def average_policies(policies: Sequence[Policy]) -> Policy:
    """The policy whose weights and observation normaliser are the mean of theirs.

    Its configuration is that of the first; its `training` lists theirs. It may be worse than they are: evaluate it.

    Raises:
      ConfigError: fewer than two; of different tasks, hands, observations or networks; or of no common origin.
    """
    if len(policies) < 2:
        raise ConfigError("an average needs two policies or more")
    first, *others = policies
    for number, other in enumerate(others, start=2):
        for name in ("task", "observation_layout", "control_rate", "hand", "spec"):
            if getattr(other, name) != getattr(first, name):
                raise ConfigError(f"policy {number} differs from the first in its {name}")
        if jax.tree.map(np.shape, other.params) != jax.tree.map(np.shape, first.params):
            raise ConfigError(f"policy {number} differs from the first in its network")
        if (share := distance(first, other)) > FARTHEST:
            raise ConfigError(
                f"policy {number} has no common origin with the first: weights differ by {share:.0%} of their size"
            )
    params = jax.tree.map(
        lambda *leaves: np.mean(leaves, 0, dtype=float).astype(np.float32), *[p.params for p in policies]
    )
    return dataclasses.replace(first, params=params, training={"average_of": [p.training for p in policies]})


def distance(one: Policy, other: Policy) -> float:
    """How far apart the weights of two networks of the same form are, over the size of their mean."""
    a, b = (
        np.concatenate([np.ravel(leaf).astype(float) for leaf in jax.tree.leaves((p.params.layers, p.params.memory))])
        for p in (one, other)
    )
    return float(np.linalg.norm(a - b) / (np.linalg.norm(a + b) / 2 + 1e-12))


@dataclasses.dataclass(frozen=True, kw_only=True)
class AverageArguments:
    """Options of `python -m dexsim_ppo.average`."""

    policies: Annotated[tuple[str, ...], tyro.conf.Positional]
    """Policies: files, or names of shipped ones. The average has the configuration of the first."""
    output: Path
    """File to write."""


def main(argv: Sequence[str] | None = None) -> int:
    """The command. Returns its exit code, 0."""
    arguments = cli.parse(
        AverageArguments,
        sys.argv[1:] if argv is None else argv,
        prog="python -m dexsim_ppo.average",
        description="Average the weights of policies that were fine-tuned from one, or of one run's checkpoints.",
    )
    cli.check_writable(arguments.output)
    cli.check_no_overwrite({"--output": arguments.output}, {f"policy {name}": name for name in arguments.policies})
    policies = [load_policy(name) for name in arguments.policies]
    average = average_policies(policies)
    average.save(arguments.output)
    for name, policy in zip(arguments.policies, policies, strict=True):
        print(f"{name}: {distance(average, policy):.1%} away from the average")
    print(f"{arguments.output}: evaluate it with python -m dexsim_ppo.evaluate {arguments.output}")
    return 0


if __name__ == "__main__":
    cli.run(main)
