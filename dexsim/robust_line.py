"""A straight line through data with outliers, with honest intervals.

Theil-Sen start, Huber and then Tukey's bisquare by iteratively reweighted least squares (an
MM-estimate), and a sandwich covariance that allows for unequal and autocorrelated residuals
(Newey and West 1987, bandwidth after Andrews 1991). Plain NumPy in double precision.
"""

import dataclasses

import numpy as np
from scipy.special import stdtrit

_HUBER, _BISQUARE = 1.345, 4.685  # 95 % efficiency under normal errors
_MAD = 1.4826  # median absolute deviation to standard deviation, normal errors
_PAIRS = 20_000


@dataclasses.dataclass(frozen=True, kw_only=True)
class Line:
    """y = gain x + offset, and how well the data know it. Intervals are of 95 %."""

    gain: float
    offset: float
    gain_interval: tuple[float, float]
    offset_interval: tuple[float, float]
    noise: float
    """Robust standard deviation of the residuals, in units of y."""
    r_squared: float
    """Share of the variance of the samples kept that the line explains."""
    condition: float
    """Condition number of the columns (1, x / max |x|): large where x hardly changes."""
    samples: int
    outliers: int
    """Samples that the fit gave no weight."""

    def __call__(self, x: np.ndarray) -> np.ndarray:
        """The line at x."""
        return self.gain * np.asarray(x) + self.offset


def fit_line(x: np.ndarray, y: np.ndarray, *, seed: int = 0) -> Line:
    """Fit y = gain x + offset.

    Args:
      x, y: [T] finite, in the order of time (autocorrelation widens the intervals), T > 2 and x
        not constant.
      seed: of the pairs that Theil-Sen looks at where there are more than 20,000.
    """
    x, y = np.asarray(x, float), np.asarray(y, float)
    reach = np.max(np.abs(x))
    design = np.stack([np.ones_like(x), x / reach], -1)
    start = np.array(theil_sen(x, y, seed)) * [1.0, reach]
    guess, scale, weight = _reweight(design, y, start)
    residual = y - design @ guess
    half = _half_widths(design, residual, weight, scale)
    offset, gain = guess / [1.0, reach]
    half = half / [1.0, reach]
    kept = weight > 0
    centred = y[kept] - np.average(y[kept], weights=weight[kept])
    unexplained = np.sum(weight * residual**2) / max(np.sum(weight[kept] * centred**2), 1e-300)
    return Line(
        gain=float(gain), offset=float(offset),
        gain_interval=(float(gain - half[1]), float(gain + half[1])),
        offset_interval=(float(offset - half[0]), float(offset + half[0])),
        noise=float(scale), r_squared=float(1.0 - unexplained),
        condition=float(np.linalg.cond(design)), samples=len(x), outliers=int(np.sum(~kept)))


def theil_sen(x: np.ndarray, y: np.ndarray, seed: int = 0) -> tuple[float, float]:
    """Offset and gain: the median slope over pairs of samples, and the median of what it leaves."""
    count = len(x)
    if count * (count - 1) // 2 <= _PAIRS:
        first, second = np.triu_indices(count, 1)
    else:
        first, second = np.random.default_rng(seed).integers(0, count, (2, _PAIRS))
    run = x[second] - x[first]
    far = np.abs(run) > 0.1 * np.ptp(x)  # near pairs hold noise alone
    gain = float(np.median((y[second] - y[first])[far] / run[far]))
    return float(np.median(y - gain * x)), gain


def _reweight(design: np.ndarray, y: np.ndarray,
              start: np.ndarray) -> tuple[np.ndarray, float, np.ndarray]:
    """Parameters, residual scale and weights: Huber to convergence, then bisquare."""
    guess = start
    floor = 1e-12 * max(float(np.max(np.abs(y))), 1e-300)
    scale = floor
    for bound, weigh in ((_HUBER, _huber_weight), (_BISQUARE, _bisquare_weight)):
        for _ in range(50):
            residual = y - design @ guess
            if weigh is _huber_weight:  # the bisquare keeps the scale, or it might shrink on
                scale = max(_MAD * float(np.median(np.abs(residual))), floor)
            weight = weigh(residual / (bound * scale))
            root = np.sqrt(weight)
            new = np.linalg.lstsq(root[:, None] * design, root * y, rcond=None)[0]
            done = np.all(np.abs(new - guess) <= 1e-10 * (np.abs(new) + scale))
            guess = new
            if done:
                break
    return guess, scale, weight


def _huber_weight(u: np.ndarray) -> np.ndarray:
    return 1.0 / np.maximum(np.abs(u), 1.0)


def _bisquare_weight(u: np.ndarray) -> np.ndarray:
    return np.where(np.abs(u) < 1.0, (1.0 - u**2) ** 2, 0.0)


def _half_widths(design: np.ndarray, residual: np.ndarray, weight: np.ndarray,
                 scale: float) -> np.ndarray:
    """Half the 95 % interval of each parameter of the bisquare fit."""
    u = residual / (_BISQUARE * scale)
    slope = np.where(np.abs(u) < 1.0, (1.0 - u**2) * (1.0 - 5.0 * u**2), 0.0)  # psi'
    score = (weight * residual)[:, None] * design
    inverse = np.linalg.inv(np.mean(slope) * design.T @ design)
    freedom = max(len(residual) - 2, 1)
    covariance = inverse @ long_run(score) @ inverse * len(residual) / freedom
    return stdtrit(freedom, 0.975) * np.sqrt(np.maximum(np.diag(covariance), 0.0))


def long_run(score: np.ndarray) -> np.ndarray:
    """Newey-West sum [P, P] of a series' autocovariances; `score` [T, P] has zero mean."""
    count = len(score)
    before, after = score[:-1], score[1:]
    rho = np.clip(np.sum(before * after, 0) / np.maximum(np.sum(score**2, 0), 1e-300), -0.97, 0.97)
    alpha = float(np.max(4 * rho**2 / ((1 - rho) * (1 + rho)) ** 2))
    lags = min(int(1.1447 * (alpha * count) ** (1 / 3)), count // 4)
    total = score.T @ score
    for lag in range(1, lags + 1):
        cross = score[lag:].T @ score[:-lag]
        total += (1.0 - lag / (lags + 1)) * (cross + cross.T)
    return total
