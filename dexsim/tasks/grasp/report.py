"""The grasp task's evaluation report: catch rate, hold time, commanded against measured force."""

import numpy as np

from dexsim.core.statistics import bootstrap, entry, mean, proportion, statistic
from dexsim.force_loop import target_force
from dexsim.objects.config import KINDS

SETTLE = 3.0  # s after release from which forces count
FORCES = {"r_resultant": "force", "r_normal": "normal", "r_taxels": "taxels"}
"""Correlations with the command, and what of the contact force each takes: all of it with friction, what of it presses
into the skin, and what of that the taxels bear. The metric is `finger_` and this."""
_MEANS = "total_force", "total_torque", "taxel_force", "thumb_force", "touching", "torque_limited"


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
      A JSON-able dict. Forces are averaged over the ticks of "window_s": from 3 s after release (from the middle of
      shorter episodes) to the end, for episodes held to the end. "finger_..." are means over the touching fingers but
      the thumb, of which the command speaks; "total_force" is the solver's force summed over all fingers,
      "taxel_force" that sum as the taxels feel it.
      "r_resultant", "r_normal" and "r_taxels" correlate command and commanded force, see `FORCES`.
      "total_torque" is the sum over touching fingers of the root joint's torque as a share of its limit; "r_torque"
      correlates it with the command. "slope_torque" and "slope_force_n" are least-squares slopes over the command, of
      it and of the commanded force.
      "torque_limited" is the share of these ticks with a joint at its torque limit: there force cannot follow.
      "force_error_n" is the root mean square error of the resultant over all episodes; a lost object is not pressed.
      Intervals are 95 %: Wilson's for proportions, else bootstrap over episodes.
    """
    ticks, episodes = alive.shape
    held = alive[-1]
    late = slice(min(round(SETTLE / control_period), ticks // 2), None)
    command, shape = metrics["command"][0], metrics["shape"][0].astype(int)
    forces = {part: f"finger_{part}" for part in FORCES.values()}
    # Of each episode [N], the mean over its late ticks.
    mean_of = {name: np.where(alive, metrics[name], 0.0)[late].mean(0) for name in (*forces.values(), *_MEANS)}
    target = target_force(command, span)
    commanded = {part: mean_of[name] for part, name in forces.items()}
    by_command = [_command_row(level, command, held, target, mean_of) for level in np.unique(command)]
    by_shape = [
        _shape_row(shapes[index], shape == index, command, held, target, commanded) for index in np.unique(shape)
    ]
    means = [row["total_force_n"]["mean"] for row in by_command]
    complete = all(m is not None for m in means)
    report = {
        "episodes": episodes,
        "seconds": ticks * control_period,
        "window_s": list(window(ticks * control_period)),
        "held": proportion(held),
        "hold_time_s": mean(alive.sum(0) * control_period),
        **correlations(command, held, commanded),
        "r_torque": pearson(command[held], mean_of["total_torque"][held]),
        "slope_force_n": slope(command[held], commanded["force"][held]),
        "slope_torque": slope(command[held], mean_of["total_torque"][held]),
        "force_error_n": force_error(commanded["force"], target),
        "torque_limited": mean(mean_of["torque_limited"][held]),
        "force_range": float(means[-1] / means[0]) if complete and len(means) > 1 and means[0] > 0 else None,
        "total_force_monotone": bool(complete and np.all(np.diff(means) > 0)),
        "finger_force_by_command_n": [row["finger_force_n"]["mean"] for row in by_command],
        "total_force_by_command_n": means,
        "skin_correlation": _optional_pearson(metrics, alive),
        "joint_speed_rad_s": mean(np.where(alive, metrics["joint_speed"], 0.0).sum(0) / np.maximum(alive.sum(0), 1)),
        "non_finite": int(metrics["non_finite"].sum()),
        "by_command": by_command,
        "by_shape": by_shape,
    }
    return report | {"headline": _headline(report)}


def _command_row(
    level: float,
    command: np.ndarray,
    held: np.ndarray,
    target: np.ndarray,
    mean_of: dict[str, np.ndarray],
) -> dict:
    """The episodes at one command; arrays [N] are of all episodes."""
    mine = command == level
    good = mine & held
    return {
        "command": float(level),
        "episodes": int(mine.sum()),
        "held": proportion(held[mine]),
        "target_force_n": float(target[mine].mean()),
        **{f"{n}_n": mean(mean_of[n][good]) for n in (f"finger_{part}" for part in FORCES.values())},
        "total_force_n": mean(mean_of["total_force"][good]),
        "total_torque": mean(mean_of["total_torque"][good]),
        "taxel_force_n": mean(mean_of["taxel_force"][good]),
        "thumb_force_n": mean(mean_of["thumb_force"][good]),
        "touching_fingers": mean(mean_of["touching"][good]),
        "torque_limited": mean(mean_of["torque_limited"][good]),
        "saturates": saturates(mean_of["torque_limited"][good]),
    }


def _shape_row(
    name: str,
    mine: np.ndarray,
    command: np.ndarray,
    held: np.ndarray,
    target: np.ndarray,
    commanded: dict[str, np.ndarray],
) -> dict:
    """The episodes `mine` with one shape; arrays [N] are of all episodes."""
    return {
        "shape": name,
        "episodes": int(mine.sum()),
        "held": proportion(held[mine]),
        **correlations(command, mine & held, commanded),
        "force_error_n": force_error(commanded["force"][mine], target[mine]),
    }


def _headline(report: dict) -> dict:
    start, end = report["window_s"]
    by_shape = [row["r_taxels"]["r"] for row in report["by_shape"]]
    return {
        "held": entry(report["held"]),
        "held at worst command": min(row["held"]["mean"] for row in report["by_command"]),
        "force error, 0 N where lost (N)": entry(report["force_error_n"]),
        f"r, resultant force ({start:.3g} to {end:.3g} s)": entry(report["r_resultant"]),
        "r, normal force": entry(report["r_normal"]),
        "r, force on the taxels": entry(report["r_taxels"]),
        "r, force on the taxels, worst shape": min((r for r in by_shape if r is not None), default=None),
        "ticks with a joint at its torque limit": entry(report["torque_limited"]),
        "force range": report["force_range"],
    }


def _optional_pearson(metrics: dict[str, np.ndarray], alive: np.ndarray) -> dict | None:
    if "skin_force" not in metrics:
        return None
    keep = alive & (metrics["total_force"] > 0.01)
    # Both are of the taxels: skin beyond them may bear load as well.
    return pearson(metrics["skin_force"][keep], metrics["taxel_force"][keep], samples=0)


def saturates(torque_limited: np.ndarray) -> bool:
    """Whether a command is beyond the motors: held objects [N] see a joint at its torque limit most of the time."""
    return bool(torque_limited.size and torque_limited.mean() > 0.5)


def correlations(command: np.ndarray, held: np.ndarray, commanded: dict[str, np.ndarray]) -> dict:
    """Pearson's r of command [N] and each of `FORCES` [N], of what was held [N]."""
    return {name: pearson(command[held], commanded[part][held]) for name, part in FORCES.items()}


