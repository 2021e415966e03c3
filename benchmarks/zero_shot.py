"""Shipped policies on the emulated hand without fine-tuning: the paper's metrics, beside those in simulation.

    python benchmarks/zero_shot.py --task rotate --trials 10
    python benchmarks/zero_shot.py --task grasp --trials 50 --parameters inside --set gear_play=0
    python benchmarks/zero_shot.py --task grasp --trials 50 --seed 0 1 2 3 --processes 2 --json grasp.json
    python benchmarks/zero_shot.py --task grasp --trials 25 --limit speed=20 --limit margin=0
    python benchmarks/zero_shot.py --task grasp --trials 20 --plant-model assets/plants/foreign_right.xml --pictures out

In virtual time (`dexsim_real.twin.virtual`): frames, emulated palm board, and the bridge's sensing, safety and
controller run in one process, as fast as they compute. The metrics use the true state, not the measurements of the
bridge. Trial k of a seed does not depend on the other trials. A hand that does nothing gets the same trials.
"""

import argparse
import contextlib
import dataclasses
import functools
import itertools
import json
import multiprocessing
import os
import sys
import threading
import time
from collections import Counter
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

import jax
import numpy as np

from dexsim.core import cli
from dexsim.core.assets import asset_path
from dexsim.core.statistics import mean, proportion, ratio
from dexsim.errors import DexsimError
from dexsim.hand.description import Hand
from dexsim.hand.load import load_hand
from dexsim.render.snapshot import Snapshot
from dexsim.tasks.grasp.report import MEANS, reduce
from dexsim_ppo.policy import load_policy
from dexsim_real.control.controller import Controller, prepare_jax
from dexsim_real.control.limits import SafetyConfig
from dexsim_real.twin.plant.emulated_hand import EmulatedHand
from dexsim_real.twin.plant.parameters import KINDS, TASKS, sample_trial
from dexsim_real.twin.plant.shapes import SHAPES, matrix
from dexsim_real.twin.virtual import VirtualRun

COMMANDS = (0.0, 0.25, 0.5, 0.75, 1.0)


@functools.lru_cache(maxsize=2)
def load(name: str, idle: bool, hand: str = "", axis: tuple[float, ...] = ()) -> Controller:
    """The controller of a policy; loaded once per process. An idle policy's actions are zero."""
    prepare_jax()
    policy = load_policy(name)
    if idle:
        layers = jax.tree.map(np.zeros_like, policy.params.layers)
        policy = dataclasses.replace(policy, params=dataclasses.replace(policy.params, layers=layers))
    controller = Controller(policy, load_hand(hand), axis)
    controller.warm()
    return controller


