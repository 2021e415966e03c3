"""The options of `zero_shot.py`, checked before anything is loaded or run."""

import argparse
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NoReturn

import numpy as np

from dexsim.core import cli
from dexsim.core.errors import ConfigError, DexsimError
from dexsim_real.twin.plant.parameters import KINDS, sample_trial


class Parser(argparse.ArgumentParser):
    """Refuses in one line, as the commands do."""

    def error(self, message: str) -> NoReturn:
        raise cli.UsageError(f"{message}; see --help")


def arguments(description: str, argv: Sequence[str] | None = None) -> argparse.Namespace:
    """The options, checked; `set` and `limit` are tables from name to value.

    Raises:
      UsageError: an option is unknown, or its value is of the wrong type or out of range.
      OSError: the JSON file cannot be written.
    """
    parser = Parser(description=description)
    parser.add_argument("--task", choices=("grasp", "rotate"), required=True)
    parser.add_argument("--policy", help="policy file; by default the shipped policy of the task")
    parser.add_argument("--trials", type=int, default=10, help="trials of each seed")
    parser.add_argument(
        "--seed", type=int, nargs="+", default=[0], help="seeds; the metrics are over the trials of all seeds"
    )
    parser.add_argument(
        "--seconds", type=float, help="time limit of a trial in s; by default that of the task (8 or 120)"
    )
    parser.add_argument(
        "--parameters",
        choices=KINDS,
        default="outside",
        help="parameters of hand and object: outside training's ranges, inside them, or nominal",
    )
    parser.add_argument(
        "--plant-model",
        metavar="FILE",
        help="MJCF of a hand by somebody else in place of the emulated hand's physics (docs/emulated_hand.md)",
    )
    parser.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="NAME=VALUE",
        help="fix a parameter (dexsim_real/twin/plant/parameters.py): a number, or outside, inside, nominal",
    )
    parser.add_argument(
        "--limit",
        action="append",
        default=[],
        metavar="NAME=VALUE",
        help="another value for a safety limit of the bridge (dexsim_real/control/safety.py)",
    )
    parser.add_argument(
        "--no-safety", dest="safety", action="store_false", help="run without the bridge's safety limits"
    )
    parser.add_argument(
        "--no-baseline", dest="baseline", action="store_false", help="do not run the trials with an idle hand, too"
    )
    parser.add_argument("--processes", type=int, default=1, help="trials at once, in virtual time")
    parser.add_argument("--real-time", action="store_true", help="run hand and runner as processes, in real time")
    parser.add_argument("--first", type=int, default=0, help="number of the first trial")
    parser.add_argument("--twin", default="", help="more options of `dexsim_real.twin`, as one argument")
    parser.add_argument("--runner", default="", help="more options of `dexsim_real.run`, as one argument")
    parser.add_argument("--json", type=Path, help="JSON file for all results")
    given = parser.parse_args(argv)
    if given.real_time and (given.set or not given.safety or given.processes > 1):
        parser.error("--set, --no-safety and --processes are for virtual time")
    if not given.real_time and (given.twin or given.runner):
        parser.error("--twin and --runner need --real-time")
    _check_numbers(given)
    given.set, given.limit = _parameters(given), _limits(given.limit)
    if given.policy is not None:
        _check_policy(given.policy, given.task)
    if given.json:
        cli.check_writable(given.json)  # All trials would be lost.
    return given


def _check_numbers(given: argparse.Namespace) -> None:
    for name, low in (("trials", 1), ("first", 0), ("processes", 1)):
        if getattr(given, name) < low:
            raise cli.UsageError(f"--{name} {getattr(given, name)}: must be at least {low}")
    if min(given.seed) < 0:
        raise cli.UsageError(f"--seed {min(given.seed)}: must be at least 0")
    if given.seconds is not None and not 0.0 < given.seconds < math.inf:
        raise cli.UsageError(f"--seconds {given.seconds:g}: must be a time above 0 s")


def _pairs(option: str, given: list[str], words: tuple[str, ...] = ()) -> dict[str, Any]:
    """NAME=VALUE pairs, each value a finite number or one of some words."""
    table: dict[str, Any] = {}
    for pair in given:
        name, equals, value = pair.partition("=")
        if not equals or not name:
            raise cli.UsageError(f"{option} {pair}: give NAME=VALUE")
        try:
            table[name] = value if value in words else float(value)
        except ValueError:
            table[name] = math.nan
        if value not in words and not math.isfinite(table[name]):
            raise cli.UsageError(f"{option} {pair}: the value must be {' or '.join(['a number', *words])}")
    return table


def _parameters(given: argparse.Namespace) -> dict[str, Any]:
    """Values of --set, of parameters that a trial has."""
    table = _pairs("--set", given.set, KINDS)
    try:
        sample_trial(given.task, np.random.default_rng(0), given.parameters, table)
    except DexsimError as error:
        raise cli.UsageError(f"--set: {error}") from None
    return table


def _limits(given: list[str]) -> dict[str, float]:
    """Values of --limit, of safety limits that are one number."""
    from dexsim_real.control.limits import SafetyConfig

    table, defaults = _pairs("--limit", given), vars(SafetyConfig())
    known = [name for name, value in defaults.items() if isinstance(value, float)]
    for name in table:
        if name not in known:
            raise cli.UsageError(f"--limit {name}: choose from {', '.join(known)}")
    try:
        SafetyConfig(**table)
    except ConfigError as error:
        raise cli.UsageError(f"--limit {str(error).removeprefix('SafetyConfig.')}") from None
    return table


def _check_policy(policy: str, task: str) -> None:
    """Refuse a policy that is not there, or is of another task."""
    from dexsim_ppo.policy import load_policy
    from dexsim_real.control.controller import prepare_jax

    prepare_jax()  # As the trials need it, before anything is computed.
    try:
        load_policy(policy, task=task)
    except DexsimError as error:
        raise cli.UsageError(f"--policy: {error}") from None
