"""How far two training runs are apart: the last checkpoints' numbers, and the metrics of the last common iteration.

    python benchmarks/same_training.py runs/one-device runs/two-devices

`relative` is the largest difference over the largest magnitude, array by array, and of them the worst in each part.
"""

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np

from dexsim_ppo import checkpoint
from dexsim_ppo.training.runlog import RunFolder, read_metrics

PARTS = ("params", "adam", "observation_stats", "value_stats", "env_state")
METRICS = ("reward", "kl", "value_loss", "episode/return", "learning_rate")


def compare(first: Path, second: Path) -> dict[str, Any]:
    """The comparison as plain data.

    Raises:
      SystemExit: their last checkpoints are not of the same iteration.
    """
    runs = [RunFolder(path) for path in (first, second)]
    states = [checkpoint.load(run.latest_checkpoint(), kind="train").leaves for run in runs]
    iterations = [int(state[".iteration"]) for state in states]
    if iterations[0] != iterations[1]:
        raise SystemExit(f"error: {first} ends at iteration {iterations[0]}, {second} at {iterations[1]}")
    relative = dict.fromkeys(PARTS, 0.0)
    for name, mine in states[0].items():
        part = name.lstrip(".").replace("[", ".").split(".")[0]
        if part in relative and isinstance(mine, np.ndarray) and mine.dtype.kind == "f" and mine.size:
            theirs = states[1][name]
            far = np.max(np.abs(mine - theirs)) / max(float(np.max(np.abs(mine))), 1e-9)
            relative[part] = max(relative[part], float(far))
    rows = [{row["iteration"]: row for row in read_metrics(run.metrics)} for run in runs]
    common = max(set(rows[0]) & set(rows[1]), default=None)
    values = {
        name: [row[common].get(name) for row in rows]
        for name in METRICS
        if common is not None and all(row[common].get(name) is not None for row in rows)
    }
    return {"iteration": iterations[0], "relative": relative, "metrics_at": common, "metrics": values}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("runs", nargs=2, type=Path, help="folders of the runs")
    print(json.dumps(compare(*parser.parse_args().runs)))


if __name__ == "__main__":
    main()
