"""A first grasp: where a ball lies before the palm, and the joint angles that close fingers and thumb round it.

Shapes: N postures tried at once, L links, C capsules of a chain. Units: m, rad, in the palm frame.
"""

import dataclasses
import itertools
from collections.abc import Mapping, Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from dexsim.hand.anatomy import Finger, flexion_links
from dexsim.hand.fit import Capsule, PalmBox, segment_distance
from dexsim.hand.vendor import Link

BALL = 0.028  # m, radius: the middle of the spheres that grasps are trained with
_SHARES = (1.0, 0.9, 0.6, 0.6, 0.6)  # of the bend, from a finger's first flexing hinge on
_BENDS = np.linspace(0.0, 1.6, 41)  # rad
_HALF = 1.0  # rad, a bend that is half closed
_THUMB_SAMPLES = 1500  # about; joints of a thumb are tried on a grid
_STEP = 8e-3  # m, between places of the ball
_NEAR = 0.02  # m, a tip farther from the ball than this and the gap does not hold it


@dataclasses.dataclass(frozen=True, eq=False, kw_only=True)
class Grasp:
    """Joint angles by joint, and the ball's centre [3] m."""

    posture: dict[str, float]
    centre: np.ndarray
    reaching: int  # fingers, thumb included, whose tip is near the ball
    farthest: float  # m, of a tip from the ball's surface


def find_grasp(
    links: tuple[Link, ...], fingers: Sequence[Finger], capsules: Mapping[int, Capsule], palm: PalmBox, gap: float
) -> Grasp:
    """Close the hand round a ball that lies at the palm, `gap` m away from every link.

    The ball is tried in places before the palm. At each place every finger bends until a link is `gap` away from the
    ball; the thumb takes the posture of a grid that opposes the fingers best.
    """
    thumb, *fingers = fingers
    paths = [_bend(links, finger.links) for finger in fingers]
    grid = _grid(links, thumb.links)
    shapes = [_capsules_at(links, finger.links, path, capsules) for finger, path in zip(fingers, paths, strict=True)]
    thumb_shape = _capsules_at(links, thumb.links, grid, capsules)
    roots = np.array([links[finger.links[0]].joint.anchor for finger in fingers])  # type: ignore[union-attr]
    height = palm.centre[0] + palm.half[0] + BALL + 0.006
    thumb_root = links[thumb.links[0]].joint.anchor  # type: ignore[union-attr]
    # Over the palm, or a little beyond the fingers' roots.
    low = np.maximum(np.minimum(roots.min(0), thumb_root)[1:] - [0.0, 0.02], (palm.centre - palm.half)[1:] + BALL / 2)
    high = np.maximum(np.maximum(roots.max(0), thumb_root)[1:] + [0.0, 0.06], low + _STEP)
    best, best_score = None, -np.inf
    for y, z in itertools.product(np.arange(low[0], high[0] + 1e-9, _STEP), np.arange(low[1], high[1], _STEP)):
        centre = np.array([height, y, z])
        rows, tips = [], []
        for ends, radius in shapes:
            clear = (segment_distance(centre, ends[:, :, 0], ends[:, :, 1]) - radius).min(1) - BALL
            blocked = np.flatnonzero(clear < gap)
            rows.append(max(int(blocked[0]) - 1 if len(blocked) else len(clear) - 1, 0))
            tips.append(ends[rows[-1], -1, 1])
        ends, radius = thumb_shape
        clear = segment_distance(centre, ends[:, :, 0], ends[:, :, 1]) - radius - BALL
        directions = _unit(np.array(tips) - centre)
        near = np.array([_gap_of(shape, row, centre) for shape, row in zip(shapes, rows, strict=True)])
        at = np.clip((np.array(tips)[:, 0] - height) / 0.02, -1, 1)  # tips carry from below the ball's middle
        mean = _unit((directions * np.exp(-np.maximum(near - gap, 0) / _NEAR)[:, None]).sum(0) + 1e-9)
        score = -(_unit(ends[:, -1, 1] - centre) @ mean)
        score += np.clip((ends[:, -1, 1, 0] - height) / 0.02, -1, 1)
        score -= np.maximum(clear[:, -1] - gap, 0) / _NEAR
        score -= 10 * (clear.min(1) < gap)
        row = int(np.argmax(score))
        half_closed = -np.mean((_BENDS[rows] - _HALF) ** 2)  # fingers must have way left to close
        total = score[row] + np.exp(-np.maximum(near - gap, 0) / _NEAR).mean() + at.mean() + 2 * half_closed
        if total > best_score:
            best_score, best = total, (centre, rows, row, near, float(clear[row, -1]))
    assert best is not None
    centre, rows, row, near, thumb_gap = best
    posture = {name: float(values[row]) for name, values in grid.items()}
    for path, bend in zip(paths, rows, strict=True):
        posture |= {name: float(values[bend]) for name, values in path.items()}
    gaps = np.append(near, thumb_gap)
    return Grasp(
        posture=posture,
        centre=np.round(centre, 4),
        reaching=int(np.sum(gaps < gap + _NEAR)),
        farthest=float(gaps.max()),
    )


