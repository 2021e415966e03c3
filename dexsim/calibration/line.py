"""A straight line through data with outliers, with confidence intervals.

A Cauchy M-estimate from the Theil-Sen line: outliers to one side hardly move it. The interval is a jackknife, which
leaves out a press, or a twentieth of the samples by x, at a time. The first shows what differs between presses, the
second what recurs in all of them (motor ripple) and noise that is correlated along x; the wider one counts.
"""

import dataclasses

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


@dataclasses.dataclass(frozen=True, kw_only=True)
class Line:
    """The line y = gain x + offset, with 95 % intervals."""

    gain: float
    offset: float
    gain_interval: tuple[float, float]
    offset_interval: tuple[float, float]
    noise: float
    """Robust standard deviation of the residuals, in units of y."""
    r_squared: float
    """Share of the variance that the line explains, without outliers."""
    samples: int
    outliers: int

    def __call__(self, x: np.ndarray) -> np.ndarray:
        """The line at x."""
        return self.gain * np.asarray(x) + self.offset

    @property
    def gain_share(self) -> float:
        """Half the interval of the gain, as a share of the gain."""
        return (self.gain_interval[1] - self.gain_interval[0]) / 2 / abs(self.gain)

    def widened(self, share: float) -> "Line":
        """The line with an error of this share of the gain (95 %), which the data cannot show, in its interval."""
        half = float(np.hypot(self.gain_share, share)) * abs(self.gain)
        return dataclasses.replace(self, gain_interval=(self.gain - half, self.gain + half))


def fit_line(x: np.ndarray, y: np.ndarray, press: np.ndarray | None = None) -> Line:
    """Fit y = gain x + offset.

    Args:
      x, y: [T], finite; T > 2 and x not constant.
      press: [T] int, number of the press that a sample belongs to. From `LEAST_PRESSES` on, their differences widen the
        intervals.
    """
    x, y = np.asarray(x, float), np.asarray(y, float)
    reach = np.max(np.abs(x))
    design = np.stack([np.ones_like(x), x / reach], -1)
    some = np.random.default_rng(0).permutation(len(x))[:_START]
    gain, offset, *_ = theilslopes(y[some], x[some])
    residual = y - gain * x - offset
    noise = max(_MAD * float(np.median(np.abs(residual))), 1e-9 * float(np.max(np.abs(y))), 1e-300)
    fit = least_squares(
        lambda guess: (design @ guess - y) / noise,
        (offset, gain * reach),
        jac=lambda guess: design / noise,
        loss="cauchy",
        f_scale=_CAUCHY,
        xtol=1e-12,
    )
    residual = y - design @ fit.x
    square = (residual / (_CAUCHY * noise)) ** 2
    weight = 1.0 / (1.0 + square)
    slope = np.mean((1.0 - square) * weight**2)  # of the influence: how much a sample moves the line by itself
    score = (weight * residual)[:, None] * design
    order, blocks = np.argsort(x, kind="stable"), int(np.clip(len(x) // 10, *_BLOCKS))
    block = np.empty(len(x), int)
    block[order] = np.arange(len(x)) * blocks // len(x)
    half = _jackknife(design, slope, score, block)
    if press is not None and len(np.unique(press)) >= LEAST_PRESSES:
        half = np.maximum(half, _jackknife(design, slope, score, np.asarray(press)))
    (offset, gain), half = fit.x / [1.0, reach], half / [1.0, reach]
    centred = y - np.average(y, weights=weight)
    return Line(
        gain=float(gain),
        offset=float(offset),
        gain_interval=(float(gain - half[1]), float(gain + half[1])),
        offset_interval=(float(offset - half[0]), float(offset + half[0])),
        noise=noise,
        r_squared=float(1.0 - np.sum(weight * residual**2) / max(np.sum(weight * centred**2), 1e-300)),
        samples=len(x),
        outliers=int(np.sum(np.abs(residual) > _OUTLIER * noise)),
    )


def _jackknife(design: np.ndarray, slope: float, score: np.ndarray, group: np.ndarray) -> np.ndarray:
    """Half the 95 % interval [P] of a fit, from what it is without a group at a time: a Newton step each."""
    number = np.unique(group, return_inverse=True)[1]
    count = int(number.max()) + 1
    normal, push = np.zeros((count, 2, 2)), np.zeros((count, 2))
    np.add.at(normal, number, slope * design[:, :, None] * design[:, None, :])
    np.add.at(push, number, score)
    moved = np.linalg.solve(normal.sum(0) - normal, push[..., None])[..., 0]
    return stdtrit(count - 1, 0.975) * np.sqrt((count - 1) / count * np.sum(moved**2, 0))
