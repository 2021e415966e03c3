"""Trains a task from one command.

    python -m dexsim_ppo.train --task grasp

Writes `runs/<task>-<time>/`: configuration, metrics, checkpoints, best and last policy, learning curve, and at the end
`report.json` (the policy beside a hand that does nothing) and a video. Ctrl-C saves; `--resume` continues exactly.
"""

import argparse
import contextlib
import dataclasses
import datetime
import json
import shlex
import signal
import sys
import threading
import time
from collections.abc import Callable, Collection, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple, cast

from dexsim.core import cli

if __name__ == "__main__":
    cli.announce_loading()

import dexsim
from dexsim.core.compilation import make_deterministic
from dexsim.core.config import from_dict, naming_file
from dexsim.core.install import require
from dexsim.errors import ConfigError, DexsimError
from dexsim.hand.source import record_of
from dexsim.registry import catalog, find_task, task_option
from dexsim_ppo import checkpoint
from dexsim_ppo.learner.adapter import adapt
from dexsim_ppo.learner.config import CurriculumConfig, PPOConfig
from dexsim_ppo.learner.sharding import make_mesh
from dexsim_ppo.policy import Policy, load_policy
from dexsim_ppo.training import processes
from dexsim_ppo.training.arguments import (
    TrainArguments,
    arguments_from_dict,
    check_network,
    check_resumed,
    find_hand,
    fine_tuning_config,
    printable,
    training_config,
)
from dexsim_ppo.training.presets import preset_arguments
from dexsim_ppo.training.runlog import RunFolder
from dexsim_ppo.training.trainer import Run

Source = checkpoint.Checkpoint | Policy | None
"""What a run begins from: the checkpoint to resume, the policy to fine-tune, or nothing."""


class TrainResult(NamedTuple):
    """What a finished training run leaves."""

    policy: Policy
    """The best policy by its evaluations during training, else the last one."""
    report: dict[str, Any]
    """`report.json`: the policy beside a hand that does nothing, on the same episodes."""
    folder: Path
    """The run's folder."""


def train_policy(
    task: str | None = None,
    config: Any = None,
    *,
    ppo: PPOConfig | None = None,
    preset: str = "auto",
    policy: str | Path = "",
    resume: str | Path | None = None,
    **options: Any,
) -> TrainResult:
    """Train a task from Python: what `python -m dexsim_ppo.train` does.

    Args:
      task: a registered name; None for the task of `policy` or `resume`.
      config: the task's settings; None for the defaults.
      ppo: the learner's settings; None for the preset's.
      preset: sizes and durations, "auto", "cpu", "cpu-large" or "gpu".
      policy: a policy to fine-tune, a file or the name of a shipped one.
      resume: folder of a run, or one of its checkpoints, to resume.
      options: other fields of `TrainArguments`, such as `minutes=5`, `seed=1`, `run_dir="runs/mine"`.

    Raises:
      ConfigError: an unknown task, or a value out of range.
      TypeError: an unknown option.
      CheckpointError: the file to begin from is unsound, or does not fit.
      DexsimError: training diverged, or was stopped by a signal.
    """
    started = time.perf_counter()
    cli.enable_caches()
    source = find_source(task, str(policy), resume)
    if not (task or source):
        raise ConfigError(f"train_policy: give a task, one of {', '.join(catalog()['tasks'])}")
    if options.get("run_dir"):
        options["run_dir"] = Path(options["run_dir"])
    given = {"env": config, "ppo": ppo, "policy": str(policy) or None} | options
    given = {name: value for name, value in given.items() if value is not None}
    arguments = dataclasses.replace(_with_budget(default_arguments(task, preset, source), given.keys()), **given)
    run, stopped = train(arguments, source, started, "train_policy(...)")
    if stopped:
        raise DexsimError(f"training was stopped; resume it with train_policy(resume={str(run.folder.path)!r})")
    return TrainResult(load_policy(run.selected), json.loads(run.folder.report.read_text()), run.folder.path)


