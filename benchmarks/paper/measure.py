"""How a row is measured: training, evaluation in simulation, trials on the emulated hand, sweeps, held-out objects."""

import dataclasses
import functools
import json
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import zero_shot

import dexsim
from dexsim.core.config import from_dict, override, to_dict
from dexsim.env.env import Env
from dexsim.registry import find_task
from dexsim.tasks.grasp.config import GraspConfig
from dexsim_ppo import load_policy, train_policy
from dexsim_ppo.evaluate import Evaluator
from dexsim_ppo.policy import Policy
from dexsim_ppo.training.presets import find_preset
from dexsim_ppo.training.runlog import RunFolder
from dexsim_real.twin.plant.parameters import skill_of
from paper.data import BUDGETS, ROOT, Budget, Row
from paper.held_out import NAMES, HeldOutGrasp

TOUCH = ("contact_force", "contact_centre")
HELD_OUT_POOL = 480
FOREIGN = str(ROOT / "assets" / "plants" / "foreign_right.xml")


def trained(row: Row, seed: int, budget: Budget, work: Path) -> dict[str, Any]:
    """Train a seed of a row, or finish its training; then measure the policy in both worlds, and of a row that says
    what the emulated hand draws on a foreign plant as well. There a policy that observes touch is also measured in
    simulation without it ("ablated") and with the touch of another episode ("another").

    A budget without training measures the shipped policy of the skill in its place, one for all rows.
    """
    policy, training = train(row, seed, budget, work) if budget.training else (row.skill, None)
    loaded = load_policy(policy)
    task = "rotate_any" if any("cylinder" in setting for setting in row.settings) else row.skill
    given = tuple((name, float(value)) for name, _, value in (item.partition("=") for item in row.plant))
    report = {
        "simulation": simulate(loaded, (), budget),
        "hand": trials(task, policy, seed, budget.name, given),
    }
    if row.plant:
        report["foreign"] = trials(task, policy, seed, budget.name, given, FOREIGN)
        if {entry.name for entry in loaded.observation_layout}.issuperset(TOUCH):
            report["ablated"] = simulate(loaded.ablate(*TOUCH), (), budget)
            report["another"] = simulate(loaded, (), budget, AnotherTouch)
    return report | {"training": training}


def measured(row: Row, seed: int, budget: Budget, work: Path, *, worlds: Sequence[str]) -> dict[str, Any]:
    """A shipped policy, with the row's observation fields ablated, in "simulation", on the emulated "hand", or in
    both."""
    report = {}
    if "simulation" in worlds:
        report["simulation"] = simulate(load_policy(row.policy).ablate(*row.ablate), row.settings, budget)
    if "hand" in worlds:
        report["hand"] = trials(row.skill, row.policy, seed, budget.name)
    return report


def train(row: Row, seed: int, budget: Budget, folder: Path) -> tuple[str, dict[str, Any]]:
    """The policy of a seed and what its training took; resumes a run that was interrupted."""
    run = RunFolder(folder)
    if not run.report.exists():
        if run.checkpoints.exists() and run.existing_checkpoints():
            train_policy(resume=folder)
        else:
            # A run without a checkpoint has nothing to resume, and its folder is in the way.
            shutil.rmtree(folder, ignore_errors=True)
            ppo, changes = find_preset(budget.preset, row.task).ppo, budget.learner.get(row.skill, {})
            train_policy(
                row.task,
                task_config(row),
                ppo=dataclasses.replace(ppo, **changes),
                preset=budget.preset,
                backend=budget.backend,
                **budget.training[row.skill],
                seed=seed,
                run_dir=folder,
                video=False,
            )
    report = json.loads(run.report.read_text())
    return str(folder / report["policy"]), {
        "env_steps": report["origin"]["env_steps"],
        **budget.training[row.skill] | budget.learner.get(row.skill, {}),
        "seed": seed,
        "hardware": report["hardware"],
    }


def task_config(row: Row) -> Any:
    """Configuration of a row's task.

    Raises:
      ConfigError: a setting that the task does not have, or a value out of range.
    """
    entry = find_task(row.task)
    return from_dict(entry.config_class, override(to_dict(entry.config()), row.settings))


