"""What a table is made of: rows, seeds and budgets; and where its reports are."""

import dataclasses
import functools
import hashlib
import json
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np

from dexsim.core.assets import asset_path
from dexsim_ppo.policy import load_policy
from dexsim_real.twin.plant.parameters import skill_of

ROOT = Path(__file__).resolve().parents[2]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Budget:
    """How much a row may cost. A row keeps the report of the largest budget, the last of `BUDGETS`."""

    name: str
    preset: str = "cpu"
    backend: str = "c"
    # By skill: options of the training command for one seed. Empty: shipped policies stand in, nothing is trained.
    training: dict[str, dict[str, float]]
    learner: dict[str, dict[str, float]] = dataclasses.field(default_factory=dict)  # changes to the preset's PPO
    episodes: dict[str, int]  # of an evaluation in simulation
    trials: dict[str, int]  # on the emulated hand, for each seed
    seconds: dict[str, float] = dataclasses.field(default_factory=dict)  # of evaluations, trials; else the task's own
    sweep: dict[str, Any]  # points of each row (0: training's ranges alone, 2: the ends); episodes and seconds by skill
    objects: int  # evaluation episodes of each held-out object
    processes: int = 1  # for trials; a GPU needs more than one: the bridge's JAX is on the CPU


BUDGETS = {
    "smoke": Budget(
        name="smoke",
        training={},
        episodes={"grasp": 10, "rotate": 10},
        trials={"grasp": 1, "rotate": 1},
        seconds={"grasp": 0.3, "rotate": 0.3},
        sweep={"points": 0, "episodes": {"grasp": 10, "rotate": 10}, "seconds": {"grasp": 0.3, "rotate": 0.3}},
        objects=5,
    ),
    "cpu": Budget(
        name="cpu",
        training={"grasp": {"minutes": 20.0}, "rotate": {"minutes": 30.0}},
        episodes={"grasp": 150, "rotate": 16},
        trials={"grasp": 25, "rotate": 10},
        sweep={"points": 2, "episodes": {"grasp": 25, "rotate": 16}, "seconds": {"grasp": 8.0, "rotate": 20.0}},
        objects=25,
    ),
    "gpu": Budget(
        name="gpu",
        preset="gpu",
        backend="auto",
        training={"grasp": {"steps": 9e7, "evaluate_every": 0}, "rotate": {"steps": 4e7, "evaluate_every": 0}},
        # Larger steps at first: four seeds of rotate had two goals an episode after 14 to 20 million steps.
        learner={"rotate": {"learning_rate": 1e-3, "kl_target": 0.04, "kl_halving": 150}},
        episodes={"grasp": 256, "rotate": 128},
        trials={"grasp": 50, "rotate": 10},
        sweep={"points": 4, "episodes": {"grasp": 256, "rotate": 256}, "seconds": {"grasp": 8.0, "rotate": 20.0}},
        objects=50,
        processes=8,
    ),
}
BUDGETS["long"] = dataclasses.replace(
    BUDGETS["gpu"],
    name="long",
    training={"grasp": {"steps": 1.5e8, "evaluate_every": 0}, "rotate": {"steps": 1e8, "evaluate_every": 0}},
    trials={"grasp": 50, "rotate": 6},
)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Row:
    """One configuration of a table."""

    name: str  # folder of its report
    label: str
    task: str = ""  # registered task that it trains or measures
    settings: tuple[str, ...] = ()  # changes to the task's configuration, as `--set` of the evaluation takes them
    policy: str = ""  # shipped policy that is measured
    ablate: tuple[str, ...] = ()  # observation fields that the policy does without
    points: tuple[float, ...] = ()  # of a sweep, in order
    plant: tuple[str, ...] = ()  # parameters of the emulated hand that are not drawn, such as edge=0.055
    paper: dict[str, str] = dataclasses.field(default_factory=dict)  # the paper's numbers, by column

    @property
    def skill(self) -> str:
        """grasp or rotate."""
        return skill_of(self.task)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Experiment:
    """A table, and figures of it."""

    name: str
    title: str
    rows: tuple[Row, ...]
    measure: Callable[[Row, int, Budget, Path], dict[str, Any]]  # of a row and seed; the path is its training's folder
    table: Callable[["Experiment", dict[str, dict]], list[list[str]]]  # header and rows, from the reports by row
    draw: Callable[["Experiment", dict[str, dict], Path], None] | None = None  # writes figures into a folder
    training_seeds: int = 0  # training runs of each row; 0: nothing is trained

    def seeds(self, budget: Budget) -> range:
        """Seeds of each row; what is not trained has one."""
        return range(self.training_seeds if self.training_seeds and budget.training else 1)


def report_path(folder: Path, experiment: Experiment, row: Row) -> Path:
    """File of a row's report."""
    return folder / experiment.name / row.name / "report.json"


def load_report(path: Path) -> dict[str, Any]:
    """A row's report; empty if there is none."""
    return json.loads(path.read_text()) if path.is_file() else {}


def settings_of(row: Row) -> dict[str, Any]:
    """What a report must have been measured with to be this row's, the weights of the shipped policy among it."""
    settings = {
        name: list(value) if isinstance(value, tuple) else value
        for name, value in dataclasses.asdict(row).items()
        if name not in ("label", "paper") and (name != "plant" or value)
    }
    return settings | ({"weights": weights_of(asset_path(f"policies/{row.policy}.msgpack"))} if row.policy else {})


@functools.cache
def weights_of(file: Path) -> str:
    """Sixteen digits of the SHA-256 of a policy's arrays; a policy of other weights is another policy."""
    leaves = jax.tree.leaves(load_policy(file).params)
    return hashlib.sha256(b"".join(np.asarray(leaf).tobytes() for leaf in leaves)).hexdigest()[:16]


def missing_seeds(experiment: Experiment, row: Row, budget: Budget, report: dict[str, Any]) -> list[int]:
    """Seeds that a row's report, which may be empty, lacks for a budget."""
    expected, sizes = list(experiment.seeds(budget)), list(BUDGETS)
    larger = sizes.index(report["budget"]) - sizes.index(budget.name) if report else 0
    if not report or report["row"] != settings_of(row) or larger < 0:
        return expected
    if larger > 0:
        return []
    return [seed for seed in expected if str(seed) not in report["seeds"]]


@functools.cache
def commit() -> str:
    """The commit that runs, in seven digits, and whether the code differs from it."""
    git, code = ["git", "-C", str(ROOT)], ("dexsim", "dexsim_ppo", "dexsim_real", "benchmarks", "assets")
    head = subprocess.run([*git, "rev-parse", "--short=7", "HEAD"], capture_output=True, text=True)
    changed = subprocess.run([*git, "status", "--porcelain", "-uno", *code], capture_output=True, text=True)
    return head.stdout.strip() + (" (changed)" if changed.stdout.strip() else "")