def _gap_of(shape: tuple[np.ndarray, np.ndarray], row: int, centre: np.ndarray) -> float:
    """How far m a fingertip is from the ball."""
    ends, radius = shape
    return float(segment_distance(centre, ends[row, -1, 0], ends[row, -1, 1]) - radius[-1] - BALL)


def _bend(links: tuple[Link, ...], chain: tuple[int, ...]) -> dict[str, np.ndarray]:
    """Motor angles [N] by joint of a finger that bends more and more; hinges that swing it sideways stay."""
    angles, place = {}, 0
    flexing = set(flexion_links(links, chain))
    for at in chain:
        joint = links[at].joint
        assert joint is not None
        if not joint.leader:
            share = _SHARES[min(place, len(_SHARES) - 1)] if at in flexing else 0.0
            angles[joint.name] = np.clip(share * _BENDS, joint.low, joint.high)
        place += at in flexing
    return angles


def _grid(links: tuple[Link, ...], chain: tuple[int, ...]) -> dict[str, np.ndarray]:
    """Motor angles [N] by joint of a thumb: all combinations."""
    joints = [joint for joint in (links[at].joint for at in chain) if joint is not None and not joint.leader]
    steps = max(3, int(_THUMB_SAMPLES ** (1 / len(joints))))
    axes = [np.linspace(j.low + 0.05 * (j.high - j.low), j.high - 0.05 * (j.high - j.low), steps) for j in joints]
    values = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, len(joints))
    return {joint.name: values[:, i] for i, joint in enumerate(joints)}


def _capsules_at(
    links: tuple[Link, ...], chain: tuple[int, ...], angles: Mapping[str, np.ndarray], capsules: Mapping[int, Capsule]
) -> tuple[np.ndarray, np.ndarray]:
    """Segments [N, C, 2, 3] and radii [C] of a chain's capsules, the tip's last, in postures of its motors."""
    count = len(next(iter(angles.values())))
    turn, shift = np.tile(np.eye(3), (count, 1, 1)), np.zeros((count, 3))
    ends, radii = [], []
    for at in chain:
        joint = links[at].joint
        assert joint is not None
        motor = angles.get(joint.leader or joint.name, np.zeros(count))
        angle = joint.offset + joint.ratio * motor if joint.leader else motor
        # The product of exponentials: every hinge turns what is beyond it about a line that is fixed in the drawing.
        own = Rotation.from_rotvec(np.outer(angle, joint.axis)).as_matrix()
        shift = shift + np.einsum("nij,nj->ni", turn, joint.anchor - own @ joint.anchor)
        turn = turn @ own
        if at in capsules:
            ends.append(np.einsum("nij,ej->nei", turn, capsules[at].ends) + shift[:, None])
            radii.append(capsules[at].radius)
    return np.stack(ends, 1), np.array(radii)


def _unit(vector: np.ndarray) -> np.ndarray:
    return vector / np.maximum(np.linalg.norm(vector, axis=-1, keepdims=True), 1e-12)
