"""Primitives in place of a link's meshes: a capsule for a link, a box and its face for a palm."""

from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import least_squares
from scipy.stats import binned_statistic_2d

from dexsim.geometry.mesh import sample_surface

_SAMPLES = 600
_CELL = 5e-3  # m, of the grid on which a palm's face is measured


class Capsule(NamedTuple):
    """A segment [2, 3] m and a radius m; `error`: how far the link's convex hull is from it, mean and largest, m."""

    ends: np.ndarray
    radius: float
    error: tuple[float, float] = (0.0, 0.0)


class PalmBox(NamedTuple):
    """A box along the palm's axes: its middle and half-extents [3] m. Its face is at the largest x."""

    centre: np.ndarray
    half: np.ndarray
    beyond: float  # m, how far the palm reaches beyond it


def fit_capsule(surface: Any, along: np.ndarray) -> Capsule:
    """The capsule with the least squared distance to samples of a link's convex hull; objects meet nothing but the
    hull. It begins from an axis [3] `along` the link."""
    points = sample_surface(surface.convex_hull, _SAMPLES, np.random.default_rng(0))[0]
    middle = (points.max(0) + points.min(0)) / 2
    spread = (points - middle) @ along
    radius = np.median(np.linalg.norm(points - middle - np.outer(spread, along), axis=1))
    half = max(np.ptp(spread) / 2 - radius, 1e-3)
    start = np.concatenate([middle - half * along, middle + half * along, [radius]])

    def error(x: np.ndarray) -> np.ndarray:
        return segment_distance(points, x[:3], x[3:6]) - x[6]

    best = least_squares(error, start, x_scale=0.01, max_nfev=100).x
    away = np.abs(error(best))
    ends = best[:6].reshape(2, 3)
    if (ends[1] - ends[0]) @ along < 0:
        ends = ends[::-1]
    return Capsule(ends=ends, radius=float(abs(best[6])), error=(float(away.mean()), float(away.max())))


def fit_palm(surface: Any) -> PalmBox:
    """The box of a palm. Its face is where most of the front is: mounts of thumb and fingers stand out of it."""
    points = sample_surface(surface, 40 * _SAMPLES, np.random.default_rng(0))[0]
    low, high = np.percentile(points, 1, axis=0), np.percentile(points, 99, axis=0)
    bins = [np.arange(a, b + _CELL, _CELL) for a, b in zip(low[1:], high[1:], strict=True)]
    front = binned_statistic_2d(points[:, 1], points[:, 2], points[:, 0], "max", bins).statistic
    high[0] = np.nanpercentile(front, 70)
    half = np.maximum((high - low) / 2, 2e-3)
    beyond = np.maximum(low - points.min(0), points.max(0) - high).max()
    return PalmBox((low + high) / 2, half, float(beyond))


def segment_distance(points: np.ndarray, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Distance [...] m of points [..., 3] from the segment between a and b [..., 3]."""
    arm, span = points - a, b - a
    share = np.clip(np.sum(arm * span, -1) / np.maximum(np.sum(span * span, -1), 1e-12), 0, 1)
    return np.linalg.norm(arm - share[..., None] * span, axis=-1)
