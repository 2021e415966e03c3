"""A run's folder: configuration, metrics, checkpoints, policies and the learning curve."""

import contextlib
import fcntl
import importlib
import itertools
import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from dexsim.core.cli import plain
from dexsim.core.files import write_atomic
from dexsim.errors import CheckpointError, ConfigError
from dexsim_ppo.checkpoint import Checkpoint
from dexsim_ppo.policy import load_policy
from dexsim_ppo.training.arguments import TrainArguments, printable

METRICS = {
    "episode/return": ("return", ".2f"),
    "episode/success": ("success", ".1%"),
    "episode/successes": ("goals", ".1f"),
    "episode/length": ("length [ticks]", ".0f"),
    "reward": ("reward", ".3f"),
    "step/force_error": ("force error [N]", ".3f"),
    "step/angle_error": ("angle error [rad]", ".3f"),
    "kl": ("KL", ".4f"),
    "learning_rate": ("lr", ".1e"),
    "action_std": ("std", ".2f"),
}
"""Heading and format of the metrics that are shown; those that the task does not have are left out."""

_FAULTS = ("skipped_updates", "nonfinite_rewards", "bounded_rewards")  # shown where they are not zero


class RunFolder:
    """`runs/<task>-<time>/` and its files."""

    def __init__(self, path: Path):
        self.path = path
        self.checkpoints = path / "checkpoints"
        self.metrics = path / "metrics.jsonl"
        self.best, self.last = path / "best.msgpack", path / "last.msgpack"
        self.report, self.config = path / "report.json", path / "config.json"

    def checkpoint(self, iteration: int) -> Path:
        """File of the checkpoint after this many iterations."""
        return self.checkpoints / f"{iteration:08d}.msgpack"

    def existing_checkpoints(self) -> list[Path]:
        """Oldest first."""
        return sorted(self.checkpoints.glob("[0-9]" * 8 + ".msgpack"))

    def latest_checkpoint(self) -> Path:
        """The newest checkpoint; raises CheckpointError if there is none."""
        if not (paths := self.existing_checkpoints()):
            again = f"; --config {self.path} starts a new run with its options" if self.config.exists() else ""
            raise CheckpointError(f"{self.path}: has no checkpoint to resume from{again}")
        return paths[-1]

    def prune(self, keep: int) -> None:
        """Delete all but the newest `keep` checkpoints, and their policies; what a killed process had half written."""
        for path in self.existing_checkpoints()[:-keep]:
            policy_of(path).unlink(missing_ok=True)
            path.unlink()
        for path in self.checkpoints.glob(".*.dexsim-part"):
            path.unlink()

    def lock(self) -> contextlib.ExitStack:
        """Keep other processes from training this run, until the result is closed or this process ends. Raises
        ConfigError if another process trains it already."""
        stack = contextlib.ExitStack()
        with contextlib.suppress(OSError):  # Some file systems have no locks, and some lock only what one may write.
            file = stack.enter_context(self.config.open("rb+"))
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                stack.close()
                raise ConfigError(f"{self.path}: another process is training this run") from None
        return stack

    def keep_report(self) -> None:
        """Number the report of a run that had ended before and was resumed: another must not replace it."""
        if self.report.exists():
            self.report.rename(_free(self.path, "report-{}.json"))

    def set_aside(self, resumed: Checkpoint) -> None:
        """Move what is of another course than this checkpoint to `*.aside*`: newer checkpoints, or all where it was set
        aside itself, their metrics, and the best policy, unless the checkpoint knows it."""
        paths, path = self.existing_checkpoints(), self.checkpoints / resumed.path.name
        later = paths[paths.index(path) + 1 :] if path in paths else paths
        later += [policy for path in later if (policy := policy_of(path)).exists()]
        later += [self.metrics] if later and self.metrics.exists() else []
        later += [self.best] if self.best.exists() and not self.has_best(resumed) else []
        for path in later:
            path.rename(_free(path.parent, path.stem + ".aside{}" + path.suffix))

    def has_best(self, resumed: Checkpoint) -> bool:
        """Whether the best policy that this checkpoint knows is here."""
        iteration = resumed.content["progress"]["best"]["iteration"]
        return self.best.exists() and load_policy(self.best).training.get("iteration") == iteration


def policy_of(checkpoint: Path) -> Path:
    """File of the policy of a checkpoint."""
    return checkpoint.with_suffix(".policy.msgpack")


def _free(folder: Path, pattern: str) -> Path:
    """The first name of a pattern with a number in it that is free in a folder."""
    paths = (folder / pattern.format(number) for number in itertools.count(1))
    return next(path for path in paths if not path.exists())


