"""The command: measure what is missing, row by row and seed by seed; write tables and figures."""

import argparse
import datetime
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from dexsim.core import cli
from dexsim.errors import ConfigError
from paper.data import BUDGETS, Budget, Experiment, commit, load_report, missing_seeds, report_path, settings_of
from paper.experiments import EXPERIMENTS

WORK = Path("runs") / "paper"


def main(argv: Sequence[str] | None = None) -> int:
    """The command. Returns its exit code."""
    parser = argparse.ArgumentParser(prog="python benchmarks/paper.py", description="The paper's tables and figures.")
    parser.add_argument("name", choices=(*EXPERIMENTS, "all"), help="a table")
    parser.add_argument("--budget", choices=tuple(BUDGETS), default="cpu", help="smoke, two cores, or one GPU")
    parser.add_argument("--row", nargs="+", default=[], help="these rows alone, so that several GPUs share a table")
    parser.add_argument("--output", type=Path, default=WORK / "reports", help="folder of reports and tables")
    given = parser.parse_args(argv)
    budget, chosen = BUDGETS[given.budget], EXPERIMENTS.values() if given.name == "all" else [EXPERIMENTS[given.name]]
    rows = [row.name for experiment in chosen for row in experiment.rows]
    if unknown := set(given.row) - set(rows):
        raise ConfigError(f"--row {sorted(unknown)[0]}: choose from {', '.join(rows)}")
    for experiment in chosen:
        run(experiment, budget, given.output, WORK / budget.name, given.row)
    return 0


def run(experiment: Experiment, budget: Budget, output: Path, work: Path, only: Sequence[str] = ()) -> None:
    """Measure what is missing; then write the table and the figures of all rows that have a report.

    Args:
      only: names of the rows to measure; none: all.

    Raises:
      DexsimError: a training or a measurement failed; what was done before it is kept.
    """
    cli.enable_caches()
    commit()  # of the code that is loaded now
    for row in experiment.rows:
        path = report_path(output, experiment, row)
        report = load_report(path)
        missing = missing_seeds(experiment, row, budget, report) if not only or row.name in only else []
        seeds = {} if len(missing) == len(experiment.seeds(budget)) else dict(report.get("seeds", {}))
        for seed in missing:
            print(f"{experiment.name}: {row.label}, seed {seed}", file=sys.stderr, flush=True)
            started = time.perf_counter()
            result = experiment.measure(row, seed, budget, work / experiment.name / row.name / f"seed{seed}")
            seeds[str(seed)] = result | {"wall_s": round(time.perf_counter() - started, 1)}
            about = {
                "experiment": experiment.name,
                "row": settings_of(row),
                "budget": budget.name,
                "command": f"python benchmarks/paper.py {experiment.name} --budget {budget.name}",
                "commit": commit(),
                "date": f"{datetime.date.today()}",
            }
            path.parent.mkdir(parents=True, exist_ok=True)
            cli.write_json(path, about | {"seeds": seeds} | cli.environment_report())
    reports, folder = reports_of(experiment, output), output / experiment.name
    if experiment.draw and reports:
        experiment.draw(experiment, reports, folder)
    text = markdown(experiment.table(experiment, reports))
    (folder / "table.md").write_text(text + "\n")
    print(f"{experiment.title}\n\n{text}\n")


def reports_of(experiment: Experiment, folder: Path) -> dict[str, dict[str, Any]]:
    """Reports by row name, of rows that have one that is still theirs."""
    reports = {row.name: load_report(report_path(folder, experiment, row)) for row in experiment.rows}
    settings = {row.name: settings_of(row) for row in experiment.rows}
    return {name: report for name, report in reports.items() if report and report["row"] == settings[name]}


def markdown(table: list[list[str]]) -> str:
    """A table as Markdown."""
    head, *rows = table
    return "\n".join("| " + " | ".join(cells) + " |" for cells in [head, ["---"] * len(head), *rows])
