"""A first grasp: where a ball lies before the palm, and the joint angles that close fingers and thumb round it.

Shapes: N postures tried at once, L links, C capsules of a chain. Units: m, rad, in the palm frame.
"""

import itertools
from collections.abc import Mapping, Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from dexsim.hand.anatomy import flexion_links
from dexsim.hand.fit import segment_distance
from dexsim.hand.vendor import Draft, Link

BALL = 0.028  # m, radius: the middle of the spheres that grasps are trained with
_SHARES = (1.0, 0.9, 0.6, 0.6, 0.6)  # of the bend, from a finger's first flexing hinge on
_BENDS = np.linspace(0.0, 1.6, 41)  # rad
_HALF = 1.0  # rad, a bend that is half closed
_THUMB_SAMPLES = 1500  # about; joints of a thumb are tried on a grid
_STEP = 8e-3  # m, between places of the ball
_NEAR = 0.02  # m, a tip farther from the ball than this and the gap does not hold it


def find_grasp(draft: Draft, gap: float) -> np.ndarray:
    """Close the hand round a ball that lies at the palm, `gap` m away from every link: the draft's posture and centre.

    The ball is tried in places before the palm. At each place every finger bends until a link is `gap` away from the
    ball; the thumb takes the posture of a grid that opposes the fingers best.

    Returns:
      How far [F] m each fingertip, the thumb's last, is from the ball.
    """
    links, palm = draft.links, draft.palm
    assert palm is not None, "fitted before"
    thumb, *chains = draft.fingers.values()
    paths, grid = [_bend(links, chain) for chain in chains], _grid(links, thumb)
    shapes = [_capsules_at(links, chain, path) for chain, path in zip(chains, paths, strict=True)]
    thumb_ends, thumb_radius = _capsules_at(links, thumb, grid)
    roots, thumb_root = np.array([links[chain[0]].anchor for chain in chains]), links[thumb[0]].anchor
    height = palm.centre[0] + palm.half[0] + BALL + 0.006
    # Over the palm, or a little beyond the fingers' roots.
    low = np.maximum(np.minimum(roots.min(0), thumb_root)[1:] - [0.0, 0.02], (palm.centre - palm.half)[1:] + BALL / 2)
    high = np.maximum(np.maximum(roots.max(0), thumb_root)[1:] + [0.0, 0.06], low + _STEP)
    best_score = -np.inf
    for y, z in itertools.product(np.arange(low[0], high[0] + 1e-9, _STEP), np.arange(low[1], high[1], _STEP)):
        centre = np.array([height, y, z])
        bends, tips, near = [], [], []
        for ends, radius in shapes:
            clear = _gaps(ends, radius, centre)
            blocked = np.flatnonzero(clear.min(1) < gap)
            bends.append(max(int(blocked[0]) - 1 if len(blocked) else len(clear) - 1, 0))
            tips.append(ends[bends[-1], -1, 1])
            near.append(clear[bends[-1], -1])
        holds = np.exp(-np.maximum(np.array(near) - gap, 0) / _NEAR)
        below = np.clip((np.array(tips)[:, 0] - height) / 0.02, -1, 1)  # tips carry from below the ball's middle
        mean = _unit((_unit(np.array(tips) - centre) * holds[:, None]).sum(0) + 1e-9)
        clear, tip = _gaps(thumb_ends, thumb_radius, centre), thumb_ends[:, -1, 1]
        score = np.clip((tip[:, 0] - height) / 0.02, -1, 1) - _unit(tip - centre) @ mean
        score -= np.maximum(clear[:, -1] - gap, 0) / _NEAR + 10 * (clear.min(1) < gap)
        row = int(np.argmax(score))
        half_closed = -np.mean((_BENDS[bends] - _HALF) ** 2)  # fingers must have way left to close
        total = score[row] + holds.mean() + below.mean() + 2 * half_closed
        if total > best_score:
            best_score, best = total, (centre, bends, row, np.append(near, clear[row, -1]))
    centre, bends, row, gaps = best
    draft.posture = {name: float(values[row]) for name, values in grid.items()}
    for path, bend in zip(paths, bends, strict=True):
        draft.posture |= {name: float(values[bend]) for name, values in path.items()}
    draft.centre = np.round(centre, 4)
    return gaps


def is_near(gaps: np.ndarray, gap: float) -> np.ndarray:
    """Which fingertips [F] hold the ball, from `find_grasp`'s distances."""
    return gaps < gap + _NEAR


def _gaps(ends: np.ndarray, radius: np.ndarray, centre: np.ndarray) -> np.ndarray:
    """Distances [N, C] m of a chain's capsules from the ball."""
    return segment_distance(centre, ends[:, :, 0], ends[:, :, 1]) - radius - BALL


def _bend(links: Sequence[Link], chain: Sequence[int]) -> dict[str, np.ndarray]:
    """Motor angles [N] by joint of a finger that bends more and more; hinges that swing it sideways stay."""
    angles, place = {}, 0
    flexing = set(flexion_links(links, chain))
    for at in chain:
        link = links[at]
        if link.is_motor:
            share = _SHARES[min(place, len(_SHARES) - 1)] if at in flexing else 0.0
            angles[link.joint] = np.clip(share * _BENDS, link.low, link.high)
        place += at in flexing
    return angles


def _grid(links: Sequence[Link], chain: Sequence[int]) -> dict[str, np.ndarray]:
    """Motor angles [N] by joint of a thumb: all combinations."""
    motors = [links[at] for at in chain if links[at].is_motor]
    steps = max(3, int(_THUMB_SAMPLES ** (1 / len(motors))))
    axes = [np.linspace(j.low + 0.05 * (j.high - j.low), j.high - 0.05 * (j.high - j.low), steps) for j in motors]
    values = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, len(motors))
    return {motor.joint: values[:, i] for i, motor in enumerate(motors)}


def _capsules_at(
    links: Sequence[Link], chain: Sequence[int], angles: Mapping[str, np.ndarray]
) -> tuple[np.ndarray, np.ndarray]:
    """Segments [N, C, 2, 3] and radii [C] of a chain's capsules, the tip's last, in postures of its motors."""
    count = len(next(iter(angles.values())))
    turn, shift = np.tile(np.eye(3), (count, 1, 1)), np.zeros((count, 3))
    ends, radii = [], []
    for link in (links[at] for at in chain):
        motor = angles.get(link.leader or link.joint, np.zeros(count))
        angle = link.offset + link.ratio * motor if link.leader else motor
        # The product of exponentials: every hinge turns what is beyond it about a line that is fixed in the drawing.
        own = Rotation.from_rotvec(np.outer(angle, link.axis)).as_matrix()
        shift = shift + np.einsum("nij,nj->ni", turn, link.anchor - own @ link.anchor)
        turn = turn @ own
        if link.capsule is not None:
            ends.append(np.einsum("nij,ej->nei", turn, link.capsule.ends) + shift[:, None])
            radii.append(link.capsule.radius)
    return np.stack(ends, 1), np.array(radii)


def _unit(vector: np.ndarray) -> np.ndarray:
    return vector / np.maximum(np.linalg.norm(vector, axis=-1, keepdims=True), 1e-12)
