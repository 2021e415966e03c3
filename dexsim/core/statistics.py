"""Proportions, means and other statistics over episodes, with 95 % intervals (host, NumPy)."""

from collections.abc import Callable

import numpy as np
from scipy.stats import binomtest


def proportion(hits: np.ndarray) -> dict:
    """Share of True among `hits` [N], with Wilson's 95 % interval."""
    n = int(hits.size)
    if n == 0:
        return {"mean": None, "low": None, "high": None, "count": 0}
    result = binomtest(int(np.sum(hits)), n)
    interval = result.proportion_ci(method="wilson")
    return {"mean": result.statistic, "low": float(interval.low), "high": float(interval.high), "count": n}


def mean(values: np.ndarray, samples: int = 500) -> dict:
    """Mean of `values` [N] with a bootstrap 95 % interval."""
    return statistic(values, np.mean, "mean", samples)


def median(values: np.ndarray, samples: int = 500) -> dict:
    """Median of `values` [N] with a bootstrap 95 % interval."""
    return statistic(values, np.median, "median", samples)


def ratio(parts: np.ndarray, wholes: np.ndarray, samples: int = 500) -> dict:
    """Sum of `parts` [N] over sum of `wholes` [N] with a bootstrap 95 % interval: a rate over all of a time."""

    def divide(rows: np.ndarray | slice) -> float:
        return float(parts[rows].sum() / wholes[rows].sum())

    if not parts.size or not wholes.sum() > 0:
        return {"mean": None, "low": None, "high": None}
    low, high = bootstrap(divide, parts.size, samples)
    return {"mean": divide(slice(None)), "low": low, "high": high}


def statistic(values: np.ndarray, function: Callable, name: str, samples: int = 500) -> dict:
    """`function` of `values` [N] under `name`, with a bootstrap 95 % interval."""
    if values.size == 0:
        return {name: None, "low": None, "high": None}
    low, high = bootstrap(lambda rows: function(values[rows]), values.size, samples)
    return {name: float(function(values)), "low": low, "high": high}


def entry(result: dict) -> dict:
    """A statistic as a headline has it: its number as "value", with its interval."""
    value = next(result[name] for name in ("mean", "median", "r") if name in result)
    return {"value": value, "low": result["low"], "high": result["high"]}


def bootstrap(function: Callable[[np.ndarray], float], count: int, samples: int) -> tuple[float, float]:
    """The 95 % interval of `function(rows)` over resampled rows of `count`."""
    rng = np.random.default_rng(0)
    draws = [function(rng.integers(0, count, count)) for _ in range(samples)]
    low, high = np.nanpercentile(draws, [2.5, 97.5])
    return float(low), float(high)
