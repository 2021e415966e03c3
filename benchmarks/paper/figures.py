"""Figures of the experiments as SVG, made from the reports alone."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from paper.data import Experiment
from paper.tables import seeds

Reports = dict[str, dict[str, Any]]
COLORS = ("#1f77b4", "#d95f02", "#2a9d5c", "#7b4fa3", "#8c6d31", "#555555", "#c0305e")


def _subplots(rows: int, columns: int, width: float, height: float) -> tuple[Any, Any]:
    """A figure that no window shows, and its axes [rows, columns]."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width * columns, height * rows), layout="constrained")
    return figure, figure.subplots(rows, columns, squeeze=False)


def _save(figure: Any, path: Path) -> list[Path]:
    import matplotlib

    # Without a date and random names the same reports give the same file.
    with matplotlib.rc_context({"svg.hashsalt": path.stem}):
        figure.savefig(path, metadata={"Date": None})
    return [path]


def copied(experiment: Experiment, reports: Reports, folder: Path) -> list[Path]:
    """Figures that the measurement itself has drawn."""
    return sorted(path for name in reports for path in (folder / name).iterdir() if path.suffix in (".svg", ".jpg"))


def successes(experiment: Experiment, reports: Reports, folder: Path) -> list[Path]:
    """The successes of all trials on the emulated hand in order, row by row, and the paper's."""
    figure, axes = _subplots(1, 1, 7.0, 3.6)
    axis = axes[0, 0]
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
    return _save(figure, folder / "successes.svg")


def command_curves(experiment: Experiment, reports: Reports, folder: Path) -> list[Path]:
    """Force and torque over the command in both worlds: means with bands."""
    figure, axes = _subplots(1, 3, 3.4, 3.0)
    names = (
        ("finger force [N]", "finger_force_n", "finger_force"),
        ("total force [N]", "total_force_n", "total_force"),
        ("total torque [share of the limit]", "total_torque", "total_torque"),
    )
    for axis, (label, *keys) in zip(axes[0], names, strict=True):
        for color, row in zip(COLORS, experiment.rows, strict=False):
            for world, style in (("simulation", "-"), ("hand", "--")):
                command, middle, low, high = _curve(seeds(reports.get(row.name)), world, keys)
                if len(command):
                    text = f"{row.label}, {'emulated hand' if world == 'hand' else world}"
                    axis.plot(command, middle, style, color=color, lw=1.5, label=text)
                    axis.fill_between(command, low, high, color=color, alpha=0.15, lw=0)
        axis.set(xlabel="force command", ylabel=label, ylim=(0, None))
    axes[0, 0].legend(fontsize=7, frameon=False)
    return _save(figure, folder / "force_and_torque.svg")


def _curve(found: list[dict[str, Any]], world: str, keys: list[str]) -> tuple[np.ndarray, ...]:
    """Commands, mean, lower and upper end of the band: the interval of one seed, the span of several."""
    tables = [
        [(row["command"], next(row[key] for key in keys if key in row)) for row in seed[world]["by_command"]]
        for seed in found
    ]
    if not tables:
        return (np.zeros(0),) * 4
    command = np.array([c for c, _ in tables[0]])
    values = np.array(
        [
            [[entry[name] if entry[name] is not None else np.nan for name in ("mean", "low", "high")] for _, entry in t]
            for t in tables
        ]
    )
    middle = values[..., 0].mean(0)
    if len(tables) > 1:
        return command, middle, values[..., 0].min(0), values[..., 0].max(0)
    return command, middle, values[0, :, 1], values[0, :, 2]


def skin(experiment: Experiment, reports: Reports, folder: Path) -> list[Path]:
    """Stress over compression: the touch model on the law, and silicones."""
    figure, axes = _subplots(1, 2, 4.2, 3.2)
    found = next(iter(reports.values()))["seeds"]["0"]
    strain, curves = 100 * np.array(found["compression"]), found["curves_pa"]
    felt = np.array([(100 * p["compression"], p["stress_pa"]) for p in found["felt"]])
    left, right = axes[0]
    left.plot(strain, 1e-3 * np.array(curves["skin"]), color=COLORS[0], label="Mooney–Rivlin")
    left.plot(strain, 1e-3 * np.array(curves["linear"]), "--", color="0.5", label="slope at small strain")
    left.plot(felt[:, 0], 1e-3 * felt[:, 1], "o", ms=3, color=COLORS[1], label="taxel under a flat face")
    for color, name in zip(COLORS, (n for n in curves if n not in ("skin", "linear")), strict=False):
        right.plot(strain[1:], 1e-3 * np.array(curves[name])[1:], color=color, label=name.replace("_", " "))
    right.set_yscale("log")
    for axis, title in ((left, "the hand's skin"), (right, "silicones")):
        axis.set(xlabel="compression [%]", ylabel="stress [kPa]", title=title)
        axis.legend(fontsize=7, frameon=False)
    return _save(figure, folder / "stress_strain.svg")


