"""Proportions, means and other statistics over episodes, with 95 % intervals (host, NumPy)."""

from collections.abc import Callable
from typing import Any

import numpy as np


def proportion(hits: np.ndarray) -> dict:
    """Share of True among `hits` [N], with Wilson's 95 % interval."""
    from scipy.stats import binomtest  # A second to import, for every command.

    n = int(hits.size)
    if n == 0:
        return {"mean": None, "low": None, "high": None, "count": 0}
    result = binomtest(int(np.sum(hits)), n)
    interval = result.proportion_ci(method="wilson")
    return {"mean": result.statistic, "low": float(interval.low), "high": float(interval.high), "count": n}


def mean(values: np.ndarray) -> dict:
    """Mean of `values` [N] with a bootstrap 95 % interval."""
    return interval(lambda rows: values[rows].mean(), values.size)


def ratio(parts: np.ndarray, wholes: np.ndarray) -> dict:
    """Sum of `parts` [N] over sum of `wholes` [N] with a bootstrap 95 % interval: a rate over all of a time."""
    return interval(lambda rows: parts[rows].sum() / wholes[rows].sum(), parts.size if wholes.sum() > 0 else 0)


def interval(function: Callable[[Any], float], count: int, name: str = "mean", samples: int = 500) -> dict:
    """`function(rows)` of all `count` rows under `name`, with its 95 % interval over resampled rows; None where there
    are no rows, or where it is not a number."""
    value = function(slice(None)) if count else np.nan
    if np.isnan(value):
        return {name: None, "low": None, "high": None}
    rng = np.random.default_rng(0)
    low, high = np.nanpercentile([function(rng.integers(0, count, count)) for _ in range(samples)], [2.5, 97.5])
    return {name: float(value), "low": float(low), "high": float(high)}


def entry(result: dict) -> dict:
    """A statistic as a headline has it: its number as "value", with its interval."""
    value = next(result[name] for name in ("mean", "median", "r") if name in result)
    return {"value": value, "low": result["low"], "high": result["high"]}
