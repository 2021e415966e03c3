"""The rotation task's evaluation report: the paper's metrics, and how the hand moved."""

import numpy as np

from dexsim.core import statistics

_PERCENTILES = (1, 5, 10, 25, 50, 75, 90, 95, 99)


def summarize(metrics: dict[str, np.ndarray], episode_length: np.ndarray, control_period: float, ticks: int) -> dict:
    """Reduce an evaluation to a report.

    Args:
      metrics: [N] of each episode's last tick, as the environment returns them.
      episode_length: [N] ticks before the object was lost.
      control_period: s.
      ticks: length of an episode that nothing ended.

    Returns:
      A JSON-able dict. "successes" are consecutive by nature: a drop ends the episode. They count goals
      reached under the configured test (with spin), "paper_successes" those under the paper's.
      "successes_per_minute" is their number in all episodes over all the time that episodes lasted, the time in
      which a hand is stuck included: 60 over it is the paper's seconds per success. "seconds_per_success" is the
      time at the last goal over their number, of episodes with one or more, so that time stuck after it is left
      out. "seconds_to_fall" is cut at the episode's length where the object stayed. "axes" has the results of each axis
      in the order of `turn.axes`. Intervals are 95 %: Wilson's for proportions, else bootstrap over episodes.
    """
    seconds, successes = episode_length * control_period, metrics["successes"]
    some = successes > 0
    pace = metrics["time_at_last_success"][some] / successes[some]
    kept = episode_length >= ticks
    duty = np.stack([metrics[name] for name in sorted(metrics) if name.startswith("duty/")], -1)
    minutes = np.maximum(seconds, control_period) / 60  # A drop in the first tick leaves none.
    report = {
        "episodes": int(episode_length.size),
        "seconds": ticks * control_period,
        "successes": _counts(successes),
        "paper_successes": _counts(metrics["paper_successes"]),
        "without_success": statistics.proportion(~some),
        "seconds_per_success": statistics.mean(pace),
        "seconds_to_fall": statistics.mean(seconds)
        | {"median": float(np.median(seconds)), "longest": float(seconds.max())},
        "kept_to_the_end": statistics.proportion(kept),
        "rotations_per_minute": statistics.mean(metrics["spin"] * 60 / (2 * np.pi)),
        "successes_per_minute": statistics.ratio(successes, minutes),
        "end": {
            "pushed_out": int(np.sum(metrics["pushed_out"] > 0)),
            "slipped": int(np.sum(metrics["slipped"] > 0)),
            "timeout": int(np.sum(kept)),
        },
        "gait": {
            "joint_speed_rad_s": statistics.mean(metrics["joint_speed"]),
            "action_rate": statistics.mean(metrics["action_rate"]),
            "spin_rad_s": statistics.mean(metrics["spin"]),
            "tilt_rad": statistics.mean(metrics["tilt"]),
            "fingertip_duty": [float(x) for x in duty.mean(0)],
        },
        "non_finite": int(np.sum(metrics["non_finite"] > 0)),
    }
    axes = [
        {"successes": _counts(successes[rows]), "kept_to_the_end": statistics.proportion(kept[rows])}
        for rows in (metrics["axis"] == axis for axis in np.unique(metrics["axis"]))
    ]
    report |= {"axes": axes} if len(axes) > 1 else {}
    return report | {"headline": _headline(report)}


def _headline(report: dict) -> dict:
    """What a hand that only keeps the object fails, and how the hand moved."""
    duty = np.array(report["gait"]["fingertip_duty"])
    return {
        "successes (median)": statistics.entry(report["successes"]["median"]),
        "successes (mean)": statistics.entry(report["successes"]["mean"]),
        "successes (10th percentile)": report["successes"]["percentiles"]["10"],
        "paper's successes (mean)": statistics.entry(report["paper_successes"]["mean"]),
        "successes per minute, time stuck included": statistics.entry(report["successes_per_minute"]),
        "joint speed (rad/s)": statistics.entry(report["gait"]["joint_speed_rad_s"]),
        "fingertips at work (duty over 10 %)": int(np.sum(duty > 0.1)),
        **{
            f"successes (mean), axis {number}": statistics.entry(axis["successes"]["mean"])
            for number, axis in enumerate(report.get("axes", []), 1)
        },
    }


def _counts(values: np.ndarray) -> dict:
    return {
        "mean": statistics.mean(values),
        "median": statistics.interval(lambda rows: np.median(values[rows]), values.size, "median"),
        "percentiles": {str(q): float(np.percentile(values, q)) for q in _PERCENTILES},
        # Of very many an even selection.
        "sorted": np.sort(values)[np.linspace(0, values.size - 1, min(values.size, 100)).round().astype(int)].tolist(),
    }
