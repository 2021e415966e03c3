"""Mutation testing: one small change at a time in code that users rely on, and whether the default tests notice it.

    make mutants ARGS="--seed 1"
    python benchmarks/mutants.py --count 100 --minutes 60 --processes 2

cosmic-ray makes the changes: another operator, the opposite condition, a number one higher or lower, no pass of a loop.
Each is made in a copy of the checkout and tried by the tests that `TESTS` names, up to the first failure. Type
annotations and the bounds of settings stay as they are. The run becomes a record of
`docs/experiments/mutants.jsonl`.
"""

import argparse
import ast
import datetime
import json
import os
import random
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from cosmic_ray.ast import ast_nodes, get_ast
from cosmic_ray.mutating import mutate_code, use_mutation
from cosmic_ray.plugins import get_operator
from cosmic_ray.testing import run_tests
from cosmic_ray.work_item import TestOutcome

ROOT = Path(__file__).resolve().parents[1]
_RUN = "tests/dexsim_real/run tests/dexsim_real/calibrate/test_procedure.py tests/dexsim_real/twin/test_twin_virtual.py"
_CONFIG, _ENV = "tests/dexsim/core/test_config.py", "tests/dexsim/env tests/dexsim/tasks"
_OBSERVED = "tests/dexsim/test_observation.py tests/dexsim/hand/test_mirror.py"
_SHIPPED = "tests/dexsim_ppo/test_shipped_policy.py"
TESTS = {
    "dexsim_real/control": f"{_CONFIG} tests/dexsim_real/control tests/dexsim_real/sensors {_RUN}",
    "dexsim_real/sensors": f"{_CONFIG} tests/dexsim_real/sensors tests/dexsim_real/control {_RUN}",
    "dexsim_ppo/learner": f"{_CONFIG} tests/dexsim_ppo/learner tests/dexsim_ppo/training",
    "dexsim/env": f"{_CONFIG} {_ENV} tests/dexsim/test_randomization.py tests/dexsim/test_registry.py",
    "dexsim/tasks": f"{_CONFIG} {_ENV} {_SHIPPED} tests/dexsim_real/twin/plant/test_parameters.py",
    "dexsim/touch": f"{_CONFIG} tests/dexsim/touch tests/dexsim/test_control.py {_ENV}",
    "dexsim/actuator": f"tests/dexsim/actuator {_ENV} tests/dexsim/identification",
    "dexsim/observation.py": f"{_CONFIG} {_OBSERVED} {_ENV} {_SHIPPED}",
}
"""Tests that can notice a change in a folder or module, the nearest first."""
_PAIRS = "Add_Sub Sub_Add Mul_Div Div_Mul Pow_Mul BitAnd_BitOr BitOr_BitAnd".split()
_OPPOSITES = "Eq_NotEq NotEq_Eq Lt_GtE GtE_Lt Gt_LtE LtE_Gt Is_IsNot IsNot_Is".split()
_OTHERS = """ReplaceUnaryOperator_Delete_USub ReplaceUnaryOperator_Delete_Not ReplaceUnaryOperator_Delete_Invert
  ReplaceTrueWithFalse ReplaceFalseWithTrue ReplaceAndWithOr ReplaceOrWithAnd NumberReplacer ZeroIterationForLoop"""
OPERATORS = (
    *(f"core/ReplaceBinaryOperator_{pair}" for pair in _PAIRS),
    *(f"core/ReplaceComparisonOperator_{pair}" for pair in _OPPOSITES),
    *(f"core/{name}" for name in _OTHERS.split()),
)


class Mutant(NamedTuple):
    """The place in a module where an operator makes its `occurrence`-th change."""

    folder: str
    path: str
    line: int
    operator: str
    occurrence: int

    def __str__(self) -> str:
        code = mutate_code((ROOT / self.path).read_text(), get_operator(self.operator)(), self.occurrence)
        return f"{self.path}:{self.line} {code.splitlines()[self.line - 1].strip()}"