def main(argv: Sequence[str] | None = None) -> int:
    """The command. Returns its exit code."""
    started = time.perf_counter()
    argv = list(sys.argv[1:] if argv is None else argv)
    given = {argument.split("=")[0] for argument in argv}
    if not given & {"--task", "--resume", "--policy", "--config", "-h", "--help"}:
        raise ConfigError(
            f"give a task (--task, one of {', '.join(catalog()['tasks'])}), a run to continue (--resume), a policy to "
            "fine-tune (--policy), or a run whose options to use (--config); --help lists all options"
        )
    cli.enable_caches()
    if "--devices" in given:
        processes.connect()
    command = shlex.join(["python", "-m", "dexsim_ppo.train", *argv])
    with processes.exit_on_error():
        arguments, source = parse_arguments(argv)
        run, stopped = train(arguments, source, started, command)
    if not stopped:
        return 0
    processes.print_on_first(
        f"stopped by {signal.Signals(stopped).name}; resume with: "
        f"python -m dexsim_ppo.train --resume {shlex.quote(str(run.folder.path))}{task_option(arguments.task)}"
    )
    return 128 + stopped


def train(arguments: TrainArguments, source: Source, started: float, command: str) -> tuple[Run, int]:
    """Train, evaluate and report: the run, and the number of the signal that stopped it or 0."""
    new = processes.is_first() and not isinstance(source, checkpoint.Checkpoint)
    # Errors come before the environment is made, which takes seconds.
    if isinstance(source, checkpoint.Checkpoint):
        check_resumed(arguments, default_arguments(None, arguments.preset, source))
        if arguments.run_dir:
            raise ConfigError(f"--run-dir {arguments.run_dir}: a resumed run stays in its folder")
        folder = RunFolder(source.path.resolve().parent.parent)
        if not folder.config.exists():
            raise ConfigError(f"--resume {source.path}: {folder.path} has no {folder.config.name}, which a run needs")
    else:
        name = f"{arguments.task}-{datetime.datetime.now():%Y%m%d-%H%M%S}"
        folder = RunFolder(arguments.run_dir or Path("runs") / name)
        if new and folder.path.exists():
            raise ConfigError(f"--run-dir {folder.path}: exists already; choose another, or resume it with --resume")
    if arguments.wandb:
        require("wandb", "wandb", f"--wandb {arguments.wandb}")
    if arguments.deterministic and not make_deterministic():
        processes.print_on_first(
            "--deterministic has no effect without a GPU, where runs of one seed are bit-identical anyway"
        )
    mesh, hand = make_mesh(arguments.devices, arguments.ppo), find_hand(arguments, source)
    processes.print_on_first(f"making the environment of {arguments.task}")
    made = dexsim.make(arguments.task, training_config(arguments), backend=arguments.backend, hand=hand)
    env = adapt(made, arguments.task)
    if env.backend != "own":  # so that a resumed run has the same engine
        arguments = dataclasses.replace(arguments, backend=cast(Any, env.backend))
    if isinstance(source, Policy):
        source.check_fit(env)
        check_network(source, arguments.ppo)
    if new:
        folder.checkpoints.mkdir(parents=True)
        record = {"command": command, "arguments": printable(arguments), "hand": record_of(hand)}
        cli.write_json(folder.config, record | cli.environment_report())
    run = Run(env, arguments, folder, started, mesh)
    with stop_on_signals() as received:
        run.train(source, lambda: processes.agree(received()))
        stopped = processes.agree(received())
    if processes.is_first() and not stopped:
        run.finish(command)
    return run, stopped


@contextlib.contextmanager
def stop_on_signals() -> Iterator[Callable[[], int]]:
    """Turn the first Ctrl-C or SIGTERM into a flag; a second Ctrl-C interrupts at once."""
    received = []

    def handler(number: int, _: Any) -> None:
        received.append(number)
        signal.signal(signal.SIGINT, signal.default_int_handler)

    numbers = (signal.SIGINT, signal.SIGTERM) if threading.current_thread() is threading.main_thread() else ()
    old = {number: signal.signal(number, handler) for number in numbers}  # Python takes handlers in no other thread.
    try:
        yield lambda: received[0] if received else 0
    finally:
        for number, previous in old.items():
            signal.signal(number, previous)


