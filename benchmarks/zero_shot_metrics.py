"""What the trials of `zero_shot.py` amount to: metrics, and a table beside the policy's report in simulation."""

import json
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np

from dexsim.control import target_force
from dexsim.core.assets import asset_path
from dexsim.core.errors import DexsimError
from dexsim.core.statistics import mean, proportion, ratio
from dexsim.hand.description import Hand
from dexsim.render.snapshot import Snapshot
from dexsim.tasks.grasp.report import FORCES, correlations, force_error, pearson, saturates, slope
from dexsim_real.twin.plant.shapes import matrix


def grasp_metrics(reports: list[dict[str, Any]], span: tuple[float, float]) -> dict[str, Any]:
    """Success rate, force error over all trials, and correlation of the forces of held objects with the command.

    Names, window and forces are those of the evaluation in simulation (`dexsim.tasks.grasp.report`); torques are as the
    bridge measures them.

    Args:
      reports: the referee's, of trials.
      span: N, target at command 0 and 1.
    """
    held = np.array([r["held"] for r in reports])
    forces = {part: f"finger_{part}" for part in FORCES.values()}
    names = (*forces.values(), "total_force", "total_torque", "torque_limited")
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
        "r_torque": pearson(command[held], mean_of["total_torque"][held]),
        "slope_force_n": slope(command[held], commanded["force"][held]),
        "slope_torque": slope(command[held], mean_of["total_torque"][held]),
        "torque_limited": mean(mean_of["torque_limited"][held]),
        "window_s": [float(start.min()), float(end.max())],
        "by_command": by_command,
        "by_shape": by_shape,
    }


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
    from dexsim_ppo.policy import load_policy

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
        size = np.zeros((len(parts), 3))
        for row, part in zip(size, parts, strict=True):
            row[: len(part["size"])] = part["size"]
        snapshot = Snapshot(
            joint_position=np.array(before["joint_position"]),
            object_position=np.array(before["object_position"]),
            object_rotation=matrix(np.array(before["object_quat"])),
            primitive_size=size,
            primitive_position=np.array([part["place"] for part in parts]),
            primitive_rotation=np.tile(np.eye(3), (len(parts), 1, 1)),
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
    """The same metrics from the policy's report in simulation; those that it has."""
    path = Path(policy).with_suffix(".json")
    try:
        path = path if path.is_file() else asset_path(f"policies/{Path(policy).stem}.json")
        report = json.loads(path.read_text())
        report = report.get("evaluation", report["trained"])["task"]
    except (OSError, KeyError, ValueError, DexsimError):
        return {}
    if task == "grasp":
        names = ("held", "force_error_n", *FORCES, "r_torque", "slope_force_n", "slope_torque")
        names = (*names, "torque_limited", "by_command")
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
    names = [name for name in here if isinstance(here[name], dict) and name != "lost"]
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
    if here.get("lost"):
        lines.append("lost: " + ", ".join(f"{cause} {count}" for cause, count in here["lost"].items()))
    if "window_s" in here:
        lines.append("forces and r: of held objects, from {:g} to {:g} s after release".format(*here["window_s"]))
    return "\n".join(lines)
