"""A first grasp: where a ball lies before the palm, and the joint angles that close fingers and thumb round it.

Shapes: N postures tried at once, C capsules of a finger. Units: m, rad, in the palm frame.
"""

import itertools

import numpy as np

from dexsim.hand.description import Hand, unit
from dexsim.hand.fit import segment_distance
from dexsim.hand.kinematics import finger_bodies, flexion_joints, open_hand
from dexsim.hand.mjcf import hand_poses

BALL = 0.028  # m, radius: the middle of the spheres that grasps are trained with
_SHARES = (1.0, 0.9, 0.6, 0.6, 0.6)  # of the bend, from a finger's first flexing hinge on
_BENDS = np.linspace(0.0, 1.6, 41)  # rad
_HALF = 1.0  # rad, a bend that is half closed
_THUMB_SAMPLES = 1500  # about; joints of a thumb are tried on a grid
_STEP = 8e-3  # m, between places of the ball
_NEAR = 0.02  # m, a tip farther from the ball than this and the gap does not hold it


def find_grasp(hand: Hand, gap: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Close a hand of `folder.write_hand` round a ball that lies at the palm, `gap` m away from every link.

    The ball is tried in M places before the palm. At each place every finger bends until a link is `gap` away from the
    ball; the thumb takes the posture of a grid that opposes the fingers best.

    Returns:
      Joint angles [J] rad, the ball's centre [3] m, and how far [F] m each fingertip, the thumb's first, is from the
      ball.
    """
    palm, fingers = next(geom for geom in hand.geoms if geom.name == "palm_box"), range(hand.num_fingers)
    paths = [_thumb_grid(hand), *(_bending(hand, finger) for finger in fingers[1:])]
    shapes = [_capsules(hand, finger, path) for finger, path in enumerate(paths)]
    roots = np.array([hand.body_position[finger_bodies(hand, finger)[-2]] for finger in fingers])
    height = palm.position[0] + palm.size[0] + BALL + 0.006
    # Over the palm, or a little beyond the fingers' roots.
    low = np.maximum(roots.min(0)[1:] - [0.0, 0.02], (palm.position - palm.size)[1:] + BALL / 2)
    high = np.maximum(roots.max(0)[1:] + [0.0, 0.06], low + _STEP)
    sides = np.arange(low[0], high[0] + 1e-9, _STEP), np.arange(low[1], high[1], _STEP)
    centres = np.array([(height, y, z) for y, z in itertools.product(*sides)])
    balls = centres[:, None, None]
    clear = [segment_distance(balls, ends[:, :, 0], ends[:, :, 1]) - radius - BALL for ends, radius in shapes]
    blocked = [gaps.min(2) < gap for gaps in clear]  # [M, N]
    rows = [np.where(near.any(1), np.maximum(near.argmax(1) - 1, 0), near.shape[1] - 1) for near in blocked]
    tips = np.array([ends[row, -1, 1] for (ends, _), row in zip(shapes, rows, strict=True)])[1:]  # [F - 1, M, 3]
    near = np.array([gaps[np.arange(len(row)), row, -1] for gaps, row in zip(clear, rows, strict=True)])[1:]
    holds = np.exp(-np.maximum(near - gap, 0) / _NEAR)
    below = np.clip((tips[..., 0] - height) / 0.02, -1, 1)  # tips carry from below the ball's middle
    mean = unit((unit(tips - centres) * holds[..., None]).sum(0) + 1e-9)
    tip = shapes[0][0][:, -1, 1]
    score = np.clip((tip[:, 0] - height) / 0.02, -1, 1) - np.sum(unit(tip - balls[:, 0]) * mean[:, None], -1)
    score -= np.maximum(clear[0][..., -1] - gap, 0) / _NEAR + 10 * blocked[0]
    rows[0] = score.argmax(1)
    half_closed = -np.mean((_BENDS[rows[1:]] - _HALF) ** 2, 0)  # fingers must have way left to close
    best = np.argmax(score.max(1) + holds.mean(0) + below.mean(0) + 2 * half_closed)
    taken = [row[best] for row in rows]
    # Each posture is the open hand with one finger bent.
    opened = open_hand(hand)
    posture = opened + np.sum([path[row] - opened for path, row in zip(paths, taken, strict=True)], 0)
    gaps = np.array([gaps[best, row, -1] for gaps, row in zip(clear, taken, strict=True)])
    return posture, centres[best], gaps


def _bending(hand: Hand, finger: int) -> np.ndarray:
    """Postures [N, J] in which a finger bends more and more; hinges that swing it sideways stay."""
    postures, flexing = np.tile(open_hand(hand), (len(_BENDS), 1)), flexion_joints(hand, range(finger, finger + 1))
    hinges = [joint for joint in hand.body_joint[finger_bodies(hand, finger)[::-1]] if joint in flexing]
    for joint in flexing:  # a motor that moves two hinges has the first one's share
        share = _SHARES[hinges.index(joint)]
        postures[:, joint] = np.clip(share * _BENDS, hand.joint_lower[joint], hand.joint_upper[joint])
    return postures


def _thumb_grid(hand: Hand) -> np.ndarray:
    """Postures [N, J] with all combinations of the thumb's joints."""
    joints = sorted({int(joint) for joint in hand.body_joint[finger_bodies(hand, 0)]} - {-1})
    steps = max(3, int(_THUMB_SAMPLES ** (1 / len(joints))))
    shares = np.stack(np.meshgrid(*[np.linspace(0.05, 0.95, steps)] * len(joints), indexing="ij"), -1)
    postures = np.tile(open_hand(hand), (steps ** len(joints), 1))
    low, high = hand.joint_lower[joints], hand.joint_upper[joints]
    postures[:, joints] = low + shares.reshape(-1, len(joints)) * (high - low)
    return postures


def _capsules(hand: Hand, finger: int, postures: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Segments [N, C, 2, 3] and radii [C] of a finger's capsules, the tip's last, in postures [N, J]."""
    position, rotation = (np.stack(x) for x in zip(*(pose[:2] for pose in hand_poses(hand, postures)), strict=True))
    ends, radii = [], []
    for body in finger_bodies(hand, finger)[-2::-1]:
        for geom in (geom for geom in hand.geoms if geom.body == body):
            own = geom.position + np.outer([-geom.size[1], geom.size[1]], geom.rotation[:, 2])
            ends.append(position[:, None, body] + own @ rotation[:, body].swapaxes(-1, -2))
            radii.append(geom.size[0])
    return np.stack(ends, 1), np.array(radii)
