"""A run's folder: configuration, metrics, checkpoints, policies and the learning curve."""

import contextlib
import datetime
import fcntl
import importlib.util
import itertools
import json
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from dexsim.core.cli import plain
from dexsim.core.errors import CheckpointError, ConfigError
from dexsim.core.files import write_whole
from dexsim.core.install import require
from dexsim_ppo.policy import load_policy
from dexsim_ppo.training.arguments import TrainArguments, printable

CURVES = {
    "episode/return": "return\nof an episode",
    "episode/success": "success\n[share of episodes]",
    "episode/successes": "goals\nof an episode",
    "episode/length": "length of an\nepisode [ticks]",
    "reward": "reward\nof a tick",
    "step/force_error": "force error\n[N]",
    "step/angle_error": "angle error\n[rad]",
}
"""What the learning curve shows, and how it says it."""


class RunFolder:
    """`runs/<task>-<time>/` and its files."""

    def __init__(self, path: Path):
        self.path = path
        self.checkpoints = path / "checkpoints"
        self.metrics = path / "metrics.jsonl"
        self.best, self.last = path / "best.msgpack", path / "last.msgpack"
        self.untrained = path / "untrained.msgpack"
        self.report, self.config = path / "report.json", path / "config.json"

    def checkpoint(self, iteration: int) -> Path:
        """File of the checkpoint after this many iterations."""
        return self.checkpoints / f"{iteration:08d}.msgpack"

    def existing_checkpoints(self) -> list[Path]:
        """Oldest first."""
        return sorted(p for p in self.checkpoints.glob("*.msgpack") if re.fullmatch(r"\d{8}\.msgpack", p.name))

    def latest_checkpoint(self) -> Path:
        """The newest checkpoint.

        Raises:
          CheckpointError: there is none.
        """
        if not (paths := self.existing_checkpoints()):
            raise CheckpointError(f"{self.path}: holds no checkpoint to resume from")
        return paths[-1]

    def lock(self) -> contextlib.ExitStack:
        """Keep other processes from training this run, until the result is closed or this process ends. Where the file
        system or the file's mode does not allow it, nothing does.

        Raises:
          ConfigError: another process trains it already.
        """
        stack = contextlib.ExitStack()
        try:
            # Network file systems lock a file only for those who may write to it.
            fcntl.flock(stack.enter_context(self.config.open("rb+")), fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            stack.close()
            raise ConfigError(f"{self.path}: another process is training this run") from None
        except OSError:
            pass
        return stack

    def keep_report(self) -> None:
        """Number the report of a run that had ended before and was resumed: another must not replace it."""
        if self.report.exists():
            self.report.rename(_free(self.path, "report-{}.json"))

    def set_aside(self, after: int) -> None:
        """Rename checkpoints and the best policy of later iterations than the one that is resumed to `*.aside*`: the
        resumed run takes another course, and would resume from or report what is not its own.

        Raises:
          CheckpointError: the best policy's file is unsound.
        """
        later = [path for path in self.existing_checkpoints() if int(path.stem) > after]
        if self.best.exists() and not self.has_best(after):
            later.append(self.best)
        for path in later:
            path.rename(_free(path.parent, path.stem + ".aside{}" + path.suffix))

    def has_best(self, until: int) -> bool:
        """Whether the best policy is here, and of no later iteration than `until`.

        Raises:
          CheckpointError: the file is unsound.
        """
        return self.best.exists() and load_policy(self.best).training.get("iteration", 0) <= until

    def prune(self, keep: int) -> None:
        """Delete all but the newest `keep` checkpoints."""
        for path in self.existing_checkpoints()[:-keep]:
            path.unlink()


def _free(folder: Path, pattern: str) -> Path:
    """The first name of a pattern with a number in it that is free in a folder."""
    paths = (folder / pattern.format(number) for number in itertools.count(1))
    return next(path for path in paths if not path.exists())


def new_folder(path: Path | None, task: str) -> Path:
    """A new folder for a run, by default one that is named after its task and the time. Making it is what takes the
    name, so that runs that begin in one second get different ones.

    Raises:
      ConfigError: `path` exists already.
    """
    stem = Path("runs") / f"{task}-{datetime.datetime.now():%Y%m%d-%H%M%S}"
    for number in itertools.count():
        new = path or Path(f"{stem}-{number}" if number else stem)
        try:
            new.mkdir(parents=True)
            return new
        except FileExistsError:
            if path:
                raise taken(path) from None
            if not new.exists():  # It is a parent that is in the way.
                raise
    raise AssertionError("unreachable")


def folder_of(checkpoint: Path) -> Path:
    """The folder of the run that a checkpoint is of.

    Raises:
      ConfigError: it is in none, or the run lacks a file that it needs at the end.
    """
    folder = RunFolder(checkpoint.resolve().parent.parent)
    for file in (folder.config, folder.untrained):
        if not file.exists():
            raise ConfigError(f"--resume {checkpoint}: {folder.path} has no {file.name}, which a run needs")
    return folder.path


def taken(path: Path) -> ConfigError:
    """What is wrong with the name of an existing folder."""
    return ConfigError(f"--run-dir {path}: exists already; choose another, or resume it with --resume")


class MetricsLog:
    """Appends one line of JSON per logged iteration; the same goes to TensorBoard, if a writer is installed, and to
    Weights & Biases, if the options name a project."""

    def __init__(self, folder: RunFolder, first_iteration: int, arguments: TrainArguments):
        self._closing = folder.lock()
        rows = [row for row in read_metrics(folder.metrics) if row["iteration"] <= first_iteration]
        # A resumed run repeats what came after its checkpoint.
        write_whole(folder.metrics, ["".join(json.dumps(row) + "\n" for row in rows).encode()])
        folder.set_aside(first_iteration)
        self._file = self._closing.enter_context(folder.metrics.open("a", buffering=1))
        self._tensorboard = _tensorboard_writer(folder.path)
        self._wandb = None
        if arguments.wandb:
            import wandb

            config = printable(arguments)
            self._wandb = wandb.init(project=arguments.wandb, name=folder.path.name, dir=folder.path, config=config)

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
        try:
            self._closing.close()
        finally:
            if self._tensorboard:
                with contextlib.suppress(OSError):  # The disk is full, and `metrics.jsonl` says so.
                    self._tensorboard.close()
            if self._wandb:
                self._wandb.finish()


def read_metrics(path: Path) -> list[dict[str, Any]]:
    """Rows of a metrics file; a truncated last line is left out.

    Raises:
      CheckpointError: another line is no row.
    """
    lines, rows = path.read_text().splitlines() if path.exists() else [], []
    for number, line in enumerate(lines, start=1):
        try:
            rows.append(json.loads(line))
        except ValueError:
            if number < len(lines):
                raise CheckpointError(f"{path}: line {number} holds no metrics; mend the file or move it") from None
    return rows


def means(metrics: Mapping[str, Any]) -> dict[str, float]:
    """Mean [] of each metric over the iterations of a call that have a finite value."""
    values = {name: np.asarray(x, np.float64) for name, x in metrics.items()}
    return {name: float(np.nanmean(x)) if np.isfinite(x).any() else float("nan") for name, x in values.items()}


def _tensorboard_writer(path: Path) -> Any:
    for module in ("tensorboardX", "torch.utils.tensorboard"):
        with contextlib.suppress(ImportError):
            # Its thread ends where the disk is full, and a bounded queue would then stop the training for good.
            return importlib.import_module(module).SummaryWriter(str(path / "tensorboard"), max_queue=0)
    return None


def check_wandb(project: str) -> None:
    """Raises DexsimError: metrics are to go to a Weights & Biases project, and its library is not installed."""
    if project:
        require("wandb", "wandb", f"--wandb {project}")


def draw_curve(runs: Sequence[list[dict[str, Any]]], path: Path, title: str) -> None:
    """Learning curves of runs over environment steps as a PNG; of one run also evaluations, and the elapsed time."""
    import matplotlib

    matplotlib.use("agg")
    import matplotlib.pyplot as plt

    rows = [row for run in runs for row in run]
    own = {name for row in rows for name in row if name.startswith("step/") and name.endswith("error")} - set(CURVES)
    words = CURVES | {name: name.removeprefix("step/").replace("_", " ") + "\nof a tick" for name in sorted(own)[:1]}
    names = [name for name in words if any(row.get(name) is not None for row in rows)]
    if not names:
        return
    figure, axes = plt.subplots(
        len(names), 1, figsize=(7, 1.9 * len(names)), sharex=True, squeeze=False, layout="constrained"
    )

    def draw(ax: Any, run: list[dict[str, Any]], name: str, style: str, **options: Any) -> None:
        points = [(1e-6 * row["env_steps"], row[name]) for row in run if row.get(name) is not None]
        if points:
            ax.plot(*zip(*points, strict=True), style, **options)

    for ax, name in zip(axes[:, 0], names, strict=True):
        for run in runs:
            draw(ax, run, name, "-", lw=1.2)
        ax.set_ylabel(words[name])
        ax.grid(alpha=0.3)
    if len(runs) == 1:
        draw(axes[0, 0], runs[0], "evaluation/return", "o", ms=4, label="evaluation")
    minutes = rows[-1]["seconds"] / 60
    axes[0, 0].set_title(title + (f", {minutes:.1f} min" if len(runs) == 1 else f", {len(runs)} seeds"), loc="left")
    axes[-1, 0].set_xlabel("environment steps [million]")
    figure.savefig(path, dpi=120)
    plt.close(figure)
