"""What an evaluation reports: figures with intervals by start state, and the table that is printed of them."""

from typing import Any

import numpy as np

from dexsim.core import statistics


def summarize(env: Any, metrics: dict[str, np.ndarray], terminated: np.ndarray, start: np.ndarray) -> dict[str, Any]:
    """Report of episodes from their metrics [T, N], termination flags [T, N] and starts [N].

    An episode lives up to, and not including, its first terminated step, whose reward belongs to the return.

    Returns:
      "held" (share of episodes never terminated), "return" and "steps_held", each with a 95 % interval by start, their
      numbers, and "task": what the task's `summarize` makes of its metrics.
    """
    steps, episodes = terminated.shape
    alive = ~np.logical_or.accumulate(terminated, axis=0)
    steps_held, starts = alive.sum(axis=0), len(np.unique(start))
    last = {name: x[np.minimum(steps_held, steps - 1), np.arange(episodes)] for name, x in metrics.items()}
    if env.evaluation == "totals":
        own = env.summarize(last, steps_held)
    else:
        # A step that diverges ends the episode: it must be counted although the episode does not survive it.
        entered = np.concatenate([np.ones((1, episodes), bool), alive[:-1]])
        masked = {name: np.where(entered if name == "non_finite" else alive, x, 0) for name, x in metrics.items()}
        own = env.summarize(masked, alive)
    share = mean_interval(alive[-1], start)
    if starts == episodes:
        wilson = statistics.proportion(alive[-1])
        share = {"value": wilson["mean"], "low": wilson["low"], "high": wilson["high"]}
    return {
        "episodes": episodes,
        "steps": steps,
        "starts": starts,
        "held": share | {"low": max(share["low"], 0.0), "high": min(share["high"], 1.0)},
        "return": mean_interval(last["return"], start),
        "steps_held": mean_interval(steps_held, start),
        "task": own,
    }


def mean_interval(x: np.ndarray, start: np.ndarray) -> dict[str, float]:
    """Mean of samples [N] with its normal 95 % interval, by start [N]: samples of one start are not independent."""
    _, which = np.unique(start, return_inverse=True)
    mean, starts = float(np.mean(x)), int(which.max()) + 1
    with np.errstate(invalid="ignore"):  # A return beyond float32 is infinite, its interval not a number.
        off = np.bincount(which, np.asarray(x, float) - mean)
    half = 1.96 * float(np.sqrt(np.sum(off**2) * starts / max(starts - 1, 1))) / x.size
    return {"value": mean, "low": mean - half, "high": mean + half}


def print_report(report: dict[str, Any], do_nothing: dict[str, Any] | None, *, title: str) -> None:
    """A table of the report's headline, and beside it that of a hand that does nothing, if it was measured."""
    from rich.console import Console
    from rich.table import Table

    idle = do_nothing and headline(do_nothing)
    table = Table("measure", "policy", "95 % interval", *(["doing nothing"] if idle else []), title=title)
    for name, entry in headline(report).items():
        low, high = (written(entry | {"value": entry.get(end)}) for end in ("low", "high"))
        beside = [written(idle.get(name, {"value": None}))] if idle else []
        table.add_row(name, written(entry), f"{low} .. {high}" if entry.get("high") is not None else "", *beside)
    Console().print(table)
    print(f"{report['episodes']} episodes of {report['steps']} steps, seed {report['seed']}, {report['seconds']:.1f} s")


def written(entry: dict[str, Any]) -> str:
    """A headline's number with its unit; a share [0, 1] in per cent."""
    value, unit = entry["value"], entry.get("unit", "")
    if value is None:
        return "-"
    return f"{100 * value:.1f} %" if unit == "%" else f"{value:.3g} {unit}".rstrip()


def headline(report: dict[str, Any]) -> dict[str, dict[str, Any]]:
    """Names of the task's headline, or else the share held, and the return: value, low, high and unit."""
    own = report["task"].get("headline") or {"held": report["held"] | {"unit": "%"}}
    rows = {name: entry if isinstance(entry, dict) else {"value": entry} for name, entry in own.items()}
    return rows | {"return": report["return"]}