def run_trial(options: dict[str, Any], seed: int, number: int) -> dict[str, Any]:
    """One trial: the referee's report, with the bridge's measurements as `bridge`."""
    # As in the task's evaluation: five commands for each shape.
    axis = tuple(options.get("axis", ()))
    command, shape = COMMANDS[number % len(COMMANDS)], SHAPES[number // len(COMMANDS) % len(SHAPES)]
    controller = load(options["policy"], options.get("idle", False), options.get("hand", ""), axis)
    plant = EmulatedHand(
        controller.hand,
        options["task"],
        seed,
        kind=options["parameters"],
        overrides=options["set"],
        seconds=options["seconds"],
        trials=1,
        first=number,
        axis=axis,
        shape_name=shape,
        plant_model=options.get("plant_model"),
    )
    began, limits = time.perf_counter(), SafetyConfig(**options["limit"])
    run = VirtualRun(plant, controller, command, limits)
    trace = [
        (time, tick.readings.joint_torque[plant.hand.root_joint], run.policy.sample.measured.finger_force)
        for time, tick in run.ticking()
    ]
    report = run.report()
    if options["task"] == "grasp":
        # As the bridge measures it, over the window after the object is let go: sum over touching fingers of the root
        # joint's torque as a share of its limit.
        begin, end = report["window_s"]
        window = [entry for entry in trace if begin <= entry[0] - trace[0][0] < end]
        sums = [float(np.abs(torque)[force > 0.0].sum()) for _, torque, force in window]
        report["total_torque"] = round(float(np.mean(sums)), 4) if sums else 0.0
    return report | {"wall": round(time.perf_counter() - began, 2)}


def run_all(options: dict[str, Any], trials: int, processes: int, show: bool) -> list[dict[str, Any]]:
    """All trials, seed by seed and in order."""
    trial, first, reports = functools.partial(run_trial, options), options.get("first", 0), []
    seeds, numbers = zip(*itertools.product(options["seed"], range(first, first + trials)), strict=True)
    with contextlib.ExitStack() as stack:
        run: Any = map
        if processes > 1:
            spawn = multiprocessing.get_context("spawn")  # JAX does not support fork.
            run = stack.enter_context(ProcessPoolExecutor(processes, spawn, initializer=_end_with_parent)).map
        for report in run(trial, seeds, numbers):
            reports.append(report)
            if show:
                print(_line(report), file=sys.stderr, flush=True)
    return reports


def _end_with_parent() -> None:
    """End this process when its parent is killed: the executor's queue would have it wait for ever."""
    parent = multiprocessing.parent_process()
    assert parent is not None

    def watch() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


def _line(report: dict[str, Any]) -> str:
    result = (
        f"command {report['command']:.2f} {report['shape']:<11} fingers {report['finger_force']:6.2f} N"
        if report["task"] == "grasp"
        else f"{report['successes']:3d} successes ({report['paper_successes']} as the paper counts)"
    )
    return f"{report['trial']:4d}  {result}  {report['seconds']:7.2f} s  {report['end']}  ({report['wall']:.0f} s)"


# --- metrics and tables ---------------------------------------------------------------------------------


def grasp_metrics(reports: list[dict[str, Any]], span: tuple[float, float]) -> dict[str, Any]:
    """The metrics of the evaluation in simulation (`dexsim.tasks.grasp.report`); torques are as the bridge measures
    them.

    Args:
      reports: the referee's, of trials.
      span: N, target at command 0 and 1.
    """
    names = [name for name in MEANS if name != "touching"]
    column = {name: np.array([r[name] for r in reports], float) for name in ("command", "seconds", *names)}
    held, shapes = np.array([r["held"] for r in reports]), tuple(sorted({r["shape"] for r in reports}))
    # A referee's means end with the trial; a lost object is not pressed for the rest of the window.
    start, end = np.array([r["window_s"] for r in reports], float).T
    lived = np.where(held, 1.0, np.clip((column["seconds"] - start) / (end - start), 0.0, 1.0))
    means, shape = {name: lived * column[name] for name in names}, np.array([shapes.index(r["shape"]) for r in reports])
    window = {"window_s": [float(start.min()), float(end.max())]}
    return reduce(column["command"], held, shape, means, span, shapes) | window


def rotate_metrics(reports: list[dict[str, Any]]) -> dict[str, Any]:
    """The paper's three metrics, with goals counted by the task's rule (spin limit) and by the paper's.

    The pace is over all the time that trials lasted, time in which the hand was stuck included.
    """
    count, paper, lived = (
        np.array([r[name] for r in reports], float) for name in ("successes", "paper_successes", "seconds_to_fall")
    )
    return {
        "successes": mean(count) | {"median": float(np.median(count)), "sorted": sorted(count.tolist())},
        "paper_successes": mean(paper) | {"median": float(np.median(paper)), "sorted": sorted(paper.tolist())},
        "successes_per_minute": ratio(count, lived / 60),
        "seconds_to_fall": mean(lived),
        "kept_to_the_end": proportion(np.array([not r["fell"] for r in reports])),
        "joint_speed": mean(np.array([r["joint_speed"] for r in reports])),
    }


def metrics(task: str, policy: str, reports: list[dict[str, Any]]) -> dict[str, Any]:
    """The metrics of a policy's trials, with a count of the causes of losses."""
    causes = Counter(r["end"].removeprefix("dropped: ") for r in reports if r["end"].startswith("dropped"))
    lost = {"lost": dict(causes.most_common())}
    if task != "grasp":
        return rotate_metrics(reports) | lost
    return grasp_metrics(reports, tuple(load_policy(policy).env_config["finger_force"])) | lost


def draw_losses(folder: Path, hand: Hand, reports: list[dict[str, Any]]) -> list[Path]:
    """A picture of the first loss of each cause, half a second before its end: the library's hand at the true joint
    angles, with the true object."""
    from PIL import Image

    from dexsim.render.render import render_frame

    folder.mkdir(parents=True, exist_ok=True)
    paths = []
    for report in reports:
        cause = report["end"].removeprefix("dropped: ").replace(" ", "_")
        path = folder / f"{report['task']}_{cause}.png"
        if "before" not in report or path in paths:
            continue
        parts, before = report["parts"], report["before"]
        snapshot = Snapshot(
            joint_position=np.array(before["joint_position"]),
            object_position=np.array(before["object_position"]),
            object_rotation=matrix(np.array(before["object_quat"])),
            primitive_size=np.array([(*part["size"], 0, 0)[:3] for part in parts]),
            primitive_position=np.array([part["place"] for part in parts]),
            primitive_rotation=np.array([matrix(part["quat"]) for part in parts]),
            primitive_active=np.ones(len(parts), bool),
            taxel_force=np.zeros((hand.num_fingers, hand.num_taxels)),
            command=np.float32(report["command"]),
            target_force=np.float32(0),
            finger_force=np.array(before["finger_force"]),
        )
        picture = render_frame(hand, tuple(part["kind"] for part in parts), snapshot, camera=report["task"])
        Image.fromarray(picture).save(path)
        paths.append(path)
    return paths


def simulated(task: str, policy: str) -> dict[str, Any]:
    """The policy's report in simulation; empty if there is none."""
    path = Path(policy).with_suffix(".json")
    try:
        path = path if path.is_file() else asset_path(f"policies/{Path(policy).stem}.json")
        report = json.loads(path.read_text())
        report = report.get("evaluation", report["trained"])["task"]
    except (OSError, KeyError, ValueError, DexsimError):
        return {}
    counts = () if task == "grasp" else ("successes", "paper_successes")
    return report | {name: report[name]["mean"] | {"median": report[name]["median"]["median"]} for name in counts}


def table(here: dict[str, Any], there: dict[str, Any], idle: dict[str, Any]) -> str:
    """Table with the columns metric, emulated hand, simulation, and a hand that does nothing in the same trials."""

    def cell(entry: Any) -> str:
        value = entry.get("r", entry.get("mean")) if isinstance(entry, dict) else None
        if value is None:
            return "-"
        span = f" ({entry['low']:.3g} to {entry['high']:.3g})" if entry.get("low") is not None else ""
        return f"{value:.3g}{span}" + (f", median {entry['median']:.3g}" if "median" in entry else "")

    def line(title: str, name: str, *entries: dict[str, Any]) -> tuple[str, ...]:
        return (title + name.replace("_", " "), *(cell(entry.get(name)) for entry in entries))

    worlds = here, there, idle
    rows = [("", "emulated hand", "simulation", "doing nothing")]
    rows += [line("", name, *worlds) for name in here if isinstance(here[name], dict) and name != "lost"]
    for row in here.get("by_command", []):
        same = [next((r for r in w.get("by_command", []) if r["command"] == row["command"]), {}) for w in worlds]
        title = f"command {row['command']:g}{' (saturates)' if row['saturates'] else ''}: "
        rows += [line(title, name, *same) for name in ("held", "finger_force_n", "torque_limited")]
    rows += [(f"{row['shape']}: held", cell(row["held"]), "", "") for row in here.get("by_shape", [])]
    widths = [max(len(row[k]) for row in rows) for k in range(4)]
    lines = ["  ".join(text.ljust(width) for text, width in zip(row, widths, strict=True)).rstrip() for row in rows]
    if here.get("lost"):
        lines.append("lost: " + ", ".join(f"{cause} {count}" for cause, count in here["lost"].items()))
    if "window_s" in here:
        lines.append("forces and r: of held objects, from {:g} to {:g} s after release".format(*here["window_s"]))
    return "\n".join(lines)


# --- the command ----------------------------------------------------------------------------------------


def arguments(argv: Sequence[str] | None = None) -> argparse.Namespace:
    """The options, checked before the first trial; `set` and `limit` are tables from name to value.

    Raises:
      DexsimError: a parameter, a limit or a policy that does not exist, or a value out of range.
      OSError: the JSON file cannot be written.
    """
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    add = parser.add_argument
    add("--task", choices=TASKS, required=True)
    add("--policy", help="policy file; by default the shipped policy of the task")
    add("--hand", default="", help="TOML or name of a hand with the XHand's joints and taxels")
    add("--axis", type=float, nargs=3, default=(), help="of rotation, for a policy trained with several")
    add("--trials", type=int, default=10, help="of each seed")
    add("--seed", type=int, nargs="+", default=[0], help="the metrics are over the trials of all seeds")
    add("--seconds", type=float, help="time limit of a trial in s; by default the task's (8 or 120)")
    add("--parameters", choices=KINDS, default="outside", help="of hand and object: beside default ranges, or in")
    add("--plant-model", metavar="FILE", help="MJCF of another hand (docs/emulated_hand.md)")
    add("--set", type=_pair, action="append", default=[], metavar="NAME=VALUE", help="fix a parameter")
    add("--limit", type=_pair, action="append", default=[], metavar="NAME=VALUE", help="a safety limit of the bridge")
    add("--no-baseline", dest="baseline", action="store_false", help="no trials of a hand that does nothing")
    add("--processes", type=int, default=1, help="trials at once")
    add("--first", type=int, default=0, help="number of the first trial")
    add("--json", type=Path, help="file for all results")
    add("--pictures", type=Path, metavar="FOLDER", help="for a picture of each cause of a loss")
    given = parser.parse_args(argv)
    given.set, given.limit, given.policy = dict(given.set), dict(given.limit), given.policy or given.task
    sample_trial(given.task, np.random.default_rng(0), given.parameters, given.set)
    if unknown := given.limit.keys() - vars(SafetyConfig()):
        parser.error(f"--limit: the bridge has no limit {sorted(unknown)[0]!r}")
    SafetyConfig(**given.limit)
    if given.json:
        cli.check_writable(given.json)  # All trials would be lost.
    prepare_jax()  # As the trials need it, before anything is computed.
    load_policy(given.policy, task=given.task)
    return given


def _pair(text: str) -> tuple[str, float]:
    name, equals, value = text.partition("=")
    if not name or not equals or value == "nan":
        raise argparse.ArgumentTypeError(f"{text}: give NAME=VALUE")
    return name, float(value)


def main(argv: Sequence[str] | None = None) -> int:
    """The command. Returns its exit code."""
    options = vars(arguments(argv))
    names = ("json", "pictures", "trials", "processes", "baseline")
    json, pictures, trials, processes, baseline = (options.pop(name) for name in names)
    task, policy = options["task"], options["policy"]
    reports = run_all(options, trials, processes, show=True)
    still = run_all(options | {"idle": True}, trials, processes, show=False) if baseline else []
    here, idle = metrics(task, policy, reports), metrics(task, policy, still) if still else {}
    there = simulated(task, policy)
    if json:  # Before the output, whose reader may be gone.
        found = {"options": options, "metrics": here, "simulation": there, "do_nothing": idle, "trials": reports}
        cli.write_json(json, found | cli.environment_report())
    seeds = " ".join(map(str, options["seed"]))
    print(f"{task}: {len(reports)} trials, {options['parameters']}, seed {seeds}")
    print(table(here, there, idle))
    if pictures:
        print(*draw_losses(pictures, load(policy, False, options["hand"]).hand, reports), sep="\n")
    return 0


if __name__ == "__main__":
    cli.run(main)
