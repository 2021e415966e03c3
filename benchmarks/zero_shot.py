"""Shipped policies on the emulated hand without fine-tuning: the paper's metrics, beside those in simulation.

    python benchmarks/zero_shot.py --task rotate --trials 10
    python benchmarks/zero_shot.py --task grasp --trials 50 --parameters inside --set gear_play=0
    python benchmarks/zero_shot.py --task grasp --trials 50 --seed 0 1 2 3 --processes 2
    python benchmarks/zero_shot.py --task grasp --trials 25 --limit speed=20 --limit margin=0
    python benchmarks/zero_shot.py --task grasp --trials 20 --plant-model assets/plants/foreign_right.xml
    python benchmarks/zero_shot.py --task rotate --trials 3 --real-time

In virtual time (`dexsim_real.twin.virtual`): frames, emulated palm board, and the bridge's sensing, safety and
controller run in one process, as fast as they compute. With `--real-time` hand and runner are processes of their own,
as for a user (`trials.py`). The metrics use the true state, not the measurements of the bridge. Trial k of a seed does
not depend on the other trials. A hand that does nothing gets the same trials, in virtual time.
"""

import dataclasses
import functools
import itertools
import sys
import time
from collections.abc import Sequence
from typing import Any

import numpy as np
from trials import real_trial
from workers import pool
from zero_shot_options import arguments
from zero_shot_table import simulated, table

from dexsim.core import cli

TARGETS = {"grasp": "held 90 %, r 0.8", "rotate": "25.1 successes, 17.9 a minute, 84.3 s to fall"}
COMMANDS = (0.0, 0.25, 0.5, 0.75, 1.0)


@functools.lru_cache(maxsize=2)
def load(name: str, idle: bool) -> tuple[Any, Any, Any]:
    """Hand, controller and calibration; loaded once per process. An idle policy's actions are zero."""
    from dexsim_real.control.controller import Controller, prepare_jax

    prepare_jax()
    import jax

    from dexsim import load_hand
    from dexsim_ppo.policy import load_policy
    from dexsim_real.twin.virtual import ideal_calibration

    hand, policy = load_hand(), load_policy(name)
    if idle:
        layers = jax.tree.map(np.zeros_like, policy.params.layers)
        policy = dataclasses.replace(policy, params=dataclasses.replace(policy.params, layers=layers))
    controller = Controller(policy, hand)
    controller.warm()
    return hand, controller, ideal_calibration(hand)


