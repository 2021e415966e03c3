"""Tables of the experiments: a header and rows of text, made from the reports."""

from collections.abc import Iterable
from typing import Any

from paper.data import Experiment, Row

Reports = dict[str, dict[str, Any]]


def cell(entries: Iterable[dict[str, Any] | None]) -> str:
    """A number with its interval: of one seed the 95 % interval over episodes, of several the lowest and highest."""
    valid = [entry for entry in entries if entry and _middle(entry) is not None]
    if not valid:
        return ""
    values = [_middle(entry) for entry in valid]
    if len(values) > 1:
        return f"{sum(values) / len(values):.3g} ({min(values):.3g}–{max(values):.3g})"
    low, high = valid[0].get("low"), valid[0].get("high")
    span = "" if low is None or high is None else f" ({low:.3g}–{high:.3g})"
    return f"{values[0]:.3g}{span}"


def percent(entries: Iterable[dict[str, Any] | None]) -> str:
    """`cell` of shares, in per cent."""
    parts = ("mean", "low", "high")
    return cell({k: v and 100 * v for k, v in entry.items() if k in parts} for entry in entries if entry)


def _middle(entry: dict[str, Any]) -> Any:
    return next((entry[name] for name in ("mean", "median", "r") if name in entry), None)


def seeds(report: dict[str, Any] | None) -> list[dict[str, Any]]:
    """What was found for each seed."""
    return list(report["seeds"].values()) if report else []


def how(row: Row, report: dict[str, Any] | None) -> str:
    """Where a row's numbers are from."""
    if not report:
        return "not trained yet"
    count = len(report["seeds"])
    trained = [seed["training"] for seed in seeds(report) if seed.get("training")]
    if not trained:
        return f"{report['budget']} budget"
    short = "short " if row.skill == "rotate" and report["budget"] == "cpu" else ""
    minutes, steps = trained[0].get("minutes"), trained[0].get("steps", 0.0)
    each = f"{minutes:g} min" if minutes else f"{steps / 1e6:g} million steps"
    return f"{count} × {short}{each}, {report['budget']} budget"


def rotation(experiment: Experiment, reports: Reports) -> list[list[str]]:
    """The paper's columns beside ours in simulation and on the emulated hand."""
    paper = any(row.paper for row in experiment.rows)
    head = ["observation", *(["paper: mean / median / s each / s to fall"] if paper else [])]
    head += ["simulation: mean", "median", "s each", "s to fall"]
    hand = any("hand" in seed for report in reports.values() for seed in seeds(report))
    head += ["emulated hand: mean", "median", "s to fall"] if hand else []
    lines = [[*head, "measured"]]
    for row in experiment.rows:
        report = reports.get(row.name)
        simulated = [seed["simulation"] for seed in seeds(report) if "simulation" in seed]
        line = [row.label]
        if paper:
            line.append(row.paper["mean / median / s each / s to fall"])
        key = "paper_successes" if row.task == "rotate_paper" else "successes"
        # Seconds a success over all the time that trials lasted.
        pace = [s["seconds_to_fall"]["mean"] / s[key]["mean"]["mean"] for s in simulated if s[key]["mean"]["mean"]]
        line += [
            cell(s[key]["mean"] for s in simulated),
            cell(s[key]["median"] for s in simulated),
            cell({"mean": seconds} for seconds in pace),
            cell(s["seconds_to_fall"] for s in simulated),
        ]
        if hand:
            worlds = [seed["hand"] for seed in seeds(report) if "hand" in seed]
            line += [
                cell(s[key] for s in worlds),
                cell({"median": s[key]["median"]} for s in worlds),
                cell(s["seconds_to_fall"] for s in worlds),
            ]
        lines.append([*line, how(row, report)])
    return lines


def mean_turns(seed: dict[str, Any], world: str) -> dict[str, Any]:
    """Mean of the quarter turns in a trial, with its interval."""
    found = seed[world]["successes"]
    return found if world in ("hand", "foreign") else found["mean"]


def touch_map(experiment: Experiment, reports: Reports) -> list[list[str]]:
    """Quarter turns of each world with touch and without it, and in simulation where a policy trained with touch runs
    without it or with that of another episode."""
    lines = [["orientation, object, pushes and friction"]]
    worlds = {"simulation": "simulation", "hand": "emulated hand", "foreign": "foreign plant"}
    lines[0] += [f"{name}: {touch}" for name in worlds.values() for touch in ("touch", "none")]
    lines[0] += ["simulation: touch ablated", "another's touch", "measured"]
    for row, without in zip(experiment.rows[::2], experiment.rows[1::2], strict=True):
        pair = [seeds(reports.get(each.name)) for each in (row, without)]
        cells = [cell(mean_turns(seed, world) for seed in each) for world in worlds for each in pair]
        cells += [cell(mean_turns(seed, way) for seed in pair[0]) for way in ("ablated", "another")]
        lines.append([row.label, *cells, how(row, reports.get(row.name))])
    return lines


