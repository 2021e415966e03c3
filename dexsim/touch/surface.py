"""A fingertip's skin beyond its taxels, which bears load that no taxel reads.

A fingertip that presses with its edge, its side or its end next to the joint is partly supported by rubber without
taxels. If the taxels nearby share the whole force, as in the paper, they read too much. Here the rest of the
fingertip's surface has points that bear their share by the same law.
"""

import dataclasses

import numpy as np

from dexsim.geometry import sdf
from dexsim.hand.kinematics import Hand

_STEP, _CELL = 0.001, 0.006  # m: of the points that find the surface, of the cells they are gathered in


@dataclasses.dataclass(frozen=True, eq=False)
class Surface:
    """Points of the fingertips' skin in their links' frames: N taxels first, then those without; F fingers."""

    position: np.ndarray  # [F, P, 3] m
    normal: np.ndarray  # [F, P, 3] outward
    area: np.ndarray  # [F, P] m^2; 0 where a finger has fewer points than others


def taxels_only(hand: Hand) -> Surface:
    """The taxels alone."""
    return Surface(hand.taxel_position, hand.taxel_normal, hand.taxel_area)


def whole_surface(hand: Hand, reach: float) -> Surface:
    """The taxels and the rest of what touches of each fingertip.

    Args:
      reach: m from the nearest taxel within which pressed skin loads that taxel, so that it has no point of its own.
    """
    beyond = [_beyond(hand, finger, reach) for finger in range(hand.num_fingers)]
    longest = max(len(rows) for rows in beyond)
    untaxelled = np.stack([np.concatenate([rows, np.zeros((longest - len(rows), 7), np.float32)]) for rows in beyond])
    return Surface(
        np.concatenate([hand.taxel_position, untaxelled[..., :3]], 1),
        np.concatenate([hand.taxel_normal, untaxelled[..., 3:6]], 1),
        np.concatenate([hand.taxel_area, untaxelled[..., 6]], 1),
    )


def _beyond(hand: Hand, finger: int, reach: float) -> np.ndarray:
    """Rows [M, 7] of position, normal and area on a fingertip's primitives that touch, beyond `reach` of its taxels."""
    shape = sdf.of_geoms(g for g in hand.geoms if g.body == hand.tip_body[finger] and g.touches)
    if shape is None:
        return np.zeros((0, 7), np.float32)
    low, high = sdf.bounds(shape)
    axes = [np.arange(a - _STEP, b + 2 * _STEP, _STEP) for a, b in zip(low, high, strict=True)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3).astype(np.float32)
    # Points of a lattice within half a step of the surface: a shell as thick as a step, so each has a step's square
    # of it.
    distance, normal = (np.asarray(x) for x in sdf.distance_and_normal(points, shape))
    near = np.abs(distance) < _STEP / 2
    points, normal = points[near] - distance[near, None] * normal[near], normal[near]
    gap = np.linalg.norm(points[:, None] - hand.taxel_position[finger], axis=-1).min(1)
    points, normal = points[gap > reach], normal[gap > reach]
    _, cell = np.unique(np.floor(points / _CELL), axis=0, return_inverse=True)
    count = np.bincount(cell.ravel())
    rows: np.ndarray = np.stack(
        [np.bincount(cell.ravel(), weights=x) for x in np.concatenate([points, normal], 1).T], 1
    )
    rows[:, :3] /= count[:, None]
    # The two sides of a thin part may share a cell.
    rows[:, 3:] /= np.maximum(np.linalg.norm(rows[:, 3:], axis=1, keepdims=True), 1e-9)
    return np.column_stack([rows, count * _STEP**2]).astype(np.float32)