# --- options ------------------------------------------------------------------------------------------


def find_source(task: str | None, policy: str | None, resume: str | Path | None) -> Source:
    """What a run begins from."""
    if task:
        find_task(task)
    if resume and policy:
        raise ConfigError("--policy begins a run and --resume resumes one: give one of them")
    if resume:
        path = Path(resume)
        file = path if path.is_file() else RunFolder(path).latest_checkpoint()
        return checkpoint.load(file, kind="train", task=task and task.rpartition(":")[2])
    return load_policy(policy, task=task) if policy else None


def default_arguments(task: str | None, preset: str, source: Source) -> TrainArguments:
    """The options' defaults: the preset's, or those of what the run begins from."""
    name = source.task if source else (task or "grasp").rpartition(":")[2]
    entry = find_task(name)
    if isinstance(source, checkpoint.Checkpoint):
        with naming_file(source.path):
            return arguments_from_dict(entry.config_class, source.content["arguments"])
    default = preset_arguments(name, entry.config(), preset)
    if source:
        env = from_dict(entry.config_class, source.env_config)
        ppo, hand = fine_tuning_config(source, default.ppo), source.hand["file"] if source.hand else ""
        default = dataclasses.replace(default, env=env, ppo=ppo, curriculum=CurriculumConfig(), hand=hand)
    return default


def saved_arguments(path: Path, task: str | None) -> TrainArguments:
    """The options in `config.json` of a run, or of the run in this folder. Raises ConfigError if of another task."""
    file = RunFolder(path).config if path.is_dir() else path
    try:
        saved = json.loads(file.read_bytes())["arguments"]
    except (OSError, ValueError, KeyError) as error:
        raise ConfigError(f"--config {path}: no configuration of a run ({error})") from None
    if task and task.rpartition(":")[2] != saved["task"]:
        raise ConfigError(f"--config {path}: is of the task {saved['task']!r}, not {task!r}")
    with naming_file(file):
        return arguments_from_dict(find_task(task or saved["task"]).config_class, saved)


def _with_budget(default: TrainArguments, given: Collection[str]) -> TrainArguments:
    """The defaults without their own steps where minutes alone are given, and the other way round."""
    other = {"steps": "minutes", "minutes": "steps"}
    lifted: dict[str, Any] = {other[name]: 0.0 for name in other.keys() & given if other[name] not in given}
    return dataclasses.replace(default, **lifted)


def parse_arguments(argv: list[str]) -> tuple[TrainArguments, Source]:
    """The command's options, and what the run begins from."""
    # The defaults of all options depend on these.
    early = argparse.ArgumentParser(add_help=False, allow_abbrev=False, exit_on_error=False)
    for name in ("--task", "--preset", "--resume", "--policy", "--config", "--steps", "--minutes"):
        early.add_argument(name, nargs="?")
    given, _ = early.parse_known_args(argv)
    preset, description = given.preset or "auto", "Train a task."
    if preset == "auto" and cli.wants_help(argv):  # To ask which device there is takes seconds.
        preset, description = "cpu", f"{description} Defaults that depend on the device are those of --preset cpu."
    if given.config:
        if given.resume or given.preset:
            raise ConfigError("--config has all options of a new run: leave --resume and --preset out")
        default = saved_arguments(Path(given.config), given.task)
        source = find_source(given.task or default.task, given.policy or default.policy, None)
        if given.policy and not default.policy:  # the run began from scratch
            ppo = fine_tuning_config(cast(Policy, source), default.ppo)
            default = dataclasses.replace(default, ppo=ppo, curriculum=CurriculumConfig())
    else:
        source = find_source(given.task, given.policy, given.resume)
        default = default_arguments(given.task, preset, source)
    default = _with_budget(default, {name for name, value in vars(given).items() if value})
    options = cast(Any, TrainArguments)[type(default.env)]  # a static checker knows no type found at run time
    arguments = cli.parse(options, argv, default=default, prog="python -m dexsim_ppo.train", description=description)
    return dataclasses.replace(arguments, task=default.task), source


if __name__ == "__main__":
    cli.run(main)