def mutants() -> Iterator[Mutant]:
    """All possible changes."""
    for folder in TESTS:
        for path in sorted((ROOT / folder).rglob("*.py")) or [ROOT / folder]:
            source = path.read_text()
            tree, skipped = get_ast(source), list(_skipped(ast.parse(source)))
            for name in OPERATORS:
                positions = get_operator(name)().mutation_positions
                starts = [start for node in ast_nodes(tree) for start, _ in positions(node)]
                for occurrence, at in enumerate(starts):
                    if not any(start <= at < end for start, end in skipped):
                        yield Mutant(folder, str(path.relative_to(ROOT)), at[0], name, occurrence)


def _skipped(tree: ast.AST) -> Iterator[tuple[tuple[int, int], tuple[int, int]]]:
    for node in ast.walk(tree):
        parts = [getattr(node, "annotation", None), getattr(node, "returns", None)]
        if isinstance(node, ast.keyword) and node.arg in ("low", "high"):
            parts.append(node.value)
        for part in filter(None, parts):
            yield (part.lineno, part.col_offset), (part.end_lineno, part.end_col_offset)


def sample(count: int, seed: int) -> list[Mutant]:
    """Folders, then operators, with equal chances: otherwise most would be numbers, and a third in the tasks."""
    groups = dict[str, dict[str, list[Mutant]]]()
    for mutant in mutants():
        groups.setdefault(mutant.folder, {}).setdefault(mutant.operator, []).append(mutant)
    draw, chosen = random.Random(seed), dict[Mutant, None]()
    while len(chosen) < count:
        operators = draw.choice(list(groups.values()))
        chosen[draw.choice(draw.choice(list(operators.values())))] = None
    return list(chosen)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--count", type=int, default=100)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--processes", type=int, default=2)
    arguments = parser.parse_args()
    command = f"{sys.executable} -m pytest -x -q -p no:cacheprovider"
    if arguments.processes > 1:
        command += f" -n {arguments.processes} --dist loadfile --no-loadscope-reorder"
    until, limits, survived = time.monotonic() + 60 * arguments.minutes, dict[str, float](), list[str]()

    def notice(mutant: Mutant) -> bool:
        """Whether tests, which pass on the unchanged copy, fail with a change."""
        tests = TESTS[mutant.folder]
        if tests not in limits:
            begin = time.monotonic()
            outcome, output = run_tests(f"{command} {tests}", 1800)
            if outcome != TestOutcome.SURVIVED:
                raise RuntimeError(f"tests fail without any change: {tests}\n{output}")
            limits[tests] = 60 + 4 * (time.monotonic() - begin)  # s; a longer run is a hang, which is noticed, too
        with use_mutation(Path(mutant.path), get_operator(mutant.operator)(), mutant.occurrence):
            return run_tests(f"{command} {tests}", limits[tests])[0] != TestOutcome.SURVIVED

    with tempfile.TemporaryDirectory() as copy:
        for name in filter(None, _git("ls-files", "-z").split("\0")):
            Path(copy, name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(ROOT / name, Path(copy, name))
        os.chdir(copy)
        os.environ["PYTHONPATH"] = copy
        left = sample(arguments.count, arguments.seed)
        while left and time.monotonic() < until:
            mutant = left.pop(0)
            if not notice(mutant):
                survived.append(str(mutant))
                print("SURVIVED", mutant, flush=True)
    commit, count = _git("rev-parse", "--short=7", "HEAD").strip(), arguments.count - len(left)
    record = {
        "id": f"mutants-{commit}-seed{arguments.seed}",
        "date": datetime.date.today().isoformat(),
        "commit": commit,
        "title": f"Mutation testing: {count} changes of safety, learner, environment and touch",
        "command": f"python benchmarks/mutants.py --count {arguments.count} --seed {arguments.seed}",
        "hardware": f"{arguments.processes} of {os.cpu_count()} CPU cores",
        "seeds": [arguments.seed],
        "metrics": {"mutants": count, "killed": count - len(survived), "survived": survived},
        "verdict": f"{100 * (1 - len(survived) / max(count, 1)):.0f} % noticed by the default tests; target 95 %",
        "tags": ["tests"],
        "notes": "",
    }
    with (ROOT / "docs" / "experiments" / "mutants.jsonl").open("a") as file:
        file.write(json.dumps(record) + "\n")


def _git(*words: str) -> str:
    return subprocess.run(["git", *words], cwd=ROOT, check=True, capture_output=True, text=True).stdout


if __name__ == "__main__":
    main()