def grasp(experiment: Experiment, reports: Reports) -> list[list[str]]:
    """Ranges of force and torque over the command in both worlds, correlations and slopes."""
    head = ["reward", "paper: force [N]", "paper: torque"]
    for world in ("simulation", "emulated hand"):
        head += [f"{world}: held [%]", "total force [N]", "total torque", "r, force", "r, torque", "N / command"]
    lines = [[*head, "measured"]]
    for row in experiment.rows:
        report = reports.get(row.name)
        line = [row.label, row.paper["force range [N]"], row.paper["torque range"]]
        for world in ("simulation", "hand"):
            results = [seed[world] for seed in seeds(report)]
            line += [
                percent(s["held"] for s in results),
                _range(results, "total_force_n"),
                _range(results, "total_torque"),
                cell(s["r_resultant"] for s in results),
                cell(s.get("r_torque") for s in results),
                cell(s.get("slope_force_n") for s in results),
            ]
        lines.append([*line, how(row, report)])
    return lines


def _range(results: list[dict[str, Any]], name: str) -> str:
    """Means at the first and the last command, averaged over the seeds that have both."""
    ends = [[report["by_command"][k][name]["mean"] for k in (0, -1)] for report in results]
    ends = [end for end in ends if None not in end]
    if not ends:
        return ""
    low, high = (sum(end[k] for end in ends) / len(ends) for k in (0, 1))
    return f"{low:.3g}–{high:.3g}"


def commands(experiment: Experiment, reports: Reports) -> list[list[str]]:
    """What is held and pressed at each command."""
    lines = [["world", "command", "held [%]", "finger force [N]", "total force [N]", "total torque"]]
    for world, label in (("simulation", "simulation"), ("hand", "emulated hand")):
        for seed in (s for report in reports.values() for s in seeds(report)):
            result = seed[world]
            for row in result["by_command"]:
                cells = [cell([row[name]]) for name in ("finger_force_n", "total_force_n", "total_torque")]
                lines.append([label, f"{row['command']:g}", percent([row["held"]]), *cells])
            force = f"r {cell([result['r_resultant']])}, slope {cell([result['slope_force_n']])} N"
            torque = f"r {cell([result['r_torque']])}, slope {cell([result['slope_torque']])}"
            lines.append([label, "all", percent([result["held"]]), force, "", torque])
    return lines


def held_out(experiment: Experiment, reports: Reports) -> list[list[str]]:
    """Every object, the worst first, and then every command."""
    lines = [["object", "held [%]", "r, resultant force", "r, force on the taxels", "force error [N]"]]
    for result in (s["simulation"] for report in reports.values() for s in seeds(report)):
        for row in sorted(result["by_shape"], key=lambda row: (row["held"]["mean"], row["shape"])):
            lines.append(_object(row["shape"].replace("_", " "), row))
        for row in result["by_command"]:
            lines.append([f"command {row['command']:g}, all objects", percent([row["held"]]), "", "", ""])
        lines.append(_object("all objects, all commands", result))
    return lines


def _object(name: str, row: dict[str, Any]) -> list[str]:
    return [name, percent([row["held"]]), *(cell([row[key]]) for key in ("r_resultant", "r_taxels", "force_error_n"))]


def sweeps(experiment: Experiment, reports: Reports) -> list[list[str]]:
    """Success at the measured points of each parameter."""
    lines = [["sweep", "**value**: grasps held [%] and r of the force, or cubes kept [%] and quarter turns a minute"]]
    for row in experiment.rows:
        points = [point for seed in seeds(reports.get(row.name)) for point in seed["points"]]
        texts = [_point(row.skill, point) for point in points]
        lines.append([row.label, "; ".join(texts) or "not measured yet"])
    return lines


def _point(skill: str, point: dict[str, Any]) -> str:
    name = "" if point["point"] is None else f"**{point['point']:.3g}**: "
    if skill == "grasp":
        return f"{name}{percent([point['held']])}, {cell([{'r': point['r_resultant']['r']}])}"
    return f"{name}{percent([point['kept_to_the_end']])}, {cell([point['successes_per_minute']])}"
