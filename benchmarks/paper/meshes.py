"""Twelve closed meshes for objects that no training has seen: hollow, thin, bent and heavy ones, 30 to 90 mm.

`write(folder)` makes the files in `assets/objects/` anew, in metres. z is the axis that lies across the fingers.
"""

from collections.abc import Callable
from pathlib import Path

import numpy as np

Surface = tuple[np.ndarray, np.ndarray]  # vertices [V, 3] m, faces [T, 3]


def _faces_between(rings: int, around: int, closed: bool) -> np.ndarray:
    """Triangles of a grid of `rings` times `around` vertices that closes around, and along it where `closed`."""
    row, column = np.meshgrid(np.arange(rings if closed else rings - 1), np.arange(around), indexing="ij")
    after, beside = (row + 1) % rings, (column + 1) % around
    a, b, c, d = (i * around + j for i, j in ((row, column), (row, beside), (after, beside), (after, column)))
    return np.stack([np.stack([a, b, c], -1), np.stack([a, c, d], -1)], -2).reshape(-1, 3)


def tube(rings: np.ndarray) -> Surface:
    """The surface through closed rings [R, A, 3], with flat ends."""
    count, around, _ = rings.shape
    ends = np.stack([rings[0].mean(0), rings[-1].mean(0)])
    turn, last = np.roll(np.arange(around), -1), (count - 1) * around
    first_cap = np.stack([np.full(around, count * around), turn, np.arange(around)], -1)
    last_cap = np.stack([np.full(around, count * around + 1), last + np.arange(around), last + turn], -1)
    faces = np.concatenate([_faces_between(count, around, False), first_cap, last_cap])
    return np.concatenate([rings.reshape(-1, 3), ends]), faces


def turned(profile: np.ndarray, around: int = 32) -> Surface:
    """A closed profile [P, 2] of (radius > 0, z), turned about z."""
    angle = 2 * np.pi * np.arange(around) / around
    x = profile[:, None, 0] * np.cos(angle)
    y = profile[:, None, 0] * np.sin(angle)
    z = np.broadcast_to(profile[:, None, 1], x.shape)
    return np.stack([x, y, z], -1).reshape(-1, 3), _faces_between(len(profile), around, True)


def cells(filled: np.ndarray, pitch: tuple[float, float, float]) -> Surface:
    """The surface of the filled cells [X, Y, Z] of a lattice; cells that touch do so with a face."""
    padded, quads = np.pad(np.asarray(filled, bool), 1), []
    for axis in range(3):
        for side in (-1, 1):
            bare = padded & ~np.roll(padded, -side, axis)
            corner = np.zeros((4, 3), int)
            u, v = (axis + 1) % 3, (axis + 2) % 3
            corner[[1, 2], u], corner[[2, 3], v] = 1, 1
            corner[:, axis] = side > 0
            quads.append(np.argwhere(bare)[:, None] + (corner if side > 0 else corner[::-1]))
    points, index = np.unique(np.concatenate(quads).reshape(-1, 3), axis=0, return_inverse=True)
    a, b, c, d = index.reshape(-1, 4).T
    return points * np.asarray(pitch), np.concatenate([np.stack([a, b, c], -1), np.stack([a, c, d], -1)])


def _circle(points: int) -> np.ndarray:
    angle = 2 * np.pi * np.arange(points) / points
    return np.stack([np.cos(angle), np.sin(angle)], -1)


def _star(points: int, outer: float, inner: float, half: float) -> Surface:
    """A prism over a star, its height across the fingers."""
    angle = np.pi * np.arange(2 * points) / points
    radius = np.where(np.arange(2 * points) % 2, inner, outer)
    ring = np.stack([radius * np.cos(angle), radius * np.sin(angle)], -1)
    return tube(np.stack([np.column_stack([ring, np.full(2 * points, z)]) for z in (-half, half)]))


def _bar(place: Callable[[float], np.ndarray], side: Callable[[float], np.ndarray], size: Callable, steps: int = 24):
    """A tube whose cross-section is an ellipse of half axes `size(t)` along `side(t)` and y."""
    angle = 2 * np.pi * np.arange(24) / 24
    rings = []
    for t in np.linspace(-1, 1, steps):
        a, b = size(t)
        rings.append(place(t) + np.outer(a * np.cos(angle), side(t)) + np.outer(b * np.sin(angle), [0.0, 1.0, 0.0]))
    return tube(np.array(rings))


def _banana() -> Surface:
    def place(t: float) -> np.ndarray:
        return 0.045 * np.array([np.cos(0.95 * t), 0.0, np.sin(0.95 * t)])

    return _bar(
        place, lambda t: np.array([np.cos(0.95 * t), 0.0, np.sin(0.95 * t)]), lambda t: 2 * [0.015 - 0.006 * t * t]
    )


def _twisted() -> Surface:
    def ring(t: float) -> np.ndarray:
        angle, corner = 0.8 * t, np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]) * (0.018, 0.012)
        turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        return np.column_stack([corner @ turn.T, np.full(4, 0.032 * t)])

    return tube(np.array([ring(t) for t in np.linspace(-1, 1, 13)]))


def _frustum(low: float, high: float, half: float) -> Surface:
    corner = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]])
    return tube(np.stack([np.column_stack([r * corner, np.full(4, z)]) for r, z in ((low, -half), (high, half))]))


def _from_above(*rows: str) -> np.ndarray:
    """A lattice one cell deep: `#` is filled, rows along x, columns along z."""
    return np.array([[[mark == "#" for mark in row]] for row in rows])


MESHES: dict[str, Callable[[], Surface]] = {
    # Not convex.
    "l_bracket": lambda: cells(_from_above("#..", "#..", "###"), (0.019, 0.034, 0.019)),
    "u_channel": lambda: cells(_from_above("#.#", "#.#", "###"), (0.015, 0.036, 0.018)),
    "stairs": lambda: cells(_from_above("#..", "##.", "###"), (0.016, 0.036, 0.018)),
    "h_beam": lambda: cells(_from_above("###", ".#.", "###"), (0.015, 0.034, 0.022)),
    "bowl": lambda: turned(1e-3 * np.array([[4, -20], [20, -20], [31, 16], [24, 16], [14, -10], [4, -10]])),
    "ring": lambda: turned(_circle(16) * (0.010, 0.012) + (0.022, 0.0)),
    "star": lambda: _star(5, 0.034, 0.019, 0.018),
    "banana": _banana,
    "twisted_bar": _twisted,
    # Thin.
    "plate": lambda: cells(np.ones((1, 1, 1)), (0.010, 0.044, 0.062)),
    # Heavy.
    "ingot": lambda: _frustum(0.026, 0.019, 0.022),
    "spool": lambda: turned(
        1e-3 * np.array([[4, -28], [26, -28], [26, -16], [18, -10], [18, 10], [26, 16], [26, 28], [4, 28]]), around=4
    ),
}
"""Name to surface. Their masses are in `held_out.HEAVY`."""


def write(folder: Path) -> None:
    """Write every mesh to `folder`, as binary STL."""
    import trimesh

    folder.mkdir(parents=True, exist_ok=True)
    for name, make in MESHES.items():
        vertices, faces = make()
        body = trimesh.Trimesh(vertices, faces)
        body.vertices -= body.bounds.mean(0)
        body.export(folder / f"{name}.stl")
