"""Renders the experiment log: one Markdown table for each `*.jsonl` beside this file.

    python docs/experiments/render.py

A record is one line of JSON with the keys in `KEYS`. README.md, beside this file, explains them.
"""

import datetime
import json
import re
from pathlib import Path
from typing import Any

HERE = Path(__file__).parent
KEYS = ("id", "date", "commit", "title", "command", "hardware", "seeds", "metrics", "verdict", "tags", "notes")

GRASP = {
    "held_pct": "held [%]",
    "held_worst_command_pct": "worst command [%]",
    "r_resultant": "r, resultant",
    "r_normal": "r, normal",
    "r_taxels": "r, taxels",
    "force_error_n": "force error [N]",
    "pearson_r": "force r",
    "force_rmse_n": "force RMSE [N]",
    "force_range": "force range [×]",
}
ROTATE = {
    "successes_median": "successes, median",
    "successes_mean": "mean",
    "successes_p10": "10th percentile",
    "successes_per_minute": "per minute",
    "do_nothing_successes_mean": "doing nothing, mean",
    "without_success_pct": "no success [%]",
    "seconds_per_success": "s per success",
    "never_dropped_pct": "never dropped [%]",
}
HELD = {
    "held_pct": "held [%]",
    "do_nothing_held_pct": "doing nothing, held [%]",
    "force_error_n": "force error [N]",
    "r_resultant": "r, resultant",
    "r_normal": "r, normal",
    "r_taxels": "r, taxels",
    "torque_limited_pct": "at a torque limit [%]",
}
TABLES: dict[str, tuple[str, dict[str, str]]] = {
    "rotate_training": ("Training: rotate", ROTATE | {"fingertips_working": "fingertips"}),
    "grasp_training": ("Training: grasp", GRASP),
    "evaluation": (
        "Evaluations in simulation",
        ROTATE | HELD | {"pearson_r": "force r"},
    ),
    "ablation": (
        "Tactile ablation",
        {"successes_mean": "successes, mean", "successes_median": "median", "never_dropped_pct": "never dropped [%]"},
    ),
    "zero_shot_grasp": (
        "Zero-shot on the emulated hand: grasp",
        {"trials": "trials"} | HELD | {"pearson_r_normal": "pearson_r_normal", "pearson_r": "pearson_r"},
    ),
    "zero_shot_rotate": (
        "Zero-shot on the emulated hand: rotate",
        {
            "trials": "trials",
            "successes_mean": "successes, mean",
            "successes_per_minute": "per minute",
            "do_nothing_successes_mean": "doing nothing, mean",
            "seconds_per_success": "s per success",
            "seconds_to_drop": "s to the drop",
            "never_dropped_pct": "never dropped [%]",
        },
    ),
    "throughput": (
        "Throughput",
        {"environments": "environments", "env_steps_per_s": "env-steps/s", "touch_share_pct": "touch [% of a step]"},
    ),
    "touch": (
        "Touch: cost and accuracy",
        {
            "ms": "ms, 4,096 envs",
            "ms_8192": "ms, 8,192 envs",
            "ms_32768": "ms, 32,768 envs",
            "step_share_pct_32768": "query alone, % of a step, 32,768 envs",
        },
    ),
    "physics": (
        "Physics",
        {f"pearson_r_per_finger_{s}": f"skin law r, {s}" for s in ("sphere", "box", "cylinder", "capsule")}
        | {f"force_difference_p95_n_{s}": f"force difference p95, {s} [N]" for s in ("box", "cylinder", "capsule")}
        | {
            "place_error_max_mm": "place off at most: grip, slide, roll, drop [mm]",
            "force_error_max_n": "force off at most: grip, slide, roll, drop [N]",
        },
    ),
    "cpu": (
        "Two CPU cores",
        {
            "wall_clock": "wall clock",
            "tests_s": "tests [s]",
            "first_update_s": "first update [s]",
            "env_steps_per_s": "env-steps/s",
            "held_pct": "held [%]",
        },
    ),
    "calibration": (
        "Calibration: coverage of the 95 % intervals",
        {
            "intervals": "intervals",
            "covered_pct": "hold the truth [%]",
            "covered_before_pct": "before [%]",
            "half_width_pct": "half-width, median [%]",
            "mean_error_pct": "error, mean [%]",
        },
    ),
    "bridge": (
        "Bridge: timing, faults, calibration",
        {
            "policy_late_p99_ms": "policy late, p99 [ms]",
            "exchange_late_p99_ms": "exchange late, p99 [ms]",
            "deadlines_missed": "deadlines missed",
            "commands_outside_limits": "commands outside limits",
        },
    ),
}
"""File name, title, and the metrics that its table shows."""


