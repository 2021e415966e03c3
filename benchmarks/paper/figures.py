"""Figures of the experiments as SVG, made from the reports alone."""

from pathlib import Path
from typing import Any

import numpy as np

from paper.data import Experiment
from paper.tables import Reports, mean_turns, seeds

COLORS = ("#1f77b4", "#d95f02", "#2a9d5c", "#7b4fa3", "#8c6d31", "#555555", "#c0305e")


def _subplots(columns: int, width: float, height: float, rows: int = 1) -> tuple[Any, Any]:
    """A figure that no window shows, and its axes [rows, columns], or [columns] of one row."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width * columns, height * rows), layout="constrained")
    return figure, figure.subplots(rows, columns, squeeze=False)[0 if rows == 1 else slice(None)]


def _save(figure: Any, path: Path) -> None:
    import matplotlib

    # Without a date and random names the same reports give the same file.
    with matplotlib.rc_context({"svg.hashsalt": path.stem}):
        figure.savefig(path, metadata={"Date": None})


def successes(experiment: Experiment, reports: Reports, folder: Path) -> None:
    """The successes of all trials on the emulated hand in order, row by row, and the paper's."""
    figure, (axis,) = _subplots(1, 7.0, 3.6)
    for color, row in zip(COLORS, experiment.rows, strict=False):
        key = "paper_successes" if row.task == "rotate_paper" else "successes"
        counts = sorted(v for seed in seeds(reports.get(row.name)) for v in seed["hand"][key]["sorted"])
        if counts:
            share = (np.arange(len(counts)) + 0.5) / len(counts)
            axis.plot(share, counts, "o-", ms=4, lw=1.2, color=color, label=f"{row.label}, emulated hand")
        if row.paper.get("sorted"):
            numbers = [float(v) for v in row.paper["sorted"].split(",")]
            share = (np.arange(len(numbers)) + 0.5) / len(numbers)
            axis.plot(share, numbers, "s--", ms=3, lw=0.8, color=color, alpha=0.6, label=f"{row.label}, paper")
    axis.set(xlabel="share of the trials, sorted", ylabel="consecutive successes", xlim=(0, 1), ylim=(0, None))
    axis.legend(fontsize=7, frameon=False, loc="center left", bbox_to_anchor=(1.0, 0.5))
    _save(figure, folder / "successes.svg")


def touch_map(experiment: Experiment, reports: Reports, folder: Path) -> None:
    """Quarter turns of each world with touch and without it, a dot a seed."""
    pairs = list(zip(experiment.rows[::2], experiment.rows[1::2], strict=True))
    figure, axes = _subplots(3, 3.2, 6.0)
    for axis, world in zip(axes, ("simulation", "hand", "foreign"), strict=True):
        for place, pair in enumerate(pairs):
            means = [[mean_turns(s, world)["mean"] for s in seeds(reports.get(row.name))] for row in pair]
            for color, values in zip(COLORS, means, strict=False):
                axis.plot(values, [place] * len(values), ".", color=color, ms=5)
                axis.plot([np.mean(values or np.nan)], [place], "|", color=color, ms=12)
        title = {"hand": "emulated hand", "foreign": "foreign plant"}.get(world, world)
        axis.set(title=title, xlabel="quarter turns in 120 s", yticks=[], ylim=(len(pairs), -1), xlim=(0, None))
    axes[0].set_yticks(range(len(pairs)), [row.label for row, _ in pairs], fontsize=7)
    figure.supxlabel("blue: with touch; orange: without; a dot a training seed", fontsize=8)
    _save(figure, folder / "touch_map.svg")


def command_curves(experiment: Experiment, reports: Reports, folder: Path) -> None:
    """Force and torque over the command in both worlds: means with bands."""
    figure, axes = _subplots(3, 3.4, 3.0)
    names = {
        "finger_force_n": "finger force [N]",
        "total_force_n": "total force [N]",
        "total_torque": "total torque [share of the limit]",
    }
    for axis, (name, label) in zip(axes, names.items(), strict=True):
        for color, row in zip(COLORS, experiment.rows, strict=False):
            for world, style in (("simulation", "-"), ("hand", "--")):
                results = [seed[world]["by_command"] for seed in seeds(reports.get(row.name))]
                if results:
                    command, middle, low, high = _curve(results, name)
                    text = f"{row.label}, {'emulated hand' if world == 'hand' else world}"
                    axis.plot(command, middle, style, color=color, lw=1.5, label=text)
                    axis.fill_between(command, low, high, color=color, alpha=0.15, lw=0)
        axis.set(xlabel="force command", ylabel=label, ylim=(0, None))
    lines, labels = axes[0].get_legend_handles_labels()
    figure.legend(lines, labels, fontsize=7, frameon=False, loc="outside lower center", ncols=3)
    _save(figure, folder / "force_and_torque.svg")


def _curve(rows: list[list[dict[str, Any]]], name: str) -> tuple[np.ndarray, ...]:
    """Commands, mean, lower and upper end of the band: the interval of one seed, the span of several."""
    command = np.array([row["command"] for row in rows[0]])
    # [seeds, commands] each; None becomes NaN.
    mean, low, high = (np.array([[r[name][k] for r in seed] for seed in rows], float) for k in ("mean", "low", "high"))
    if len(rows) > 1:
        return command, mean.mean(0), mean.min(0), mean.max(0)
    return command, mean[0], low[0], high[0]
