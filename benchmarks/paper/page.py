"""The page of results, `docs/results.md`, from the reports in the repository."""

import os
from pathlib import Path
from typing import Any

from paper.data import REPORTS, ROOT, Experiment, load_report, report_path, settings_of
from paper.tables import seeds

PAGE = ROOT / "docs" / "results.md"
_HEAD = """# Results beside the paper's

Made from the reports in `docs/results` by `python benchmarks/paper.py page`. The command under each table measures it
anew: `--list` shows what is done, `--budget gpu` trains longer and measures more, `--output docs/results` writes here.

The paper's numbers are from its real hand. No policy of ours has run on one yet: the emulated hand is another simulator
behind the bridge's own frames, with parameters outside training's ranges or of its own. Numbers in brackets: of one
seed the 95 % interval over episodes or trials, of several the lowest and highest seed. Every table names the commit
that it was measured at.
"""


def markdown(table: list[list[str]]) -> str:
    """A table as Markdown."""
    head, *rows = table
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(cells) + " |" for cells in lines)


def reports_of(experiment: Experiment, folder: Path) -> dict[str, dict[str, Any]]:
    """Reports by row name, of rows that have one that is still theirs."""
    found = {row.name: load_report(report_path(folder, experiment, row)) for row in experiment.rows}
    wanted = {row.name: settings_of(row) for row in experiment.rows}
    return {name: report for name, report in found.items() if report and report["row"] == wanted[name]}


def render(folder: Path = REPORTS) -> str:
    """The page, of the reports in a folder."""
    from paper.experiments import EXPERIMENTS

    parts = [_HEAD]
    for experiment in EXPERIMENTS.values():
        parts.append(_section(experiment, reports_of(experiment, folder), folder))
    return "\n".join(parts)


def _section(experiment: Experiment, reports: dict[str, dict[str, Any]], folder: Path) -> str:
    lines = [f"## {experiment.title}", ""]
    if experiment.table and reports:
        lines += [markdown(experiment.table(experiment, reports)), ""]
    if not reports:
        lines += ["Not measured yet.", ""]
    lines += [line for report in reports.values() for seed in seeds(report) for line in _summary(seed)]
    figures = sorted(path for path in (folder / experiment.name).rglob("*") if path.suffix in (".svg", ".jpg"))
    for path in figures:
        where = Path(os.path.relpath(path, PAGE.parent)).as_posix()
        lines += [f"![{experiment.title}: {path.stem.replace('_', ' ')}]({where})", ""]
    lines += [f"What differs: {experiment.differs}", ""]
    lines += [_source(experiment, reports), ""]
    return "\n".join(lines)


def _summary(seed: dict[str, Any]) -> list[str]:
    """What a report says in one sentence, if it does."""
    if "worst_deviation" in seed:
        return [f"The touch model deviates from the law in closed form by at most {seed['worst_deviation']:.2%}.", ""]
    report = seed.get("simulation", {})
    if len(report.get("by_shape", ())) < 20:  # The task's own shapes are fewer.
        return []
    worst = min(report["by_shape"], key=lambda row: row["held"]["mean"])
    held = f"{100 * report['held']['mean']:.1f} % of {report['episodes']} episodes are held"
    return [f"{held}. The worst object is the {worst['shape']}: {100 * worst['held']['mean']:.0f} %.", ""]


def _source(experiment: Experiment, reports: dict[str, dict[str, Any]]) -> str:
    """The command, and where and when it ran."""
    if not reports:
        return f"Command: `python benchmarks/paper.py {experiment.name} --budget gpu --output docs/results`."
    found = {
        (r["command"], r["commit"], r["date"], f"{r['hardware']['cpu_cores']} cores, {r['hardware']['device']}")
        for r in reports.values()
    }
    texts = [f"`{command}` at {commit}, {date}, {where}" for command, commit, date, where in sorted(found)]
    return f"Command: {'; '.join(texts)}."