def run_trial(options: dict[str, Any], seed: int, number: int) -> dict[str, Any]:
    """The referee's report of one trial."""
    from dexsim_real.twin.plant.shapes import SHAPES

    # As in the task's evaluation: five commands for each shape.
    command, shape = COMMANDS[number % len(COMMANDS)], SHAPES[number // len(COMMANDS) % len(SHAPES)]
    one = real_trial if options.get("real_time") else virtual_trial
    return one(options, seed, number, command, shape)


def virtual_trial(options: dict[str, Any], seed: int, number: int, command: float, shape: str) -> dict[str, Any]:
    """One trial in virtual time: the referee's report, with the bridge's measurements as `bridge`."""
    from dexsim_real.control.limits import SafetyConfig
    from dexsim_real.twin.plant.foreign.hand import hand_of
    from dexsim_real.twin.virtual import RunOptions, VirtualRun

    hand, controller, calibration = load(options["policy"], options.get("idle", False))
    plant = hand_of(
        options.get("plant_model"),
        hand,
        options["task"],
        seed,
        kind=options["parameters"],
        overrides=options["set"],
        seconds=options["seconds"],
        trials=1,
        first=number,
        shape=shape,
    )
    began = time.perf_counter()
    limits = SafetyConfig(**options.get("limit", {}))
    run = VirtualRun(plant, controller, calibration, RunOptions(command, safety=options["safety"], limits=limits))
    if options["task"] == "grasp":
        run.trace = []
    report = run.run()
    if run.trace:
        report["total_torque"] = _measured_torque(run.trace, hand, report["window_s"])
    return report | {"wall": round(time.perf_counter() - began, 2)}


def _measured_torque(trace: list[dict[str, Any]], hand: Any, window: list[float]) -> float:
    """Sum over touching fingers of the root joint's torque as a share of its limit, as the bridge measures it: mean
    over the window [s]. The runner's clock starts with its first tick, when the object is let go."""
    sums = [
        float(np.abs(entry["tick"].readings.joint_torque[hand.root_joint])[entry["measured"].finger_force > 0.0].sum())
        for entry in trace
        if window[0] <= entry["time"] - trace[0]["time"] < window[1]
    ]
    return round(float(np.mean(sums)), 4) if sums else 0.0


def run_all(options: dict[str, Any], trials: int, processes: int, show: bool) -> list[dict[str, Any]]:
    """All trials, seed by seed and in order."""
    trial, first = functools.partial(run_trial, options), options.get("first", 0)
    seeds, numbers = zip(*itertools.product(options["seed"], range(first, first + trials)), strict=True)
    if processes <= 1:
        return [_shown(report, show) for report in map(trial, seeds, numbers)]
    with pool(processes) as workers:
        return [_shown(report, show) for report in workers.map(trial, seeds, numbers)]


def _shown(report: dict[str, Any], show: bool) -> dict[str, Any]:
    if show:
        result = (
            f"command {report['command']:.2f} {report['shape']:<11} fingers {report['finger_force']:6.2f} N"
            if report["task"] == "grasp"
            else f"{report['successes']:3d} successes ({report['paper_successes']} as the paper counts)"
        )
        link, bridge = f"{report['wall']:.0f} s", report["bridge"]
        if "exchanges" in bridge:
            link += f", {bridge['unanswered']} of {bridge['exchanges']} exchanges unanswered, policy late p99 "
            link += f"{bridge['policy_jitter']['p99_ms']:.1f} ms, simulated time slipped {bridge['slipped_s']:.2f} s"
        print(
            f"{report['trial']:4d}  {result}  {report['seconds']:7.2f} s  {report['end']}  ({link})",
            file=sys.stderr,
            flush=True,
        )
    return report


# --- metrics -------------------------------------------------------------------------------------


def grasp_metrics(reports: list[dict[str, Any]], span: tuple[float, float]) -> dict[str, Any]:
    """Success rate, force error over all trials, and correlation of the forces of held objects with the command.

    Names, window and forces are those of the evaluation in simulation (`dexsim.tasks.grasp.report`); torques are as the
    bridge measures them.

    Args:
      reports: the referee's, of trials.
      span: N, target at command 0 and 1.
    """
    from dexsim.core.statistics import mean, proportion
    from dexsim.force_loop import target_force
    from dexsim.tasks.grasp.report import FORCES, correlations, force_error, pearson, saturates, slope

    held = np.array([r["held"] for r in reports])
    torque = ("total_torque",) if all("total_torque" in r for r in reports) else ()  # not with processes of their own
    forces = {part: f"finger_{part}" for part in FORCES.values()}
    names = (*forces.values(), "total_force", *torque, "torque_limited")
    command, *columns = (np.array([r[name] for r in reports], float) for name in ("command", *names))
    mean_of = dict(zip(names, columns, strict=True))
    commanded = {part: mean_of[name] for part, name in forces.items()}
    # A referee's means end with the trial; a lost object is not pressed for the rest of the window.
    start, end = np.array([r["window_s"] for r in reports], float).T
    lived = np.clip((np.array([r["seconds"] for r in reports], float) - start) / (end - start), 0.0, 1.0)
    wanted = target_force(command, span)
    by_command = [
        {"command": float(c), "held": proportion(held[command == c])}
        | {name: mean(mean_of[name][held & (command == c)]) for name in names}
        | {"saturates": saturates(mean_of["torque_limited"][held & (command == c)])}
        for c in np.unique(command)
    ]
    by_shape = [
        {"shape": s, "held": proportion(held[[r["shape"] == s for r in reports]])}
        for s in sorted({r["shape"] for r in reports})
    ]
    return {
        "held": proportion(held),
        "force_error_n": force_error(np.where(held, 1.0, lived) * commanded["force"], wanted),
        **correlations(command, held, commanded),
        **({"r_torque": pearson(command[held], mean_of["total_torque"][held])} if torque else {}),
        "slope_force_n": slope(command[held], commanded["force"][held]),
        **({"slope_torque": slope(command[held], mean_of["total_torque"][held])} if torque else {}),
        "torque_limited": mean(mean_of["torque_limited"][held]),
        "window_s": [float(start.min()), float(end.max())],
        "by_command": by_command,
        "by_shape": by_shape,
    }


def rotate_metrics(reports: list[dict[str, Any]]) -> dict[str, Any]:
    """The paper's three metrics, with goals counted by the task's rule (spin limit) and by the paper's.

    The pace is over all the time that trials lasted, time in which the hand was stuck included.
    """
    from dexsim.core.statistics import mean, proportion, ratio

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
    """The metrics of a policy's trials."""
    if task == "rotate":
        return rotate_metrics(reports)
    from dexsim_ppo.policy import load_policy

    return grasp_metrics(reports, tuple(load_policy(policy).env_config["finger_force"]))


def main(argv: Sequence[str] | None = None) -> int:
    """The command. Returns its exit code."""
    given = arguments(__doc__.splitlines()[0], argv)
    options = {
        "task": given.task,
        "policy": given.policy or given.task,
        "seed": given.seed,
        "first": given.first,
        "parameters": given.parameters,
        "seconds": given.seconds,
        "safety": given.safety,
        "plant_model": given.plant_model,
        "real_time": given.real_time,
        "twin": given.twin,
        "runner": given.runner,
        "set": given.set,
        "limit": given.limit,
    }
    reports = run_all(options, given.trials, given.processes, show=True)
    still = (
        run_all(options | {"idle": True, "real_time": False}, given.trials, given.processes, show=False)
        if given.baseline
        else []
    )
    here = metrics(given.task, options["policy"], reports)
    idle = metrics(given.task, options["policy"], still) if still else {}
    there = simulated(given.task, options["policy"])
    if given.json:  # Before the output, whose reader may be gone.
        found = {"options": options, "metrics": here, "simulation": there, "do_nothing": idle, "trials": reports}
        cli.write_json(given.json, found)
    print(
        f"{given.task}: {len(reports)} trials{' in real time' * given.real_time}, parameters {given.parameters}, "
        f"seed {' '.join(map(str, given.seed))}; targets {TARGETS[given.task]}"
    )
    print(table(here, there, idle))
    return 0


if __name__ == "__main__":
    cli.run(main)
