"""The command: which experiments, in which order, and what is left to do."""

import argparse
import datetime
import shutil
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from dexsim.core import cli
from dexsim.core.errors import ConfigError
from paper import page
from paper.data import (
    BUDGETS,
    Budget,
    Experiment,
    Row,
    commit,
    is_done,
    load_report,
    report_path,
    settings_of,
)
from paper.experiments import EXPERIMENTS

WORK = Path("runs") / "paper"
_STEPS_PER_MINUTE = 3e7
"""Of a training on one GPU, for the estimate of the time left."""


def main(argv: Sequence[str] | None = None) -> int:
    """The command. Returns its exit code."""
    given = parser().parse_args(argv)
    budget, output = BUDGETS[given.budget], given.output
    chosen = list(EXPERIMENTS.values()) if given.name == "all" else [EXPERIMENTS[given.name]]
    if unknown := set(given.row) - {row.name for experiment in chosen for row in experiment.rows}:
        raise ConfigError(f"--row {sorted(unknown)[0]}: not a row of {given.name}; --list names them")
    for experiment in chosen:
        if given.list:
            print("\n".join(listing(experiment, budget, output)))
        else:
            run(experiment, budget, output, WORK / budget.name, given.row)
    return 0


def parser() -> argparse.ArgumentParser:
    """Of the command line."""
    found = argparse.ArgumentParser(prog="python benchmarks/paper.py", description="The paper's tables and figures.")
    found.add_argument("name", choices=(*EXPERIMENTS, "all"), help="table or figure")
    found.add_argument("--budget", choices=tuple(BUDGETS), default="cpu", help="smoke, two cores, or one GPU")
    found.add_argument("--list", action="store_true", help="rows, what is done, and an estimate of the time left")
    found.add_argument("--row", nargs="+", default=[], help="these rows alone, so that several GPUs share a table")
    found.add_argument(
        "--output", type=Path, default=WORK / "reports", help="folder of reports, tables and figures (docs/results)"
    )
    return found


def listing(experiment: Experiment, budget: Budget, output: Path) -> Iterator[str]:
    """Lines: the experiment with the time left, and each row with what is done."""
    lines, left = [], 0.0
    for row in experiment.rows:
        report, seeds = load_report(report_path(output, experiment, row)), len(experiment.seeds(budget))
        done = seeds if is_done(experiment, row, budget, report) else len(_kept(experiment, row, budget, report))
        state = f"{done} of {seeds} seeds" if experiment.trains else ("done" if done else "not measured")
        if report and done == seeds:
            state += f", {report['budget']} budget at {report['commit']}"
        left += (seeds - done) * minutes_of(experiment, row, budget)
        lines.append(f"  {row.name:<28} {state:<40} {row.label}")
    yield f"{experiment.name}: {experiment.title}; about {left:.0f} min left"
    yield from lines


def minutes_of(experiment: Experiment, row: Row, budget: Budget) -> float:
    """Estimate for one seed of a row."""
    if budget.name == "smoke":
        return 0.2
    if not experiment.trains:
        return experiment.minutes
    training = budget.training[row.skill]
    return experiment.minutes + training.get("minutes", training.get("steps", 0.0) / _STEPS_PER_MINUTE)


def _kept(experiment: Experiment, row: Row, budget: Budget, report: dict[str, Any]) -> dict[str, Any]:
    """Seeds of an unfinished report that count for this budget."""
    same = report and report["row"] == settings_of(row) and report["budget"] == budget.name
    return dict(report["seeds"]) if same else {}


def run(experiment: Experiment, budget: Budget, output: Path, work: Path, only: Sequence[str] = ()) -> list[Path]:
    """Measure what is missing, row by row and seed by seed; then write the table and the figures.

    Args:
      only: names of the rows to measure; none: all.

    Returns:
      The files written at the end.

    Raises:
      DexsimError: a training or a measurement failed; what was done before it is kept.
    """
    cli.enable_caches()
    commit()  # of the code that is loaded now
    for row in experiment.rows:
        path = report_path(output, experiment, row)
        report = load_report(path)
        if (only and row.name not in only) or is_done(experiment, row, budget, report):
            continue
        seeds = _kept(experiment, row, budget, report)
        for seed in experiment.seeds(budget):
            if str(seed) in seeds:
                continue
            print(f"{experiment.name}: {row.label}, seed {seed}", file=sys.stderr, flush=True)
            started = time.perf_counter()
            found = experiment.measure(row, seed, budget, work / experiment.name / row.name / f"seed{seed}")
            path.parent.mkdir(parents=True, exist_ok=True)
            for file in found.pop("files", []):
                shutil.copy(file, path.parent)
            seeds[str(seed)] = found | {"wall_s": round(time.perf_counter() - started, 1)}
            cli.write_json(
                path,
                {
                    "experiment": experiment.name,
                    "row": settings_of(row),
                    "budget": budget.name,
                    "command": f"python benchmarks/paper.py {experiment.name} --budget {budget.name}",
                    "commit": commit(),
                    "date": f"{datetime.date.today()}",
                    "seeds": seeds,
                }
                | cli.environment_report(),
            )
    return finish(experiment, output)


def finish(experiment: Experiment, output: Path) -> list[Path]:
    """Write table and figures of the rows that have a report."""
    reports = page.reports_of(experiment, output)
    written = experiment.draw(experiment, reports, output / experiment.name) if experiment.draw and reports else []
    if experiment.table:
        text = page.markdown(experiment.table(experiment, reports))
        path = output / experiment.name / "table.md"
        path.write_text(text + "\n")
        written.append(path)
        print(f"{experiment.title}\n\n{text}\n")
    for path in written:
        print(path)
    return written