class MetricsLog:
    """Appends one line of JSON per logged iteration; the same goes to TensorBoard, if a writer is installed, and to
    Weights & Biases, if the options name a project."""

    def __init__(self, folder: RunFolder, arguments: TrainArguments, resumed: Checkpoint | None):
        self._closing = folder.lock()
        rows = read_metrics(folder.metrics)
        if resumed:
            folder.set_aside(resumed)  # It repeats what came after the checkpoint.
            rows = [row for row in rows if row["iteration"] <= resumed.leaves[".iteration"]]
        write_atomic(folder.metrics, ["".join(json.dumps(row) + "\n" for row in rows).encode()])
        self._file = self._closing.enter_context(folder.metrics.open("a", buffering=1))
        self._wandb = None
        if arguments.wandb:
            import wandb

            config = printable(arguments)
            self._wandb = wandb.init(project=arguments.wandb, name=folder.path.name, dir=folder.path, config=config)
            self._closing.callback(self._wandb.finish)
        self._tensorboard = _tensorboard_writer(folder.path)
        if self._tensorboard:
            self._closing.enter_context(contextlib.suppress(OSError))  # The disk is full; `metrics.jsonl` says so.
            self._closing.callback(self._tensorboard.close)

    def write(self, row: dict[str, Any]) -> None:
        """Log one iteration: `"iteration"`, `"env_steps"` and any scalars."""
        self._file.write(json.dumps(plain(row)) + "\n")
        scalars = {k: v for k, v in row.items() if k not in ("iteration", "env_steps") and v == v}
        if self._tensorboard:
            for name, value in scalars.items():
                self._tensorboard.add_scalar(name, value, row["env_steps"])
        if self._wandb:
            self._wandb.log(scalars, step=row["env_steps"])

    def close(self) -> None:
        """Flush to disk."""
        self._closing.close()


def _tensorboard_writer(path: Path) -> Any:
    for module in ("tensorboardX", "torch.utils.tensorboard"):
        with contextlib.suppress(ImportError):
            # Its thread ends where the disk is full, and a bounded queue would then stop the training for good.
            return importlib.import_module(module).SummaryWriter(str(path / "tensorboard"), max_queue=0)
    return None


def read_metrics(path: Path) -> list[dict[str, Any]]:
    """Rows of a metrics file; a truncated last line is left out."""
    lines = path.read_text().splitlines(keepends=True) if path.exists() else []
    return [json.loads(line) for line in lines if line.endswith("\n")]


def means(metrics: Mapping[str, Any]) -> dict[str, float]:
    """Mean [] of each metric over the iterations of a call that have a finite value."""
    values = {name: np.asarray(x, np.float64) for name, x in metrics.items()}
    return {name: float(np.nanmean(x)) if np.isfinite(x).any() else float("nan") for name, x in values.items()}


def progress_line(row: dict[str, Any]) -> str:
    """What a terminal shows of one logged iteration."""
    cells = [f"iteration {row['iteration']}", f"steps {row['env_steps']:.3g}", f"steps/s {row['env_steps_per_s']:.3g}"]
    cells.append(f"left {row['seconds_left'] / 60:.1f} min")
    for name, (heading, style) in METRICS.items():
        if not math.isnan(row.get(name, math.nan)):  # no episode has ended, or the task has no such metric
            cells.append(f"{heading} {row[name]:{style}}")
    cells += [f"{name.replace('_', ' ')} {row[name]:.0f}" for name in _FAULTS if row.get(name)]
    return " | ".join(cells)


def draw_curve(rows: list[dict[str, Any]], path: Path, title: str) -> None:
    """The learning curve over environment steps, with the evaluations, as a PNG."""
    from matplotlib.figure import Figure  # one that no window shows

    names = [name for name in METRICS if any(row.get(name) is not None for row in rows)]
    if not names:
        return
    figure = Figure(figsize=(7, 1.9 * len(names)), layout="constrained")
    axes = figure.subplots(len(names), sharex=True, squeeze=False)[:, 0]

    def draw(ax: Any, name: str, style: str, **options: Any) -> None:
        points = [(1e-6 * row["env_steps"], row[name]) for row in rows if row.get(name) is not None]
        if points:
            ax.plot(*zip(*points, strict=True), style, **options)

    for ax, name in zip(axes, names, strict=True):
        draw(ax, name, "-", lw=1.2)
        ax.set_ylabel(METRICS[name][0])
        ax.grid(alpha=0.3)
    draw(axes[0], "evaluation/return", "o", ms=4, label="evaluation")
    axes[0].set_title(f"{title}, {rows[-1]['seconds'] / 60:.1f} min", loc="left")
    axes[-1].set_xlabel("environment steps [million]")
    figure.savefig(path, dpi=120)
