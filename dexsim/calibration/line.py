"""A straight line through data with outliers, with confidence intervals.

A Cauchy M-estimate from the Theil-Sen line: outliers to one side hardly move it. The interval is a jackknife, which
leaves out a press, or a twentieth of the samples by x, at a time. The first shows what differs between presses, the
second what recurs in all of them (motor ripple) and noise that is correlated along x; the wider one counts.
"""

from typing import NamedTuple

import numpy as np
from scipy.optimize import least_squares
from scipy.special import stdtrit
from scipy.stats import theilslopes

LEAST_PRESSES = 3
"""Presses below which their differences are not part of an interval."""
_CAUCHY = 2.385  # standard deviations, for 95 % efficiency under normal errors
_OUTLIER = 5.0  # standard deviations
_MAD = 1.4826  # median absolute deviation to standard deviation, normal errors
_START = 300  # samples that the Theil-Sen line is drawn through, for all pairs of many take long
_BLOCKS = (5, 20)  # parts of the samples by x, fewest and most


class Line(NamedTuple):
    """The line y = gain x + offset; an error is half of a 95 % interval."""

    gain: float
    offset: float
    gain_error: float
    offset_error: float
    r_squared: float  # share of the variance that the line explains, without outliers
    inside: np.ndarray  # [T] bool, the samples that are no outliers


def fit_line(x: np.ndarray, y: np.ndarray, press: np.ndarray) -> Line:
    """Fit y = gain x + offset.

    Args:
      x, y: [T], finite; T > 2 and x not constant.
      press: [T] int, number of the press that a sample belongs to. From `LEAST_PRESSES` on, their differences widen the
        intervals.
    """
    x, y = np.asarray(x, float), np.asarray(y, float)
    scale = np.array([1.0, np.max(np.abs(x))])
    design = np.stack([np.ones_like(x), x / scale[1]], -1)
    some = np.random.default_rng(0).permutation(len(x))[:_START]
    gain, offset, *_ = theilslopes(y[some], x[some])
    noise = max(_MAD * float(np.median(np.abs(y - gain * x - offset))), 1e-9 * float(np.max(np.abs(y))), 1e-300)
    fit = least_squares(
        lambda guess: (design @ guess - y) / noise,
        (offset, gain * scale[1]),
        jac=lambda guess: design / noise,
        loss="cauchy",
        f_scale=_CAUCHY,
        xtol=1e-12,
    )
    residual = y - design @ fit.x
    square = (residual / (_CAUCHY * noise)) ** 2
    weight = 1.0 / (1.0 + square)
    slope = np.mean((1.0 - square) * weight**2)  # of the influence: how much a sample moves the line by itself
    order, blocks = np.argsort(x, kind="stable"), int(np.clip(len(x) // 10, *_BLOCKS))
    block = np.empty(len(x), int)
    block[order] = np.arange(len(x)) * blocks // len(x)
    groups = [block] + [press] * (len(np.unique(press)) >= LEAST_PRESSES)
    error = np.max([jackknife(slope * design, design, weight * residual, group) for group in groups], 0)
    (offset, gain), error = fit.x / scale, error / scale
    explained = np.sum(weight * (y - np.average(y, weights=weight)) ** 2)
    r_squared = float(1.0 - np.sum(weight * residual**2) / max(explained, 1e-300))
    inside = np.abs(residual) <= _OUTLIER * noise
    return Line(float(gain), float(offset), float(error[1]), float(error[0]), r_squared, inside)


def jackknife(curvature: np.ndarray, design: np.ndarray, residual: np.ndarray, group: np.ndarray) -> np.ndarray:
    """Half the 95 % interval [P] of a least-squares fit, from what it is without a group at a time: a Newton step each.

    Args:
      curvature: [N, P]; with the design it gives the Hessian, curvature^T design.
      design: [N, P] derivatives of the model.
      residual: [N], weighted.
      group: [N] int, samples that belong together.
    """
    moved, whole = [], curvature.T @ design
    for number in np.unique(group):
        own = group == number
        rest = np.linalg.pinv(whole - curvature[own].T @ design[own], rcond=1e-8, hermitian=True)
        moved.append(rest @ (design[own].T @ residual[own]))
    count = len(moved)
    return stdtrit(count - 1, 0.975) * np.sqrt((count - 1) / count * np.sum(np.square(moved), 0))