def contacts(experiment: Experiment, reports: Reports, folder: Path) -> list[Path]:
    """Contact centres on the lattice, and forces over time, of both worlds."""
    found = next(iter(reports.values()))["seeds"]["0"]
    times = np.array(found["times"])
    fingers = len(found["hand"]["force_n"][0])
    figure, axes = _subplots(2, fingers, 2.1, 2.6)
    for color, world, label in ((COLORS[0], "simulation", "simulation"), (COLORS[1], "hand", "emulated hand")):
        force = np.array(found[world]["force_n"])
        for finger in range(fingers):
            centres = np.array([c for row in found[world]["centre"] if (c := row[finger])] or np.zeros((0, 2)))
            above, below = axes[:, finger]
            above.plot(centres[:, 0], centres[:, 1], ".", ms=4, alpha=0.4, color=color, label=label)
            below.plot(times, force[:, finger], lw=1.2, color=color)
            above.set(title=_FINGERS[finger], xlim=(-0.7, 9.7), ylim=(-0.7, 11.7), xlabel="column", aspect="equal")
    highest = max(np.percentile(np.array(found[world]["force_n"]), 99.5) for world in ("simulation", "hand"))
    for axis in axes[1]:
        axis.set(xlabel="time [s]", ylim=(0, 1.05 * highest))
    axes[0, 0].set_ylabel("row (tip at the top)")
    axes[1, 0].set_ylabel("force on the taxels [N]")
    axes[0, 0].legend(fontsize=7, frameon=False)
    return _save(figure, folder / "contacts.svg")


_FINGERS = ("thumb", "index", "middle", "ring", "pinky")


def sweeps(experiment: Experiment, reports: Reports, folder: Path) -> list[Path]:
    """Small multiples for each skill: success with its interval over each parameter."""
    written = []
    for skill in ("grasp", "rotate"):
        rows = [row for row in experiment.rows if row.skill == skill and row.points]
        shown = [row for row in rows if row.name in reports]
        if not shown:
            continue
        columns = min(len(shown), 5)
        figure, axes = _subplots(-(-len(shown) // columns), columns, 2.3, 2.1)
        for axis in axes.ravel()[len(shown) :]:
            axis.axis("off")
        reference = next(_points(reports.get(f"{skill}_reference"), skill), None)
        for axis, row in zip(axes.ravel(), shown, strict=False):
            points = np.array(list(_points(reports[row.name], skill)), float).reshape(-1, 4)
            off = np.maximum(np.abs(points[:, 2:].T - points[:, 1]), 0.0)
            axis.errorbar(
                points[:, 0],
                points[:, 1],
                off,
                fmt="o-" if len(points) > 2 else "o",
                ms=3,
                lw=1.2,
                capsize=2,
                color=COLORS[0],
            )
            if reference:
                axis.axhline(reference[1], ls=":", color="0.5", lw=1)
                axis.axhspan(reference[2], reference[3], color="0.5", alpha=0.12, lw=0)
            if row.training:
                axis.axvspan(*row.training, color=COLORS[2], alpha=0.10, lw=0)
            axis.set_xlabel(row.label.partition(": ")[2], fontsize=8)
            axis.tick_params(labelsize=7)
            axis.set_ylim(0, None if skill == "rotate" else 104)
        for axis in axes[:, 0]:
            axis.set_ylabel("held [%]" if skill == "grasp" else "turns a minute", fontsize=8)
        written += _save(figure, folder / f"{skill}.svg")
    return written


def _points(report: dict[str, Any] | None, skill: str) -> Iterator[tuple[float, float, float, float]]:
    """Value of the parameter, success, and its interval."""
    for point in (point for seed in seeds(report) for point in seed["points"]):
        entry, factor = (point["held"], 100) if skill == "grasp" else (point["successes_per_minute"], 1)
        if entry["mean"] is not None:
            where = np.nan if point["point"] is None else point["point"]
            yield where, factor * entry["mean"], factor * entry["low"], factor * entry["high"]
