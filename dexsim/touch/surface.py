"""A fingertip's skin beyond its taxels, which bears load that no taxel reads.

A fingertip that presses with its edge, its side or its end next to the joint is partly supported by rubber without
taxels. If the taxels nearby share the whole force, as in the paper, they read too much. Here the rest of the
fingertip's surface has points that bear their share by the same law. They lie evenly, so that their sum is the skin's
force: within some 5 % where a face dents an XHand's fingertip by 1 mm.
"""

import dataclasses

import jax
import numpy as np

from dexsim.geometry import sdf
from dexsim.hand.kinematics import Hand
from dexsim.touch.skin import Skin

_STEP = 0.001  # m, of the points that find the surface
_POINTS, _ROUNDS = 100, 15  # what they are gathered in, for each finger, and how often it moves to its points' mean


@dataclasses.dataclass(frozen=True, eq=False)
class Surface:
    """Points of the fingertips' skin in their links' frames: N taxels first, then those without; F fingers."""

    position: np.ndarray  # [F, P, 3] m
    normal: np.ndarray  # [F, P, 3] outward
    area: np.ndarray  # [F, P] m^2; 0 where a finger has fewer points than others


def taxels_only(hand: Hand) -> Surface:
    """The taxels alone."""
    return Surface(hand.taxel_position, hand.taxel_normal, hand.taxel_area)


def whole_surface(hand: Hand, reach: float | None = None) -> Surface:
    """The taxels and the rest of what touches of each fingertip.

    Args:
      reach: m from the nearest taxel within which pressed skin loads that taxel, so that it has no point of its own.
        None: the taxels cover no more than their areas, so that the areas add up to the fingertip's.
    """
    beyond = [_beyond(hand, finger, reach) for finger in range(hand.num_fingers)]
    longest = max(len(rows) for rows in beyond)
    untaxelled = np.stack([np.concatenate([rows, np.zeros((longest - len(rows), 7), np.float32)]) for rows in beyond])
    return Surface(
        np.concatenate([hand.taxel_position, untaxelled[..., :3]], 1),
        np.concatenate([hand.taxel_normal, untaxelled[..., 3:6]], 1),
        np.concatenate([hand.taxel_area, untaxelled[..., 6]], 1),
    )


def skin_surface(hand: Hand, skin: Skin) -> Surface:
    """All skin that bears load, as `skin.untaxelled` has it: with it the areas add up to the fingertips'."""
    return whole_surface(hand) if skin.untaxelled else taxels_only(hand)


def _beyond(hand: Hand, finger: int, reach: float | None) -> np.ndarray:
    """Rows [M, 7] of position, normal and area on a fingertip's primitives that touch, beyond `reach` of its taxels."""
    shape = sdf.of_geoms(g for g in hand.geoms if g.body == hand.tip_body[finger] and g.touches)
    if shape is None:
        return np.zeros((0, 7), np.float32)
    low, high = sdf.bounds(shape)
    axes = [np.arange(a - _STEP, b + 2 * _STEP, _STEP) for a, b in zip(low, high, strict=True)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3).astype(np.float32)
    # Points of a lattice within half a step of the surface: a shell as thick as a step, so each has a step's square
    # of it.
    points, off = _on_surface(points, shape)[::2]
    points = points[np.abs(off) < _STEP / 2]
    gap = np.linalg.norm(points[:, None] - hand.taxel_position[finger], axis=-1).min(1)
    if reach is None:  # the skin next to the taxels is theirs, as much of it as they have area
        points = points[np.argsort(gap, kind="stable")[round(float(hand.taxel_area[finger].sum()) / _STEP**2) :]]
    else:
        points = points[gap > reach]
    if not len(points):
        return np.zeros((0, 7), np.float32)
    centre, count = _gather(points)
    centre, normal, _ = _on_surface(centre, shape)
    return np.column_stack([centre, normal, count * _STEP**2]).astype(np.float32)


def _on_surface(points: np.ndarray, shape: sdf.Shape) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The nearest points [N, 3] of a surface, its normals [N, 3] there and how far away they are [N] m."""
    distance, normal = (np.asarray(x) for x in jax.jit(sdf.distance_and_normal)(points, shape))
    return points - distance[:, None] * normal, normal, distance


def _gather(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Centres [M, 3] of `points` that lie evenly among them, and how many are nearest to each [M] (Lloyd's method)."""
    first, chosen = np.linalg.norm(points - points[0], axis=1), [0]
    while len(chosen) < min(_POINTS, len(points)):  # the one farthest from all others so far
        chosen.append(int(first.argmax()))
        first = np.minimum(first, np.linalg.norm(points - points[chosen[-1]], axis=1))
    centre = points[chosen]
    for _ in range(_ROUNDS):
        # |p - c|^2 but for |p|^2, which is the same for every c.
        near = (np.sum(centre**2, -1) - 2 * points @ centre.T).argmin(1)
        count = np.bincount(near, minlength=len(centre))
        total = np.stack([np.bincount(near, weights=x, minlength=len(centre)) for x in points.T], 1)
        centre = np.where(count[:, None] > 0, total / np.maximum(count, 1)[:, None], centre).astype(np.float32)
    return centre, count
