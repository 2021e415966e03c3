"""Trains a task from one command.

    python -m dexsim_ppo.train --task grasp

Writes `runs/<task>-<time>/`: configuration, metrics, checkpoints, best and last policy, learning curve,
and at the end `report.json` (trained against untrained, same episodes) and a video. Ctrl-C saves, and
`--resume` goes on exactly from there.
"""

import argparse
import contextlib
import dataclasses
import datetime
import shlex
import signal
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import jax

from dexsim.core import cli
from dexsim.core.config import from_dict
from dexsim.core.errors import ConfigError
from dexsim_ppo import checkpoint
from dexsim_ppo.learner.config import PPOConfig
from dexsim_ppo.learner.curriculum import Curriculum
from dexsim_ppo.policy import Policy, load_policy
from dexsim_ppo.retired import migrate_arguments
from dexsim_ppo.training.presets import Preset, find_preset
from dexsim_ppo.training.runlog import RunFolder
from dexsim_ppo.training.trainer import Run, TrainArguments, printable, training_config
from dexsim_ppo.training.warm_start import check_fit, learner_settings


def main(argv: Sequence[str] | None = None) -> int:
    """The command. Returns its exit code."""
    started = time.perf_counter()
    argv = list(sys.argv[1:] if argv is None else argv)
    cli.enable_caches()
    arguments, begun = parse_arguments(argv)
    resumed = begun if isinstance(begun, checkpoint.Checkpoint) else None
    path = resumed.path.parent.parent if resumed else new_run_path(arguments)
    import dexsim

    env = dexsim.make(
        arguments.task, training_config(arguments), backend=arguments.backend, num_envs=arguments.ppo.num_envs
    )
    folder = RunFolder(path)
    if not resumed:
        if begun:
            check_fit(begun, env, arguments.ppo)
        folder.checkpoints.mkdir(parents=True)
        command = shlex.join(["python", "-m", "dexsim_ppo.train", *argv])
        cli.write_json(
            folder.config, {"command": command, "arguments": printable(arguments)} | cli.environment_report()
        )
    run = Run(env, arguments, folder, started)
    with stop_on_signals() as stopped:
        run.train(begun, stopped)
    if stopped():
        print(
            f"stopped by {signal.Signals(stopped()).name}; go on with: "
            f"python -m dexsim_ppo.train --resume {shlex.quote(str(folder.path))}"
        )
        return 128 + stopped()
    run.finish()
    return 0


# --- options ------------------------------------------------------------------------------------------


def parse_arguments(argv: list[str]) -> tuple[TrainArguments, checkpoint.Checkpoint | Policy | None]:
    """Options, on top of the preset's or of the resumed run's; and what there is to go on with: that run's
    checkpoint or a finished policy."""
    early = argparse.ArgumentParser(add_help=False, allow_abbrev=False, exit_on_error=False)
    for name in ("--task", "--preset", "--resume", "--policy"):
        early.add_argument(name, nargs="?")
    known, _ = early.parse_known_args(argv)
    resumed = None
    if known.resume:
        path = Path(known.resume)
        file = path if path.is_file() else RunFolder(path).latest_checkpoint()
        resumed = checkpoint.load(file, kind="train", task=known.task)
    if resumed and known.policy:
        raise ConfigError("--policy begins a run and --resume goes on with one: give one of them")
    policy = load_policy(known.policy, task=known.task) if known.policy else None
    begun = resumed or policy
    task = begun.task if begun else known.task or "grasp"
    entry = cli.find_task(task)
    config_class = entry.config_class
    if resumed:
        default = arguments_from_dict(config_class, migrate_arguments(resumed.content["arguments"], resumed.path))
    else:
        default = preset_arguments(task, entry.config(), known.preset or "auto")
        if policy:
            default = dataclasses.replace(
                default, env=from_dict(config_class, policy.env_config), ppo=learner_settings(policy, default.ppo)
            )
    given = {argument.split("=")[0] for argument in argv}
    if "--steps" in given and "--minutes" not in given:
        default = dataclasses.replace(default, minutes=0.0)
    arguments = cli.parse(
        TrainArguments[config_class],
        argv,
        default=default,
        prog="python -m dexsim_ppo.train",
        description="Train a task.",
    )
    return arguments, begun


def preset_arguments(task: str, env_config: Any, name: str) -> TrainArguments:
    """The options' defaults under a preset."""
    if name == "auto":
        name = "gpu" if jax.default_backend() == "gpu" else "cpu"
    preset = find_preset(name, task)
    values = {f.name: getattr(preset, f.name) for f in dataclasses.fields(Preset)}
    return TrainArguments(env=env_config, task=task, **values)


def arguments_from_dict(config_class: type, data: dict[str, Any]) -> TrainArguments:
    """The options that a checkpoint holds."""
    data = dict(data)
    env, ppo = from_dict(config_class, data.pop("env")), from_dict(PPOConfig, data.pop("ppo"))
    curriculum = from_dict(Curriculum, data.pop("curriculum", {}))
    known = {f.name for f in dataclasses.fields(TrainArguments)}
    return TrainArguments(env=env, ppo=ppo, curriculum=curriculum, **{k: v for k, v in data.items() if k in known})


def new_run_path(arguments: TrainArguments) -> Path:
    """A folder that does not exist yet."""
    if arguments.run_dir:
        if arguments.run_dir.exists():
            raise ConfigError(
                f"--run-dir {arguments.run_dir}: exists already; choose another, or go on with it through --resume"
            )
        return arguments.run_dir
    stem = Path("runs") / f"{arguments.task}-{datetime.datetime.now():%Y%m%d-%H%M%S}"
    return next(p for i in range(1000) if not (p := Path(f"{stem}-{i}" if i else stem)).exists())


@contextlib.contextmanager
def stop_on_signals() -> Iterator[Callable[[], int]]:
    """Turn the first Ctrl-C or SIGTERM into a flag; a second Ctrl-C interrupts at once."""
    received = []

    def handler(number: int, _: Any) -> None:
        received.append(number)
        signal.signal(signal.SIGINT, signal.default_int_handler)

    old = {number: signal.signal(number, handler) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield lambda: received[0] if received else 0
    finally:
        for number, previous in old.items():
            signal.signal(number, previous)


if __name__ == "__main__":
    cli.run(main)
