"""The grasp task's evaluation report: catch rate, hold time, commanded against measured force."""

import numpy as np

from dexsim.core.statistics import bootstrap, mean, proportion, statistic
from dexsim.objects.config import KINDS

_SETTLE = 3.0  # s after release from which forces count
_FORCES = ("finger_force", "finger_pressing", "total_force", "taxel_force", "thumb_force", "touching")


def summarize(
    metrics: dict[str, np.ndarray], alive: np.ndarray, control_period: float, span: tuple[float, float]
) -> dict:
    """Reduce an evaluation to a report.

    Args:
      metrics: [T, N] per tick and episode, as the environment returns them.
      alive: [T, N] bool, False after the object was lost.
      control_period: s.
      span: N, target force per touching finger at command 0 and 1.

    Returns:
      A JSON-able dict. Forces are averaged over the ticks from 3 s after release (from the
      middle of shorter episodes), for episodes held to the end. "finger_force" is the solver's
      force per touching finger among those commanded (all but the thumb), friction included, "total_force" the
      sum over all fingers, "taxel_force" that sum as the taxels feel it. "pearson_r" goes by "finger_force",
      "pearson_r_pressing" by what the taxels feel of it: the normal forces, which the paper's hand measures.
      Intervals are 95 %: Wilson's for proportions, else bootstrap over episodes.
    """
    ticks, episodes = alive.shape
    held = alive[-1]
    late = slice(min(round(_SETTLE / control_period), ticks // 2), None)
    command, shape = metrics["command"][0], metrics["shape"][0].astype(int)
    # Of each episode [N], the mean over its late ticks.
    mean_of = {name: metrics[name][late].mean(0) for name in _FORCES}
    wanted = span[0] + command * (span[1] - span[0])
    force, total = mean_of["finger_force"], mean_of["total_force"]
    returns = np.where(alive, metrics["reward"], 0.0).sum(0) if "reward" in metrics else metrics["return"].max(0)
    by_command = [_command_row(level, command, held, wanted, mean_of) for level in np.unique(command)]
    by_shape = [_shape_row(index, shape, command, held, wanted, mean_of) for index in np.unique(shape)]
    means = [row["total_force_n"]["mean"] for row in by_command]
    complete = all(m is not None for m in means)
    report = {
        "episodes": episodes,
        "seconds": ticks * control_period,
        "held": proportion(held),
        "hold_time_s": mean(alive.sum(0) * control_period),
        "return": mean(returns),
        "pearson_r": pearson(command[held], force[held]),
        "pearson_r_pressing": pearson(command[held], mean_of["finger_pressing"][held]),
        "pearson_r_total": pearson(command[held], total[held]),
        "rmse_n": rmse(force[held], wanted[held]),
        "force_range": float(means[-1] / means[0]) if complete and len(means) > 1 and means[0] > 0 else None,
        "total_force_monotone": bool(complete and np.all(np.diff(means) > 0)),
        "finger_force_by_command_n": [row["finger_force_n"]["mean"] for row in by_command],
        "total_force_by_command_n": means,
        "skin_correlation": _optional_pearson(metrics, alive),
        "joint_speed_rad_s": mean(metrics["joint_speed"].mean(0)),
        "non_finite": int(metrics["non_finite"].sum()),
        "by_command": by_command,
        "by_shape": by_shape,
    }
    return report | {"headline": _headline(report)}


def _command_row(
    level: float, command: np.ndarray, held: np.ndarray, wanted: np.ndarray, mean_of: dict[str, np.ndarray]
) -> dict:
    """The episodes at one command; arrays [N] are of all episodes."""
    mine = command == level
    good = mine & held
    return {
        "command": float(level),
        "episodes": int(mine.sum()),
        "held": proportion(held[mine]),
        "target_force_n": float(wanted[mine].mean()),
        "finger_force_n": mean(mean_of["finger_force"][good]),
        "total_force_n": mean(mean_of["total_force"][good]),
        "taxel_force_n": mean(mean_of["taxel_force"][good]),
        "thumb_force_n": mean(mean_of["thumb_force"][good]),
        "touching_fingers": mean(mean_of["touching"][good]),
    }


def _shape_row(
    index: int,
    shape: np.ndarray,
    command: np.ndarray,
    held: np.ndarray,
    wanted: np.ndarray,
    mean_of: dict[str, np.ndarray],
) -> dict:
    """The episodes with one shape; arrays [N] are of all episodes."""
    mine = shape == index
    good = mine & held
    force = mean_of["finger_force"][good]
    return {
        "shape": KINDS[index],
        "episodes": int(mine.sum()),
        "held": proportion(held[mine]),
        "pearson_r": pearson(command[good], force),
        "pearson_r_pressing": pearson(command[good], mean_of["finger_pressing"][good]),
        "pearson_r_total": pearson(command[good], mean_of["total_force"][good]),
        "pearson_r_taxels": pearson(command[good], mean_of["taxel_force"][good]),
        "rmse_n": rmse(force, wanted[good]),
    }


def _headline(report: dict) -> dict:
    by_shape = [row["pearson_r"]["r"] for row in report["by_shape"]]
    return {
        "held": report["held"]["mean"],
        "held at worst command": min(row["held"]["mean"] for row in report["by_command"]),
        "Pearson r (all)": report["pearson_r"]["r"],
        "Pearson r (worst shape)": min((r for r in by_shape if r is not None), default=None),
        "force range": report["force_range"],
        "RMSE (N)": report["rmse_n"]["mean"],
        "return": report["return"]["mean"],
    }


def _optional_pearson(metrics: dict[str, np.ndarray], alive: np.ndarray) -> dict | None:
    if "skin_force" not in metrics:
        return None
    keep = alive & (metrics["total_force"] > 0.01)
    # Both are of the taxels: skin beyond them may bear load as well.
    return pearson(metrics["skin_force"][keep], metrics["taxel_force"][keep], samples=0)


def rmse(values: np.ndarray, wanted: np.ndarray) -> dict:
    """Root mean square error with a bootstrap 95 % interval."""
    return statistic((values - wanted) ** 2, lambda square: np.sqrt(square.mean()), "mean")


def pearson(x: np.ndarray, y: np.ndarray, samples: int = 500) -> dict:
    """Correlation with a bootstrap 95 % interval; None where it is undefined."""

    def correlate(rows: np.ndarray | slice) -> float:
        a, b = x[rows], y[rows]
        return float(np.corrcoef(a, b)[0, 1]) if a.std() > 0 and b.std() > 0 else np.nan

    if x.size < 3 or x.std() == 0 or y.std() == 0:
        return {"r": None, "low": None, "high": None}
    low, high = bootstrap(correlate, x.size, samples) if samples else (None, None)
    return {"r": correlate(slice(None)), "low": low, "high": high}