def force_error(values: np.ndarray, target: np.ndarray) -> dict:
    """Root mean square error with a bootstrap 95 % interval."""
    return statistic((values - target) ** 2, lambda square: np.sqrt(square.mean()), "mean")


def pearson(x: np.ndarray, y: np.ndarray, samples: int = 500) -> dict:
    """Correlation with a bootstrap 95 % interval; None where it is undefined."""

    def correlate(rows: np.ndarray | slice) -> float:
        a, b = x[rows], y[rows]
        return float(np.corrcoef(a, b)[0, 1]) if a.std() > 0 and b.std() > 0 else np.nan

    if x.size < 3 or x.std() == 0 or y.std() == 0:
        return {"r": None, "low": None, "high": None}
    low, high = bootstrap(correlate, x.size, samples) if samples else (None, None)
    return {"r": correlate(slice(None)), "low": low, "high": high}


def slope(x: np.ndarray, y: np.ndarray, samples: int = 500) -> dict:
    """Least-squares slope of y over x with a bootstrap 95 % interval; None where it is undefined."""

    def fit(rows: np.ndarray | slice) -> float:
        off = x[rows] - x[rows].mean()
        return float(off @ y[rows] / (off @ off)) if off.any() else np.nan

    if x.size < 3 or x.std() == 0:
        return {"mean": None, "low": None, "high": None}
    low, high = bootstrap(fit, x.size, samples)
    return {"mean": fit(slice(None)), "low": low, "high": high}
