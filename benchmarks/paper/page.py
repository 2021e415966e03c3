"""Reports of the experiments as Markdown tables."""

from pathlib import Path
from typing import Any

from paper.data import Experiment, load_report, report_path, settings_of


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