def load(name: str) -> list[dict[str, Any]]:
    """The records of one file.

    Raises:
      ValueError: a record breaks the schema; names the file and the line.
    """
    records = []
    for line, text in enumerate((HERE / f"{name}.jsonl").read_text(encoding="utf-8").splitlines(), 1):
        record = json.loads(text)
        if problem := check(record):
            raise ValueError(f"{name}.jsonl:{line}: {problem}")
        records.append(record)
    return records


def check(record: dict[str, Any]) -> str | None:
    """What breaks the schema in a record, or None."""
    if tuple(record) != KEYS:
        return f"keys are {list(record)}, not {list(KEYS)}"
    if not re.fullmatch(r"[a-z0-9][a-z0-9.-]*", record["id"]):
        return f"id {record['id']!r} has other characters than a-z, 0-9, '.' and '-'"
    try:
        datetime.date.fromisoformat(record["date"])
    except ValueError:
        return f"date {record['date']!r} is not ISO 8601"
    for key in ("commit", "title", "command", "hardware", "verdict", "notes"):
        if not isinstance(record[key], str):
            return f"{key} is not text"
    if record["commit"] and not re.fullmatch(r"[0-9a-f]{7}( \(.+\))?", record["commit"]):
        return f"commit {record['commit']!r} is not seven digits, with a remark in brackets"
    if not (record["title"] and record["command"] and record["verdict"]):
        return "title, command or verdict is empty"
    if not all(isinstance(seed, int) for seed in record["seeds"]):
        return "seeds are not integers"
    for name, value in record["metrics"].items():
        if not all(isinstance(v, (int, float, str)) for v in (value if isinstance(value, list) else [value])):
            return f"metric {name} is neither a number, nor text, nor a list of them"
        if name.endswith("_ci95") and not isinstance(value, str) and len(value) != 2:
            return f"metric {name} is no interval"
    return None


def render(name: str) -> str:
    """The Markdown page of one file."""
    title, columns = TABLES[name]
    records = load(name)
    lines = [
        f"# {title}",
        "",
        f"Generated from [{name}.jsonl]({name}.jsonl) by `python docs/experiments/render.py`. The records also hold",
        "command, seeds, notes and all other metrics. Values in brackets are 95 % intervals.",
        "",
        _row(["record", "date", "commit", *columns.values(), "verdict"]),
        "|---" * (len(columns) + 4) + "|",
    ]
    for record in records:
        cells = [_value(record["metrics"], metric) for metric in columns]
        named = f'<a id="{record["id"]}"></a>{record["title"]} (`{record["id"]}`)'
        commit = record["commit"].split(" ")[0]
        lines.append(_row([named, record["date"], commit, *cells, record["verdict"]]))
    return "\n".join(lines) + "\n"


def _row(cells: list[str]) -> str:
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"


def _value(metrics: dict[str, Any], name: str) -> str:
    if name not in metrics:
        return ""
    text = _plain(metrics[name])
    interval = metrics.get(name + "_ci95")
    return f"{text} ({interval[0]}–{interval[1]})" if isinstance(interval, list) else text


def _plain(value: Any) -> str:
    if isinstance(value, list):
        return ", ".join(_plain(v) for v in value)
    return f"{value:,}" if isinstance(value, int) else str(value)


if __name__ == "__main__":
    for table in TABLES:
        (HERE / f"{table}.md").write_text(render(table), encoding="utf-8")
