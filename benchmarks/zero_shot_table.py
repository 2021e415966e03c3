"""The table of `zero_shot.py`: trials on the emulated hand beside the policy's report in simulation."""

import json
from pathlib import Path
from typing import Any


def simulated(task: str, policy: str) -> dict[str, Any]:
    """The same metrics from the policy's report in simulation; those that it has."""
    from dexsim.core.assets import asset_path
    from dexsim.core.errors import DexsimError
    from dexsim.tasks.grasp.report import FORCES

    path = Path(policy).with_suffix(".json")
    try:
        path = path if path.is_file() else asset_path(f"policies/{Path(policy).stem}.json")
        report = json.loads(path.read_text())
        report = report.get("evaluation", report["trained"])["task"]
    except (OSError, KeyError, ValueError, DexsimError):
        return {}
    if task == "grasp":
        names = (
            "held",
            "force_error_n",
            *FORCES,
            "r_torque",
            "slope_force_n",
            "slope_torque",
            "torque_limited",
            "by_command",
        )
        return {name: report[name] for name in names if name in report}
    counts = {
        name: report[name]["mean"] | {"median": report[name]["median"]["median"]}
        for name in ("successes", "paper_successes")
    }
    names = "successes_per_minute", "seconds_to_fall", "kept_to_the_end"
    return counts | {name: report[name] for name in names if name in report}


def table(here: dict[str, Any], there: dict[str, Any], idle: dict[str, Any]) -> str:
    """Table with the columns metric, emulated hand, simulation, and a hand that does nothing in the same trials."""

    def cell(entry: Any) -> str:
        if not isinstance(entry, dict):
            return "-"
        key = "r" if "r" in entry else "mean"
        if entry.get(key) is None:
            return "-"
        span = f" ({entry['low']:.3g} to {entry['high']:.3g})" if entry.get("low") is not None else ""
        middle = f", median {entry['median']:.3g}" if "median" in entry else ""
        return f"{entry[key]:.3g}{span}{middle}"

    def at(metrics: dict[str, Any], command: float) -> dict[str, Any]:
        return next((row for row in metrics.get("by_command", []) if row["command"] == command), {})

    force = "finger_force"
    names = [name for name in here if isinstance(here[name], dict)]
    rows = [(name.replace("_", " "), cell(here[name]), cell(there.get(name)), cell(idle.get(name))) for name in names]
    for entry in here.get("by_command", []):
        other, still = (at(metrics, entry["command"]) for metrics in (there, idle))
        for name, shown, name_there in (
            ("held", "held", "held"),
            (force, f"{force.replace('_', ' ')} (N)", f"{force}_n"),
            ("torque_limited", "ticks with a joint at its torque limit", "torque_limited"),
        ):
            cells = cell(entry[name]), cell(other.get(name_there)), cell(still.get(name))
            mark = " (saturates)" if name == force and entry["saturates"] else ""
            rows.append((f"command {entry['command']:g}: {shown}{mark}", *cells))
    rows += [(f"{entry['shape']}: held", cell(entry["held"]), "", "") for entry in here.get("by_shape", [])]
    rows = [("", "emulated hand", "simulation", "doing nothing"), *rows]
    widths = [max(len(row[k]) for row in rows) for k in range(4)]
    lines = ["  ".join(text.ljust(width) for text, width in zip(row, widths, strict=True)).rstrip() for row in rows]
    if "window_s" in here:
        lines.append("forces and r: of held objects, from {:g} to {:g} s after release".format(*here["window_s"]))
    return "\n".join(lines)
