"""The trainings of several seeds as one result: their spread, and a curve with a band."""

import statistics
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from dexsim.core import cli
from dexsim_ppo.training.runlog import CURVES, RunFolder, read_metrics

MEASURES = ("held", "return", "steps_held")


def write_summary(folder: Path, task: str, reports: dict[int, dict[str, Any]], command: str) -> Path:
    """Write `report.json` and `curve.png` of several seeds; the path of the report.

    Args:
      folder: holds a run `seed-<seed>` for each seed.
      reports: `report.json` of each seed.
    """
    runs = {seed: RunFolder(seed_folder(folder, seed)) for seed in reports}
    values = {name: [report["trained"][name]["value"] for report in reports.values()] for name in MEASURES}
    path = folder / "report.json"
    cli.write_json(
        path,
        {
            "task": task,
            "seeds": list(reports),
            "trained": {name: spread(found) for name, found in values.items()},
            "policies": {seed: f"{runs[seed].path.name}/{report['policy']}" for seed, report in reports.items()},
            "command": command,
        }
        | cli.environment_report(),
    )
    draw_band([read_metrics(run.metrics) for run in runs.values()], folder / "curve.png", task)
    return path


def seed_folder(folder: Path, seed: int) -> Path:
    """Where one seed's run is."""
    return folder / f"seed-{seed}"


def spread(values: Sequence[float | None]) -> dict[str, Any]:
    """Mean, sample standard deviation, extremes and the values themselves, one for each seed; None, as a report has it
    for a figure that is not finite, counts in the values alone."""
    known = [value for value in values if value is not None]
    return {
        "mean": statistics.fmean(known) if known else None,
        "std": statistics.stdev(known) if len(known) > 1 else None,
        "min": min(known, default=None),
        "max": max(known, default=None),
        "values": list(values),
    }


def band(runs: Sequence[list[dict[str, Any]]], name: str) -> np.ndarray:
    """Environment steps, lowest, mean and highest value [4, N] of a metric at the steps that all runs have logged."""
    found = [
        {row["env_steps"]: row[name] for row in rows if row.get(name) is not None and np.isfinite(row[name])}
        for rows in runs
    ]
    steps = sorted(set.intersection(*map(set, found)))
    values = np.array([[run[step] for step in steps] for run in found])
    return np.stack([np.array(steps, float), values.min(0), values.mean(0), values.max(0)])


def draw_band(runs: Sequence[list[dict[str, Any]]], path: Path, title: str) -> None:
    """Learning curves over environment steps as a PNG: mean of the runs, and a band from the lowest to the highest."""
    import matplotlib

    matplotlib.use("agg")
    import matplotlib.pyplot as plt

    bands = {name: found for name in CURVES if (found := band(runs, name)).size}
    if not bands:
        return
    figure, axes = plt.subplots(
        len(bands), 1, figsize=(7, 1.9 * len(bands)), sharex=True, squeeze=False, layout="constrained"
    )
    for ax, (name, (steps, low, mean, high)) in zip(axes[:, 0], bands.items(), strict=True):
        ax.fill_between(1e-6 * steps, low, high, alpha=0.25, lw=0)
        ax.plot(1e-6 * steps, mean, lw=1.2)
        ax.set_ylabel(CURVES[name])
        ax.grid(alpha=0.3)
        ax.spines[["top", "right"]].set_visible(False)
    axes[0, 0].set_title(f"{title}: mean and range of {len(runs)} seeds", loc="left")
    axes[-1, 0].set_xlabel("environment steps [million]")
    figure.savefig(path, dpi=120)
    plt.close(figure)
