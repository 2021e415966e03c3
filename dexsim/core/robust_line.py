"""A straight line through data with outliers, with confidence intervals.

Theil-Sen start, Huber and then Tukey's bisquare by iteratively reweighted least squares (an MM-estimate). The interval
is the wider of two: of a sandwich covariance that allows for unequal and autocorrelated residuals (Andrews and Monahan
1992), and of a jackknife over whole repetitions, which sees what differs between them.
"""

import dataclasses

import numpy as np
from scipy.special import stdtrit

_HUBER, _BISQUARE = 1.345, 4.685  # 95 % efficiency under normal errors
_MAD = 1.4826  # median absolute deviation to standard deviation, normal errors
_PAIRS = 20_000
LEAST_GROUPS = 3
"""Repetitions below which their differences are not part of an interval."""
_MOST_GROUPS = 20  # more are joined in the order of their numbers, since each costs a fit


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
    condition: float
    """Condition number of the columns (1, x / max |x|): large if x hardly changes."""
    samples: int
    outliers: int
    """Number of samples with zero weight."""

    def __call__(self, x: np.ndarray) -> np.ndarray:
        """The line at x."""
        return self.gain * np.asarray(x) + self.offset

    def widened(self, share: float) -> "Line":
        """The line with an error of this share of the gain (95 %), which the data cannot show, in its interval."""
        half = np.hypot((self.gain_interval[1] - self.gain_interval[0]) / 2, share * self.gain)
        return dataclasses.replace(self, gain_interval=(float(self.gain - half), float(self.gain + half)))


@dataclasses.dataclass(frozen=True)
class Regression:
    """Robust coefficients of a linear model, and half their 95 % intervals."""

    value: np.ndarray  # [P]
    half: np.ndarray  # [P]
    weight: np.ndarray  # [T] in [0, 1], 0 for outliers
    scale: float  # robust standard deviation of the residuals


def fit_line(x: np.ndarray, y: np.ndarray, *, group: np.ndarray | None = None) -> Line:
    """Fit y = gain x + offset.

    Args:
      x, y: [T], finite and in order of time; T > 2 and x not constant.
      group: [T] int, number of the repetition (a press) that a sample belongs to. From `LEAST_GROUPS` on, their
        differences widen the intervals.
    """
    x, y = np.asarray(x, float), np.asarray(y, float)
    reach = np.max(np.abs(x))
    design = np.stack([np.ones_like(x), x / reach], -1)
    start = np.array(theil_sen(x, y)) * [1.0, reach]
    fit = regress(design, y, start, order=x, group=group)
    weight, residual = fit.weight, y - design @ fit.value
    (offset, gain), half = fit.value / [1.0, reach], fit.half / [1.0, reach]
    inlier = weight > 0
    centred = y[inlier] - np.average(y[inlier], weights=weight[inlier])
    unexplained = np.sum(weight * residual**2) / max(np.sum(weight[inlier] * centred**2), 1e-300)
    return Line(
        gain=float(gain),
        offset=float(offset),
        gain_interval=(float(gain - half[1]), float(gain + half[1])),
        offset_interval=(float(offset - half[0]), float(offset + half[0])),
        noise=float(fit.scale),
        r_squared=float(1.0 - unexplained),
        condition=float(np.linalg.cond(design)),
        samples=len(x),
        outliers=int(np.sum(~inlier)),
    )


def regress(
    design: np.ndarray, y: np.ndarray, start: np.ndarray, *, order: np.ndarray, group: np.ndarray | None = None
) -> Regression:
    """Robust regression of y [T] on the columns of a design [T, P].

    Args:
      design, y: finite.
      start: [P], first guess, robust itself.
      order: [T], sorted by which neighbouring residuals belong together.
      group: [T] int, repetitions, as for `fit_line`.
    """
    guess, scale, weight = _reweight(design, y, start)
    # Sorted along x, errors that recur at the same x (motor ripple) or drift within one press are neighbours:
    # their autocorrelation must widen the intervals.
    row = np.argsort(order, kind="stable")
    half = _half_widths(design[row], (y - design @ guess)[row], weight[row], scale)
    if group is not None:
        half = np.maximum(half, _between_groups(design, y, guess, np.asarray(group)))
    return Regression(guess, half, weight, scale)


def theil_sen(x: np.ndarray, y: np.ndarray) -> tuple[float, float]:
    """Offset and gain: the median slope over pairs of samples, and the median residual."""
    count = len(x)
    if count * (count - 1) // 2 <= _PAIRS:
        first, second = np.triu_indices(count, 1)
    else:
        first, second = np.random.default_rng(0).integers(0, count, (2, _PAIRS))
    run = x[second] - x[first]
    far = np.abs(run) > 0.1 * np.ptp(x)  # close pairs hold only noise
    gain = float(np.median((y[second] - y[first])[far] / run[far]))
    return float(np.median(y - gain * x)), gain


