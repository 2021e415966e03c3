"""The grasp task's evaluation report: catch rate, hold time, commanded against measured force."""

import numpy as np

from dexsim.core.statistics import bootstrap, mean, proportion, statistic
from dexsim.objects.config import KINDS

_SETTLE = 3.0  # s after release from which forces count


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
    force = metrics["finger_force"][late].mean(0)
    pressing = metrics["finger_pressing"][late].mean(0)
    total = metrics["total_force"][late].mean(0)
    sensed = metrics["taxel_force"][late].mean(0)
    thumb = metrics["thumb_force"][late].mean(0)
    touching = metrics["touching"][late].mean(0)
    wanted = span[0] + command * (span[1] - span[0])
    returns = np.where(alive, metrics["reward"], 0.0).sum(0) if "reward" in metrics else metrics["return"].max(0)

    by_command = []
    for level in np.unique(command):
        mine = command == level
        good = mine & held
        by_command.append(
            {
                "command": float(level),
                "episodes": int(mine.sum()),
                "held": proportion(held[mine]),
                "target_force_n": float(wanted[mine].mean()),
                "finger_force_n": mean(force[good]),
                "total_force_n": mean(total[good]),
                "taxel_force_n": mean(sensed[good]),
                "thumb_force_n": mean(thumb[good]),
                "touching_fingers": mean(touching[good]),
            }
        )
    by_shape = []
    for index in np.unique(shape):
        mine = shape == index
        good = mine & held
        by_shape.append(
            {
                "shape": KINDS[index],
                "episodes": int(mine.sum()),
                "held": proportion(held[mine]),
                "pearson_r": pearson(command[good], force[good]),
                "pearson_r_pressing": pearson(command[good], pressing[good]),
                "pearson_r_total": pearson(command[good], total[good]),
                "pearson_r_taxels": pearson(command[good], sensed[good]),
                "rmse_n": rmse(force[good], wanted[good]),
            }
        )

    means = [row["total_force_n"]["mean"] for row in by_command]
    finger_means = [row["finger_force_n"]["mean"] for row in by_command]
    complete = all(m is not None for m in means)
    monotone = bool(complete and np.all(np.diff(means) > 0))
    ratio = float(means[-1] / means[0]) if complete and len(means) > 1 and means[0] > 0 else None
    report = {
        "episodes": episodes,
        "seconds": ticks * control_period,
        "held": proportion(held),
        "hold_time_s": mean(alive.sum(0) * control_period),
        "return": mean(returns),
        "pearson_r": pearson(command[held], force[held]),
        "pearson_r_pressing": pearson(command[held], pressing[held]),
        "pearson_r_total": pearson(command[held], total[held]),
        "rmse_n": rmse(force[held], wanted[held]),
        "force_range": ratio,
        "total_force_monotone": monotone,
        "finger_force_by_command_n": finger_means,
        "total_force_by_command_n": means,
        "skin_correlation": _optional_pearson(metrics, alive),
        "joint_speed_rad_s": mean(metrics["joint_speed"].mean(0)),
        "non_finite": int(metrics["non_finite"].sum()),
        "by_command": by_command,
        "by_shape": by_shape,
    }
    r = [row["pearson_r"]["r"] for row in by_shape]
    report["headline"] = {
        "held": report["held"]["mean"],
        "held at worst command": min(row["held"]["mean"] for row in by_command),
        "Pearson r (all)": report["pearson_r"]["r"],
        "Pearson r (worst shape)": min((x for x in r if x is not None), default=None),
        "force range": ratio,
        "RMSE (N)": report["rmse_n"]["mean"],
        "return": report["return"]["mean"],
    }
    return report


def _optional_pearson(metrics: dict[str, np.ndarray], alive: np.ndarray) -> dict | None:
    if "skin_force" not in metrics:
        return None
    keep = alive & (metrics["total_force"] > 0.01)
    return pearson(metrics["skin_force"][keep], metrics["total_force"][keep], samples=0)


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
