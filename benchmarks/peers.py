"""Ours beside its peers: PPO of brax on the same environments, physics of MJX and MuJoCo on the same grips.

    python benchmarks/peers.py --output peers.json
    python benchmarks/peers.py --environments pendulum --seeds 0
    python benchmarks/peers.py --environments --num-envs 1024           # physics alone

Learners have the same environments, networks, rollouts, passes and minibatches, and train in turn, a chunk of
iterations each; engines are timed in turn, too. So whatever else the machine does falls on all of them. Nothing is
read from a cache of compiled programs. Returns are of the same evaluation episodes, without exploration; their time
does not count. Figures are medians over seeds, with the range in brackets.

| column | content |
|---|---|
| compile | tracing, compilation, first states: the first two chunks, less two others |
| first update | from the start to the end of the first iteration |
| steps/s | environment steps a second of the median chunk |
| return | of the last chunk's policy |
"""

import argparse
import dataclasses
import json
import statistics
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from peers import physics
from peers.environments import make
from peers.learners import LEARNERS, contend
from rich.console import Console
from rich.table import Table

from dexsim.core import cli
from dexsim_ppo.learner.config import PPOConfig
from dexsim_ppo.training.presets import find_preset

COLUMNS = {
    "compile_s": "compile [s]",
    "first_update_s": "first update [s]",
    "steps_per_s": "steps/s",
    "return": "return",
}


def parse(argv: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "--environments", nargs="*", default=["pendulum", "hopper", "grasp"], help="pendulum, grasp or brax's names"
    )
    parser.add_argument("--brax-backend", default="spring", help="of brax's environments")
    parser.add_argument("--learners", nargs="+", default=list(LEARNERS), choices=list(LEARNERS))
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2])
    parser.add_argument("--num-envs", type=int, default=256)
    parser.add_argument("--rollout-length", type=int, default=16)
    parser.add_argument("--layers", nargs="+", type=int, default=[128, 128])
    parser.add_argument("--chunks", type=int, default=8, help="turns of each learner, at least 3")
    parser.add_argument("--iterations", nargs="+", type=int, default=[20, 20, 5], help="in a turn, an environment each")
    parser.add_argument("--episodes", type=int, default=64, help="of an evaluation")
    parser.add_argument("--engines", nargs="*", default=list(physics.WAYS), choices=list(physics.WAYS))
    parser.add_argument("--repeats", type=int, default=7, help="of an engine's timing; 0 leaves engines out")
    parser.add_argument("--output", type=Path, help="JSON file")
    options = parser.parse_args(argv)
    if len(options.iterations) == 1:
        options.iterations *= len(options.environments)
    if len(options.iterations) < len(options.environments):
        parser.error("--iterations: one number, or one for each environment")
    if options.chunks < 3:
        parser.error("--chunks: at least 3, since the first two are compilation besides")
    return options


def main(argv: Sequence[str] | None = None) -> int:
    options, console = parse(argv), Console()
    if options.output:
        cli.check_writable(options.output)
    report: dict[str, Any] = {"learners": {}, "engines": {}, "options": vars(options)} | cli.environment_report()
    for name, iterations in zip(options.environments, options.iterations, strict=False):
        config, rows = learning(options, name), {learner: list[dict]() for learner in options.learners}
        for seed in options.seeds:
            contest = make(name, options.brax_backend, options.num_envs)
            for learner, row in contend(
                options.learners, contest, config, seed, options.chunks, iterations, options.episodes
            ).items():
                rows[learner].append(row)
                print(json.dumps(cli.plain({"environment": name, "learner": learner, "seed": seed} | row)), flush=True)
        report["learners"][name] = {learner: summary(found) for learner, found in rows.items()}
        console.print(learner_table(name, report["learners"][name]))
        _write(options.output, report)
    if options.repeats:
        report["engines"] = physics.measure(options.num_envs, 40, options.repeats, options.engines)
        console.print(engine_table(report["engines"]))
    _write(options.output, report)
    return 0


def learning(options: argparse.Namespace, environment: str) -> PPOConfig:
    """Our defaults for this environment on a CPU, with the sizes asked for."""
    return dataclasses.replace(
        find_preset("cpu", environment).ppo,
        num_envs=options.num_envs,
        rollout_length=options.rollout_length,
        actor_layers=tuple(options.layers),
        critic_layers=tuple(options.layers),
    )


def summary(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Every figure by seed, and the return against wall-clock time of each."""
    names = [*COLUMNS, "slowest_over_fastest", "wall_s", "returns"]
    return {name: [row[name] for row in rows] for name in names}


def learner_table(environment: str, found: dict[str, dict[str, Any]]) -> Table:
    table = Table("learner", *COLUMNS.values(), "return after [s]", title=environment)
    for learner, row in found.items():
        walls, returns = (list(map(statistics.median, zip(*row[name], strict=True))) for name in ("wall_s", "returns"))
        curve = ", ".join(f"{value:.0f} ({wall:.0f})" for wall, value in zip(walls, returns, strict=True))
        table.add_row(learner, *(_spread(row[name]) for name in COLUMNS), curve)
    return table


def engine_table(found: dict[str, dict[str, Any]]) -> Table:
    table = Table("engine", "physics steps/s", "first result [s]", title="physics: a control tick of held grips")
    for name, row in found.items():
        table.add_row(name, f"{row['physics_steps_per_s']:,.0f}", f"{row['first_s']:.1f}")
    return table


def _spread(values: list[float]) -> str:
    return f"{statistics.median(values):,.1f} ({min(values):,.1f} to {max(values):,.1f})"


def _write(path: Path | None, report: dict[str, Any]) -> None:
    if path:
        options = {k: str(v) if isinstance(v, Path) else v for k, v in report["options"].items()}
        cli.write_json(path, report | {"options": options})


if __name__ == "__main__":
    cli.run(main)