def _reweight(design: np.ndarray, y: np.ndarray, start: np.ndarray) -> tuple[np.ndarray, float, np.ndarray]:
    """Parameters, residual scale and weights: Huber to convergence, then bisquare."""
    guess = start
    floor = 1e-12 * max(float(np.max(np.abs(y))), 1e-300)
    scale = floor
    for huber in (True, False):
        for _ in range(50):
            residual = y - design @ guess
            if huber:  # the bisquare keeps the scale, which might shrink without end
                scale = max(_MAD * float(np.median(np.abs(residual))), floor)
                weight = 1.0 / np.maximum(np.abs(residual / (_HUBER * scale)), 1.0)
            else:
                u = residual / (_BISQUARE * scale)
                weight = np.where(np.abs(u) < 1.0, (1.0 - u**2) ** 2, 0.0)
            root = np.sqrt(weight)
            new = np.linalg.lstsq(root[:, None] * design, root * y, rcond=None)[0]
            done = np.all(np.abs(new - guess) <= 1e-10 * (np.abs(new) + scale))
            guess = new
            if done:
                break
    return guess, scale, weight


def _half_widths(design: np.ndarray, residual: np.ndarray, weight: np.ndarray, scale: float) -> np.ndarray:
    """Half the 95 % interval of each parameter of the bisquare fit."""
    u = residual / (_BISQUARE * scale)
    slope = np.where(np.abs(u) < 1.0, (1.0 - u**2) * (1.0 - 5.0 * u**2), 0.0)  # psi'
    score = (weight * residual)[:, None] * design
    inverse = np.linalg.inv(np.mean(slope) * design.T @ design)
    freedom = max(len(residual) - 2, 1)
    random = np.diag(inverse @ long_run(score) @ inverse) * len(residual) / freedom
    variance = np.maximum(random, _periodic(design, weight * residual, inverse))
    # Autocorrelated samples count for fewer, also in how well the variance itself is known.
    rho = float(np.max(_autocorrelation(score), initial=0.0))
    worth = max(len(residual) * (1 - rho) / (1 + rho) - 2, 3.0)
    return stdtrit(worth, 0.975) * np.sqrt(np.maximum(variance, 0.0))


def _between_groups(design: np.ndarray, y: np.ndarray, guess: np.ndarray, group: np.ndarray) -> np.ndarray:
    """Half the 95 % interval [P] by the jackknife over whole groups; 0 with too few of them."""
    number = np.unique(group, return_inverse=True)[1]
    count = int(number.max()) + 1
    if count < LEAST_GROUPS:
        return np.zeros(len(guess))
    if count > _MOST_GROUPS:
        number, count = number * _MOST_GROUPS // count, _MOST_GROUPS
    without = np.array([_reweight(design[number != k], y[number != k], guess)[0] for k in range(count)])
    variance = (count - 1) / count * np.sum((without - guess) ** 2, 0)
    return stdtrit(count - 1, 0.975) * np.sqrt(variance)


def _periodic(design: np.ndarray, residual: np.ndarray, inverse: np.ndarray) -> np.ndarray:
    """Variance [P] of the parameters over all cyclic shifts of the residuals along x: a ripple of a few periods neither
    averages out nor has a decaying autocovariance."""
    spectrum = np.fft.rfft(design, axis=0).conj() * np.fft.rfft(residual)[:, None]
    turned = np.fft.irfft(spectrum, n=len(residual), axis=0)  # design.T @ roll(residual, offset)
    return np.mean((turned @ inverse) ** 2, 0)


def long_run(score: np.ndarray) -> np.ndarray:
    """Sum [P, P] of the autocovariances of a zero-mean series `score` [T, P], times T: Newey-West on the series without
    its first-order autoregression (Andrews and Monahan 1992), bandwidth after Andrews 1991."""
    count = len(score)
    rho = _autocorrelation(score)
    white = score[1:] - rho * score[:-1]
    left = _autocorrelation(white)
    alpha = float(np.max(4 * left**2 / ((1 - left) * (1 + left)) ** 2))
    lags = min(int(1.1447 * (alpha * count) ** (1 / 3)) + 1, count // 4)
    total = white.T @ white
    for lag in range(1, lags + 1):
        cross = white[lag:].T @ white[:-lag]
        total += (1.0 - lag / (lags + 1)) * (cross + cross.T)
    return total / np.outer(1.0 - rho, 1.0 - rho) * count / (count - 1)


def _autocorrelation(series: np.ndarray) -> np.ndarray:
    """First-order coefficient [P] of each column, corrected for its bias in short series. Correlation over more than a
    quarter of the series is not to be told from a trend."""
    rho = np.sum(series[:-1] * series[1:], 0) / np.maximum(np.sum(series**2, 0), 1e-300)
    return np.clip(rho + (1.0 + 3.0 * rho) / len(series), -0.5, min(0.97, 1.0 - 4.0 / len(series)))
