"""Averages the weights of policies that were fine-tuned from one, or of one run's checkpoints.

    python -m dexsim_ppo.average runs/a runs/b --output rotate.msgpack

What the policies share stays, and much of what each has learned by chance goes; the result runs as fast as one of them
(Wortsman et al. 2022, "Model soups"; Nikishin et al. 2018, "Improving stability in deep reinforcement learning with
weight averaging").
"""

import dataclasses
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import jax
import numpy as np
import tyro

from dexsim.core import cli
from dexsim.core.config import from_dict
from dexsim.core.errors import ConfigError
from dexsim_ppo import checkpoint
from dexsim_ppo.acting import PolicyParams
from dexsim_ppo.learner.config import PPOConfig
from dexsim_ppo.learner.memory import carry_size
from dexsim_ppo.learner.running_stats import make_normalizer, recover_stats
from dexsim_ppo.policy import Policy, check_finite, load_policy
from dexsim_ppo.training.runlog import RunFolder

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
    form = _form(first)
    for number, other in enumerate(others, start=2):
        if different := [name for name, value in _form(other).items() if value != form[name]]:
            raise ConfigError(f"policy {number} differs from the first in {', '.join(different)}")
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


def policies_of(run: str | Path) -> dict[Path, Policy]:
    """The policies of the checkpoints that a run has kept (`--keep-checkpoints`), oldest first.

    Raises:
      CheckpointError: there is no checkpoint, or one or the last policy is missing or unsound.
    """
    folder = RunFolder(Path(run))
    folder.latest_checkpoint()
    last = load_policy(folder.last)
    return {path: _policy_at(path, last) for path in folder.existing_checkpoints()}


def _policy_at(path: Path, last: Policy) -> Policy:
    """The policy of a checkpoint, in the form of its run's last one."""
    config, like = from_dict(PPOConfig, last.training["ppo"]), last.params
    file = checkpoint.load(path, kind="train", task=last.task)
    actor = checkpoint.restore(file, like.layers, ".params.actor")
    memory = checkpoint.restore(file, like.memory, ".params.memory")
    floor, clip = config.observation_std_floor, like.normalizer.clip
    stats = recover_stats(like.normalizer, std_floor=floor)
    stats = checkpoint.restore(file, stats, ".observation_stats['actor']")
    normalizer = make_normalizer(stats, last.observation_layout, std_floor=floor, clip=clip)
    params = PolicyParams(actor, normalizer, memory)
    check_finite(params, path)
    iteration = int(file.leaves[".iteration"])
    origin = {"iteration": iteration, "env_steps": iteration * config.steps_per_iteration}
    return dataclasses.replace(last, params=params, training=last.training | origin)


def _form(policy: Policy) -> dict[str, Any]:
    """What averaged policies must have in common."""
    header = {name: value for name, value in policy.header().items() if name not in ("training", "env_config")}
    network = {"network": [layer.kernel.shape for layer in policy.params.layers]}
    return {"task": policy.task} | header | network | {"memory": carry_size(policy.params.memory)}


@dataclasses.dataclass(frozen=True, kw_only=True)
class AverageArguments:
    """Options of `python -m dexsim_ppo.average`."""

    policies: Annotated[tuple[str, ...], tyro.conf.Positional]
    """Policies: files, names of shipped ones, or folders of runs, which stand for the checkpoints that they have kept.
    The average has the configuration of the first."""
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
    # A run's last policy says how those of its checkpoints are made.
    inputs = [RunFolder(Path(name)).last if Path(name).is_dir() else name for name in arguments.policies]
    cli.check_apart({"--output": arguments.output}, {f"policy {file}": file for file in inputs})
    policies: list[tuple[str | Path, Policy]] = []
    for name in arguments.policies:
        policies += policies_of(name).items() if Path(name).is_dir() else [(name, load_policy(name))]
    try:
        average = average_policies([policy for _, policy in policies])
    except ConfigError as error:
        raise ConfigError(f"{' '.join(arguments.policies)}: {error}") from None
    average.save(arguments.output)
    for path, policy in policies:
        print(f"{path}: {distance(average, policy):.1%} away from the average")
    print(f"{arguments.output}: evaluate it with python -m dexsim_ppo.evaluate {arguments.output}")
    return 0


if __name__ == "__main__":
    cli.run(main)