def swept(row: Row, seed: int, budget: Budget, work: Path) -> dict[str, Any]:
    """A shipped policy at each point of a sweep; a row without a parameter is the reference."""
    del seed, work
    policy, sweep, results = load_policy(row.policy), budget.sweep, []
    budget = dataclasses.replace(budget, episodes=sweep["episodes"], seconds=sweep["seconds"])
    points: tuple[float | None, ...] = row.points if sweep["points"] else ()
    if len(points) > sweep["points"]:
        points = (points[0], points[-1])
    for point in points or (None,):
        settings = [] if point is None else [setting.format(point, point) for setting in row.settings]
        report = simulate(policy, settings, budget)
        names = ("held", "r_taxels", "r_resultant", "force_error_n")
        if row.skill == "rotate":
            names = ("kept_to_the_end", "successes_per_minute", "seconds_to_fall", "successes")
            report["successes"] = report["successes"]["mean"]
        results.append({"point": point} | {name: report[name] for name in names})
    return {"points": results}


class AnotherTouch(Evaluator):
    """Episodes in which the policy feels what another episode's hand touches at the same time."""

    def seen(self, observation: jax.Array) -> jax.Array:
        """The observations [chunk, n] with touch from half a chunk further."""
        layout = self.env.observation_layout["actor"]
        touch = np.repeat([entry.name in TOUCH for entry in layout], [entry.size for entry in layout])
        return jnp.where(touch, jnp.roll(observation, self.chunk // 2, axis=0), observation)


def simulate(
    policy: Policy, settings: Sequence[str], budget: Budget, evaluator: type[Evaluator] = Evaluator
) -> dict[str, Any]:
    """The report of a policy's evaluation in the environment that it was trained in, with changes to its configuration.

    Episodes are rounded up to whole batches of 64 (1,024 on a GPU).
    """
    skill, length = skill_of(policy.task), list[str]()
    if skill in budget.seconds:
        length = [f"evaluation_seconds={budget.seconds[skill]}"]
    config = json.dumps(override(policy.env_config, [*settings, *length]), sort_keys=True)
    episodes, batch = budget.episodes[skill], 1024 if budget.backend == "auto" else 64
    made = _evaluator(policy.task, config, budget.backend, min(episodes, batch), evaluator)
    return _report(made, policy, episodes)


def _report(evaluator: Evaluator, policy: Policy, episodes: int) -> dict[str, Any]:
    report, _ = evaluator(policy.params, episodes=episodes, seed=0)
    del report["task"]["headline"]
    return report["task"] | {"backend": evaluator.env.backend}


@functools.lru_cache(maxsize=4)
def _evaluator(task: str, config: str, backend: str, chunk: int, kind: type[Evaluator]) -> Evaluator:
    """Compiled evaluations; rows of one environment share them."""
    made = from_dict(find_task(task).config_class, json.loads(config))
    return kind(dexsim.make(task, made, backend=backend), chunk)


@functools.lru_cache(maxsize=4)
def trials(
    task: str, policy: str, seed: int, budget_name: str, given: tuple = (), plant_model: str | None = None
) -> dict[str, Any]:
    """The metrics of trials on the emulated hand in virtual time, every parameter outside training's ranges but those
    that are `given`."""
    budget, skill = BUDGETS[budget_name], skill_of(task)
    options = {
        "task": task,
        "policy": policy,
        "seed": [seed],
        "parameters": "outside",
        "seconds": budget.seconds.get(skill),
        "set": dict(given),
        "limit": {},
        "plant_model": plant_model,
    }
    reports = zero_shot.run_all(options, budget.trials[skill], budget.processes, show=False)
    return zero_shot.metrics(task, policy, reports) | {"trials": len(reports)}


def held_out(row: Row, seed: int, budget: Budget, work: Path) -> dict[str, Any]:
    """A shipped policy with held-out objects, each at every command."""
    del seed, work
    policy, hand = load_policy(row.policy), dexsim.load_hand()
    names, settings = NAMES, [*row.settings, f"pool_size={HELD_OUT_POOL}"]
    if not budget.training:  # A look at the machinery.
        names, settings = NAMES[:3], [*settings, "pool_size=30"]
    if seconds := budget.seconds.get("grasp"):
        settings.append(f"evaluation_seconds={seconds}")
    config = from_dict(GraspConfig, override(policy.env_config, settings))
    env = Env(HeldOutGrasp(config, hand, names), hand, backend=budget.backend)
    return {"simulation": _report(Evaluator(env, 5 * len(names)), policy, budget.objects * len(names))}


def points_at_twice(low: float, high: float, floor: float = 0.0) -> tuple[float, float, float, float]:
    """Ends of a range of training and of one twice as wide about its middle, not below `floor`."""
    middle, half = (low + high) / 2, (high - low) / 2
    return max(middle - 2 * half, floor), low, high, middle + 2 * half
