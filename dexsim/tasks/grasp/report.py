"""The grasp task's evaluation report: catch rate, hold time, commanded against measured force."""

import numpy as np

from dexsim.control import target_force
from dexsim.core.statistics import entry, interval, mean, proportion
from dexsim.objects.config import KINDS

SETTLE = 3.0  # s after release from which forces count
FORCES = {"r_resultant": "force", "r_normal": "normal", "r_taxels": "taxels"}
"""Correlations with the command, and what of the contact force each takes: all of it with friction, what of it presses
into the skin, and what of that the taxels bear. The metric is `finger_` and this."""
MEANS = (*(f"finger_{part}" for part in FORCES.values()), "total_force", "total_torque", "touching", "torque_limited")
_UNITS = {"total_torque": "total_torque", "touching": "touching_fingers", "torque_limited": "torque_limited"}
"""Names of what is not in N, by metric."""


def window(seconds: float) -> tuple[float, float]:
    """From when to when [s] after release the forces of a trial of this length count."""
    return min(SETTLE, seconds / 2), seconds


def summarize(
    metrics: dict[str, np.ndarray],
    alive: np.ndarray,
    control_period: float,
    span: tuple[float, float],
    shapes: tuple[str, ...] = KINDS,
) -> dict:
    """Reduce an evaluation to a report.

    Args:
      metrics: [T, N] per tick and episode, as the environment returns them.
      alive: [T, N] bool, False after the object was lost.
      control_period: s.
      span: N, a finger's target at command 0 and 1.
      shapes: names of what the metric "shape" counts.

    Returns:
      A JSON-able dict. Forces are averaged over the ticks of "window_s", for episodes held to the end. "finger_..." are
      means over the touching fingers but the thumb, of which the command speaks; "total_force" is the solver's force
      summed over all fingers. "total_torque" is the sum over touching fingers of the root joint's torque as a share of
      its limit, "torque_limited" the share of ticks with a joint at its limit: there force cannot follow. "r_..."
      correlate the command with the commanded force (`FORCES`) and the torque, "slope_..." are least-squares slopes
      over it. "force_error_n" is the root mean square error of the resultant over all episodes; a lost object is not
      pressed. Intervals are 95 %: Wilson's for proportions, else bootstrap over episodes.
    """
    ticks, episodes = alive.shape
    late = slice(min(round(SETTLE / control_period), ticks // 2), None)
    # Of each episode [N], the mean over its late ticks.
    late_means = {name: np.where(alive, metrics[name], 0.0)[late].mean(0) for name in MEANS}
    report = {
        "episodes": episodes,
        "seconds": ticks * control_period,
        "window_s": list(window(ticks * control_period)),
        **reduce(metrics["command"][0], alive[-1], metrics["shape"][0].astype(int), late_means, span, shapes),
        "joint_speed_rad_s": mean(np.where(alive, metrics["joint_speed"], 0.0).sum(0) / np.maximum(alive.sum(0), 1)),
        "non_finite": int(metrics["non_finite"].sum()),
    }
    return report | {"headline": _headline(report)}


def reduce(
    command: np.ndarray,
    held: np.ndarray,
    shape: np.ndarray,
    means: dict[str, np.ndarray],
    span: tuple[float, float],
    shapes: tuple[str, ...],
) -> dict:
    """What the reports of simulation and of the emulated hand share; see `summarize`. Of each episode [N] the command,
    whether it held to the end, the index of its shape, and by metric its mean over the window, 0 after a loss."""
    target, force = target_force(command, span), means["finger_force"]

    def correlations(chosen: np.ndarray) -> dict:
        return {name: pearson(command[chosen], means[f"finger_{part}"][chosen]) for name, part in FORCES.items()}

    def command_row(level: float) -> dict:
        mine = command == level
        good = mine & held
        return {
            "command": float(level),
            "episodes": int(mine.sum()),
            "held": proportion(held[mine]),
            "target_force_n": float(target[mine].mean()),
            **{_UNITS.get(name, f"{name}_n"): mean(values[good]) for name, values in means.items()},
            # Beyond the motors: held objects see a joint at its torque limit most of the time.
            "saturates": bool(good.any() and means["torque_limited"][good].mean() > 0.5),
        }

    def shape_row(index: int) -> dict:
        mine = shape == index
        return {
            "shape": shapes[index],
            "episodes": int(mine.sum()),
            "held": proportion(held[mine]),
            **correlations(mine & held),
            "force_error_n": force_error(force[mine], target[mine]),
        }

    return {
        "held": proportion(held),
        **correlations(held),
        "r_torque": pearson(command[held], means["total_torque"][held]),
        "slope_force_n": slope(command[held], force[held]),
        "slope_torque": slope(command[held], means["total_torque"][held]),
        "force_error_n": force_error(force, target),
        "torque_limited": mean(means["torque_limited"][held]),
        "by_command": [command_row(level) for level in np.unique(command)],
        "by_shape": [shape_row(index) for index in np.unique(shape)],
    }


def _headline(report: dict) -> dict:
    start, end = report["window_s"]
    by_shape = [row["r_taxels"]["r"] for row in report["by_shape"]]
    return {
        "held": entry(report["held"]) | {"unit": "%"},
        "held at the worst command": {"value": min(row["held"]["mean"] for row in report["by_command"]), "unit": "%"},
        "force error, 0 N if lost": entry(report["force_error_n"]) | {"unit": "N"},
        f"r, contact force, {start:.0f} to {end:.0f} s": entry(report["r_resultant"]),
        "r, normal force": entry(report["r_normal"]),
        "r, force on the taxels": entry(report["r_taxels"]),
        "r, force on the taxels, worst shape": min((r for r in by_shape if r is not None), default=None),
        "time at a torque limit": entry(report["torque_limited"]) | {"unit": "%"},
    }


def force_error(values: np.ndarray, target: np.ndarray) -> dict:
    """Root mean square error with a bootstrap 95 % interval."""
    square = (values - target) ** 2
    return interval(lambda rows: np.sqrt(square[rows].mean()), square.size)


def pearson(x: np.ndarray, y: np.ndarray, samples: int = 500) -> dict:
    """Correlation with a bootstrap 95 % interval; None where it is undefined."""

    def correlate(rows: np.ndarray | slice) -> float:
        a, b = x[rows], y[rows]
        return float(np.corrcoef(a, b)[0, 1]) if a.std() > 0 and b.std() > 0 else np.nan

    return interval(correlate, x.size if x.size >= 3 else 0, "r", samples)


def slope(x: np.ndarray, y: np.ndarray) -> dict:
    """Least-squares slope of y over x with a bootstrap 95 % interval; None where it is undefined."""

    def fit(rows: np.ndarray | slice) -> float:
        off = x[rows] - x[rows].mean()
        return float(off @ y[rows] / (off @ off)) if off.any() else np.nan

    return interval(fit, x.size if x.size >= 3 else 0)
