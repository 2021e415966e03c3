"""The nearest point of a triangle mesh to many points, for `dexsim.geometry.mesh`.

Shapes: T triangles, P points, B bunches of points. Units: m.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
import numpy as np

if TYPE_CHECKING:
    from dexsim.geometry.mesh import Mesh

BLOCK = 1 << 20  # point-triangle pairs at a time
_BUNCH, _BATCH, _CHUNK = 64, 128, 32  # points in a bunch, bunches and candidate triangles in a compiled call


def find_nearest(mesh: Mesh, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Nearest surface point [P, 3] and its pseudo-normal [P, 3].

    Points are handled in bunches of neighbours. A triangle can only be nearest to one of a bunch if it is hardly
    farther from the bunch's middle than the nearest one is. The search is in single precision; what it found is
    measured again in double.
    """
    corners = mesh.corners.astype(np.float32)
    bunch = _bunches(points)  # [B, 64] indices
    members = points[bunch]
    middle = (members.min(1) + members.max(1)) / 2
    radius = np.linalg.norm(members - middle[:, None], axis=-1).max(1)
    face = np.zeros(bunch.shape, np.int64)
    step = max(1, min(len(bunch), 16 * BLOCK // len(corners)))
    for start in range(0, len(bunch), step):
        rows = slice(start, start + step)
        reach = np.asarray(_reach(_padded(middle[rows].astype(np.float32), step), corners))[: len(middle[rows])]
        near = reach <= reach.min(1, keepdims=True) + 2 * radius[rows, None] + 1e-6
        face[rows] = _best_of(members[rows].astype(np.float32), near, corners)
    best = np.empty(len(points), np.int64)
    best[bunch] = face
    weight = _barycentric(points, *np.moveaxis(mesh.corners[best], 1, 0))
    zero = weight <= 1e-12
    feature = np.where(zero.sum(1) == 0, 0, np.where(zero.sum(1) == 1, 1 + zero.argmax(1), 4 + weight.argmax(1)))
    return np.einsum("pc,pcd->pd", weight, mesh.corners[best]), mesh.pseudo_normals[best, feature]


def _bunches(points: np.ndarray) -> np.ndarray:
    """Indices [B, 64] of neighbouring points; every point is in one, the last bunch repeats a point."""
    low = points.min(0)
    cell = np.floor((points - low) / (np.ptp(points, axis=0).max() * 1.0001 + 1e-12) * 16).astype(np.int64)
    order = np.argsort((cell[:, 0] * 16 + cell[:, 1]) * 16 + cell[:, 2], kind="stable")
    return _padded(order, -(-len(order) // _BUNCH) * _BUNCH).reshape(-1, _BUNCH)


def _padded(rows: np.ndarray, count: int) -> np.ndarray:
    """`rows` with the last one repeated, so that compiled code sees few shapes."""
    return np.concatenate([rows, np.repeat(rows[-1:], count - len(rows), axis=0)])


def _best_of(points: np.ndarray, near: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """The nearest triangle [B, 64] to points [B, 64, 3] of those allowed by near [B, T], 32 candidates at a time."""
    count = near.sum(1)
    order = np.argsort(-count, kind="stable")  # bunches with as many candidates together
    face = np.zeros(points.shape[:2], np.int64)
    for start in range(0, len(order), _BATCH):
        rows = order[start : start + _BATCH]
        chunks = -(-int(count[rows[0]]) // _CHUNK)
        candidate = np.zeros((_BATCH, chunks * _CHUNK), np.int64)
        for k, row in enumerate(rows):
            found = np.flatnonzero(near[row])
            candidate[k, : len(found)] = found
            candidate[k, len(found) :] = found[0]
        some = _padded(points[rows], _BATCH)
        best, gap = np.zeros(some.shape[:2], np.int64), np.full(some.shape[:2], np.inf, np.float32)
        for part in np.split(candidate, chunks, axis=1):
            found, which = (np.asarray(x) for x in _closest(some, corners[part]))
            better = found < gap
            gap = np.where(better, found, gap)
            best = np.where(better, np.take_along_axis(part, which, 1), best)
        face[rows] = best[: len(rows)]
    return face


@jax.jit
def _reach(points: jax.Array, corners: jax.Array) -> jax.Array:
    """Distances [B, T] of points [B, 3] from triangles [T, 3, 3]."""
    return jnp.sqrt(_squared(points[:, None], corners[None]))


@jax.jit
def _closest(points: jax.Array, corners: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Squared distance [B, Q] of points [B, Q, 3] from the nearest of triangles [B, K, 3, 3], and which it is."""
    squared = _squared(points[:, :, None], corners[:, None])
    return jnp.min(squared, -1), jnp.argmin(squared, -1)


def _squared(point: jax.Array, corners: jax.Array) -> jax.Array:
    """Squared distance [...] of points [..., 3] from triangles [..., 3, 3]: the least of face and edges."""

    def dot(x, y):
        return x[..., 0] * y[..., 0] + x[..., 1] * y[..., 1] + x[..., 2] * y[..., 2]

    def cross(x, y):
        (a, b, c), (d, e, f) = (tuple(v[..., k] for k in range(3)) for v in (x, y))
        return jnp.stack([b * f - c * e, c * d - a * f, a * e - b * d], -1)

    normal = cross(corners[..., 1, :] - corners[..., 0, :], corners[..., 2, :] - corners[..., 0, :])
    edges, inside = [], True
    for k in range(3):
        start, edge = corners[..., k, :], corners[..., (k + 1) % 3, :] - corners[..., k, :]
        arm = point - start
        t = jnp.clip(dot(arm, edge) / jnp.maximum(dot(edge, edge), 1e-30), 0.0, 1.0)
        off = arm - t[..., None] * edge
        edges.append(dot(off, off))
        inside = inside & (dot(cross(normal, edge), arm) > 0)
    height = dot(normal, point - corners[..., 0, :])
    face = height**2 / jnp.maximum(dot(normal, normal), 1e-30)
    nearest_edge = jnp.minimum(jnp.minimum(edges[0], edges[1]), edges[2])
    return jnp.where(inside, face, nearest_edge)


def _barycentric(p: np.ndarray, a: np.ndarray, b: np.ndarray, c: np.ndarray) -> np.ndarray:
    """Weights [..., 3] of a, b, c at the point of the triangle nearest to p (Ericson 2005, 5.1.5)."""

    def dot(x, y):
        return np.einsum("...d,...d->...", x, y)

    ab, ac, ap = b - a, c - a, p - a
    d1, d2 = dot(ab, ap), dot(ac, ap)
    abab, abac, acac = dot(ab, ab), dot(ab, ac), dot(ac, ac)
    d3, d4 = d1 - abab, d2 - abac  # at b
    d5, d6 = d1 - abac, d2 - acac  # at c
    va, vb, vc = d3 * d6 - d5 * d4, d5 * d2 - d1 * d6, d1 * d4 - d3 * d2

    def ratio(top, bottom):
        return np.where(bottom != 0, top / np.where(bottom != 0, bottom, 1.0), 0.0)

    total = va + vb + vc
    v, w = ratio(vb, total), ratio(vc, total)  # the face
    on_bc = (va <= 0) & (d4 - d3 >= 0) & (d5 - d6 >= 0) | (total <= 0)
    t = np.clip(ratio(d4 - d3, (d4 - d3) + (d5 - d6)), 0, 1)
    v, w = np.where(on_bc, 1 - t, v), np.where(on_bc, t, w)
    on_ac = (vb <= 0) & (d2 >= 0) & (d6 <= 0)
    v, w = np.where(on_ac, 0.0, v), np.where(on_ac, ratio(d2, d2 - d6), w)
    on_ab = (vc <= 0) & (d1 >= 0) & (d3 <= 0)
    v, w = np.where(on_ab, ratio(d1, d1 - d3), v), np.where(on_ab, 0.0, w)
    at_c = (d6 >= 0) & (d5 <= d6)
    v, w = np.where(at_c, 0.0, v), np.where(at_c, 1.0, w)
    at_b = (d3 >= 0) & (d4 <= d3)
    v, w = np.where(at_b, 1.0, v), np.where(at_b, 0.0, w)
    at_a = (d1 <= 0) & (d2 <= 0)
    v, w = np.where(at_a, 0.0, v), np.where(at_a, 0.0, w)
    return np.stack([1 - v - w, v, w], -1)
