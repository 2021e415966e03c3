"""A run's folder: configuration, metrics, checkpoints, policies and the learning curve."""

import contextlib
import datetime
import fcntl
import importlib.util
import itertools
import json
import os
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from dexsim.core.cli import plain
from dexsim.core.errors import CheckpointError, ConfigError
from dexsim.core.files import write_whole
from dexsim_ppo.policy import Policy
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
        found = self.existing_checkpoints()
        if not found:
            raise CheckpointError(f"{self.path}: holds no checkpoint to resume from")
        return found[-1]

    @contextlib.contextmanager
    def locked(self) -> Iterator[None]:
        """Keep other processes from training this run, until the context or this process ends. Where its configuration
        cannot be locked, because of the file system or its mode, nothing does.

        Raises:
          ConfigError: one trains it already.
        """
        with contextlib.ExitStack() as stack:
            try:
                # Network file systems lock a file only for those who may write to it.
                fcntl.flock(stack.enter_context(self.config.open("rb+")), fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                raise ConfigError(f"{self.path}: another process is training this run") from None
            except OSError:
                pass
            yield

    def keep_report(self) -> None:
        """Number the report of a run that had ended before and was resumed: another must not replace it."""
        if self.report.exists():
            number = next(i for i in itertools.count(1) if not (self.path / f"report-{i}.json").exists())
            self.report.rename(self.path / f"report-{number}.json")

    def set_aside(self, after: int) -> None:
        """Rename what is of later iterations than the one that is resumed, checkpoints and the best policy: it is of
        another course. The newest checkpoint would be resumed next time, and the best policy be replaced or reported.

        Raises:
          CheckpointError: the best policy's file is unsound.
        """
        later = [path for path in self.existing_checkpoints() if int(path.stem) > after]
        if self.best.exists() and not self.has_best(after):
            later.append(self.best)
        for path in later:
            path.rename(_aside(path))

    def has_best(self, until: int) -> bool:
        """Whether the best policy is here, and of no later iteration. A later one is of another course, and replaced
        the one that a checkpoint before it speaks of.

        Raises:
          CheckpointError: the file is unsound.
        """
        return self.best.exists() and Policy.load(self.best).training.get("iteration", 0) <= until

    def prune(self, keep: int) -> None:
        """Delete all but the newest `keep` checkpoints."""
        for path in self.existing_checkpoints()[:-keep]:
            path.unlink()


def _aside(path: Path) -> Path:
    """The name under which a file is set aside, numbered where one of an earlier course has it."""
    names = (f"{path.stem}.aside{number or ''}{path.suffix}" for number in itertools.count())
    return next(free for name in names if not (free := path.with_name(name)).exists())


def new_folder(path: Path | None, task: str) -> Path:
    """A new folder for a run, by default one that is named after its task and the time. Making it is what takes the
    name, so that runs that begin in one second get different ones.

    Raises:
      ConfigError: `path` exists already.
    """
    if path:
        try:
            path.mkdir(parents=True)
        except FileExistsError:
            raise taken(path) from None
        return path
    stem = Path("runs") / f"{task}-{datetime.datetime.now():%Y%m%d-%H%M%S}"
    for number in itertools.count():
        path = Path(f"{stem}-{number}" if number else stem)
        try:
            path.mkdir(parents=True)
            return path
        except FileExistsError:
            if not os.path.lexists(path):  # It is a parent that is in the way.
                raise ConfigError(f"{path.parent}: is no folder; give another place with --run-dir") from None
    raise AssertionError("unreachable")


def folder_of(checkpoint: Path) -> Path:
    """The folder of the run that a checkpoint is of.

    Raises:
      ConfigError: it is in none, or the run lacks a file that it needs at the end.
    """
    folder = checkpoint.resolve().parent.parent
    if not RunFolder(folder).config.exists():
        raise ConfigError(f"--resume {checkpoint}: is not in the checkpoints of a run; {folder} has no config.json")
    if not RunFolder(folder).untrained.exists():
        raise ConfigError(
            f"--resume {checkpoint}: {folder} has no untrained.msgpack, with which the report compares; put it back, "
            "or begin another run with --policy"
        )
    return folder


def taken(path: Path) -> ConfigError:
    """What is wrong with the name of an existing folder."""
    return ConfigError(f"--run-dir {path}: exists already; choose another, or resume it with --resume")


class MetricsLog:
    """Appends one line of JSON per logged iteration; the same goes to TensorBoard, if a writer is installed, and to
    Weights & Biases, if the options name a project."""

    def __init__(self, folder: RunFolder, first_iteration: int, arguments: TrainArguments):
        with contextlib.ExitStack() as stack:
            stack.enter_context(folder.locked())
            rows = [row for row in read_metrics(folder.metrics) if row["iteration"] <= first_iteration]
            # A resumed run repeats what came after its checkpoint.
            write_whole(folder.metrics, ["".join(json.dumps(row) + "\n" for row in rows).encode()])
            folder.set_aside(first_iteration)
            self._file = stack.enter_context(folder.metrics.open("a", buffering=1))
            self._closing = stack.pop_all()
        self._tensorboard = _tensorboard_writer(folder.path)
        self._wandb = _wandb_run(folder.path, arguments) if arguments.wandb else None

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
    lines = path.read_text(errors="replace").splitlines() if path.exists() else []
    rows = [_row(line) for line in lines]
    if None in rows[:-1]:
        raise CheckpointError(f"{path}: line {rows.index(None) + 1} holds no metrics; mend the file or move it away")
    return [row for row in rows if row is not None]


def _row(line: str) -> dict[str, Any] | None:
    """A line of a metrics file; None if it is something else."""
    try:
        row = json.loads(line)
    except ValueError:
        return None
    return row if isinstance(row, dict) and type(row.get("iteration")) is int else None


def means(metrics: Mapping[str, Any]) -> dict[str, float]:
    """Mean [] of each metric over the iterations of a call, or over seeds, that have a finite value."""
    found = {name: np.asarray(values, np.float64) for name, values in metrics.items()}
    return {name: float(np.nanmean(x)) if np.isfinite(x).any() else float("nan") for name, x in found.items()}


def _tensorboard_writer(path: Path) -> Any:
    for module in ("tensorboardX", "torch.utils.tensorboard"):
        if importlib.util.find_spec(module.split(".")[0]) is None:
            continue
        try:
            # Its thread ends where the disk is full, and a bounded queue would then stop the training for good.
            return importlib.import_module(module).SummaryWriter(str(path / "tensorboard"), max_queue=0)
        except ImportError:
            continue
    return None


def _wandb_run(path: Path, arguments: TrainArguments) -> Any:
    import wandb

    return wandb.init(project=arguments.wandb, name=path.name, dir=path, config=printable(arguments))


def check_wandb(project: str) -> None:
    """Check that metrics can go to a Weights & Biases project.

    Raises:
      ConfigError: its library is not installed.
    """
    if project and importlib.util.find_spec("wandb") is None:
        raise ConfigError(f"--wandb {project}: install the extra, pip install -e '.[wandb]'")


def draw_curve(rows: list[dict[str, Any]], path: Path, title: str) -> None:
    """Learning curves over environment steps as a PNG, with the elapsed time above."""
    import matplotlib

    matplotlib.use("agg")
    import matplotlib.pyplot as plt
    from matplotlib.ticker import MaxNLocator

    errors = sorted({name for row in rows for name in row if name.startswith("step/") and name.endswith("error")})[:1]
    words = CURVES | {
        name: name.removeprefix("step/").replace("_", " ") + "\nof a tick" for name in errors if name not in CURVES
    }
    names = [name for name in words if any(row.get(name) is not None for row in rows)]
    if not names:
        return
    figure, axes = plt.subplots(
        len(names), 1, figsize=(7, 1.9 * len(names)), sharex=True, squeeze=False, layout="constrained"
    )
    million = 1e-6
    for ax, name in zip(axes[:, 0], names, strict=True):
        points = [(million * row["env_steps"], row[name]) for row in rows if row.get(name) is not None]
        ax.plot(*zip(*points, strict=True), lw=1.2, label="training")
        ax.set_ylabel(words[name])
        ax.grid(alpha=0.3)
        ax.spines[["top", "right"]].set_visible(False)
        if name == "episode/success":
            ax.set_ylim(-0.03, 1.03)
    held = [
        (million * row["env_steps"], row["evaluation/return"])
        for row in rows
        if row.get("evaluation/return") is not None
    ]
    if held and names[0] == "episode/return":
        axes[0, 0].plot(*zip(*held, strict=True), "o", ms=4, label="evaluation")
        axes[0, 0].legend(frameon=False)
    axes[0, 0].set_title(title, loc="left")
    axes[-1, 0].set_xlabel("environment steps [million]")
    timed = [(million * row["env_steps"], row["seconds"] / 60) for row in rows if "seconds" in row]
    if len(timed) > 1:
        steps, minutes = np.array(timed).T
        above = axes[0, 0].secondary_xaxis(
            "top", functions=(lambda x: np.interp(x, steps, minutes), lambda t: np.interp(t, minutes, steps))
        )
        # Beyond the curve's ends the interpolation is flat: marks there would lie on each other.
        marks = MaxNLocator(7).tick_values(minutes[0], minutes[-1])
        above.set_xticks([mark for mark in marks if minutes[0] <= mark <= minutes[-1]])
        above.set_xlabel("elapsed [min]")
    figure.savefig(path, dpi=120)
    plt.close(figure)
