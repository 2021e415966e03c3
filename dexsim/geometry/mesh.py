"""Triangle meshes: checked at the door, and their exact signed distance in NumPy (for baking and for tests).

The sign comes from the angle-weighted pseudo-normal at the nearest point (Baerentzen and Aanaes 2005), which is exact
for a closed mesh that does not cut through itself. `check_sign` compares it with the winding number, which knows
nothing of nearest points, and refuses a mesh where the two disagree.

Shapes: V vertices, T triangles, P points. Units: m, float64.
"""

from __future__ import annotations

import dataclasses
import hashlib
from functools import cached_property
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from dexsim.core.errors import AssetError

BLOCK = 1 << 20  # point-triangle pairs at a time
_BUNCH, _BATCH, _CHUNK = 64, 128, 32  # points in a bunch, bunches and candidate triangles in a compiled call
SMALLEST, LARGEST = 1e-3, 1.0  # m, size of what a hand can hold


@dataclasses.dataclass(frozen=True, eq=False)
class Mesh:
    """A closed surface with outward triangles. Make it with `load_mesh`, which checks it."""

    name: str
    vertices: np.ndarray  # [V, 3] m
    faces: np.ndarray  # [T, 3]

    @cached_property
    def corners(self) -> np.ndarray:
        """[T, 3, 3] m."""
        return self.vertices[self.faces]

    @cached_property
    def fingerprint(self) -> str:
        """SHA-256 of the geometry."""
        digest = hashlib.sha256(np.ascontiguousarray(self.vertices, "<f8").tobytes())
        digest.update(np.ascontiguousarray(self.faces, "<i8").tobytes())
        return digest.hexdigest()

    @cached_property
    def normals(self) -> np.ndarray:
        """Unit face normals [T, 3]; zero for a triangle without area."""
        a, b, c = np.moveaxis(self.corners, 1, 0)
        return _unit(np.cross(b - a, c - a))

    @cached_property
    def areas(self) -> np.ndarray:
        """[T] m^2."""
        a, b, c = np.moveaxis(self.corners, 1, 0)
        return 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=-1)

    @property
    def volume(self) -> float:
        """m^3."""
        return _volume(self.corners)

    @property
    def bounds(self) -> np.ndarray:
        """Lowest and highest corner [2, 3] m."""
        return np.stack([self.vertices.min(0), self.vertices.max(0)])

    @cached_property
    def pseudo_normals(self) -> np.ndarray:
        """[T, 7, 3]: of each triangle's face, its edges (opposite to corner 0, 1, 2) and its corners (0, 1, 2)."""
        a, b, c = np.moveaxis(self.corners, 1, 0)
        normal, faces = self.normals, self.faces
        at_vertex = np.zeros_like(self.vertices)
        for corner, (p, q, r) in enumerate(((a, b, c), (b, c, a), (c, a, b))):
            cosine = np.sum(_unit(q - p) * _unit(r - p), -1)
            angle = np.arccos(np.clip(cosine, -1, 1))
            np.add.at(at_vertex, faces[:, corner], angle[:, None] * normal)
        edges = np.sort(np.stack([faces[:, [1, 2]], faces[:, [2, 0]], faces[:, [0, 1]]], 1), -1)  # [T, 3, 2]
        key = edges[..., 0] * len(self.vertices) + edges[..., 1]
        _, edge = np.unique(key, return_inverse=True)
        edge = edge.reshape(-1, 3)
        at_edge = np.zeros((edge.max() + 1, 3))
        np.add.at(at_edge, edge, np.broadcast_to(normal[:, None], (*edge.shape, 3)))
        return np.concatenate([normal[:, None], at_edge[edge], at_vertex[faces]], 1)


def load_mesh(source: Any, *, scale: float = 1.0, name: str | None = None) -> Mesh:
    """Read a mesh file, or take a `trimesh.Trimesh` or a pair (vertices, faces), and check it.

    Args:
      source: path (any format that trimesh reads), mesh object or arrays.
      scale: factor on the coordinates; 0.001 for files in millimetres.

    Raises:
      AssetError: not readable, not finite, of no graspable size, open, with inconsistent or inward normals, or flat.
    """
    vertices, faces, found = _read(source)
    name = name or found
    if not len(faces):
        raise AssetError(f"{name}: no triangles")
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise AssetError(f"{name}: a triangle names vertex {faces.max()}, there are {len(vertices)}")
    bad = np.flatnonzero(~np.all(np.isfinite(vertices), 1))
    if bad.size:
        raise AssetError(f"{name}: vertex {bad[0]} is not finite ({bad.size} of {len(vertices)})")
    vertices = vertices * scale
    size = float(np.ptp(vertices, axis=0).max())
    if not SMALLEST <= size <= LARGEST:
        raise AssetError(
            f"{name}: {size:.3g} m across at scale {scale:g}, expected {SMALLEST:g} to {LARGEST:g} m; coordinates are "
            "metres, pass scale=0.001 for a file in millimetres (ObjectConfig.mesh_unit)"
        )
    vertices, faces = _merge(vertices, faces, 1e-7 * size)
    _check_closed(name, vertices, faces, size)
    return Mesh(name, vertices, faces)


def signed_distance(mesh: Mesh, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Exact distance [P] m, negative inside, and its gradient [P, 3], at points [P, 3].

    At a point on the surface the gradient is the pseudo-normal.
    """
    points = np.asarray(points, np.float64).reshape(-1, 3)
    nearest, normal = find_nearest(mesh, points)
    apart = points - nearest
    gap = np.linalg.norm(apart, axis=-1)
    sign = np.where(np.sum(apart * normal, -1) < 0, -1.0, 1.0)
    close = gap < 1e-9
    gradient = np.where(close[:, None], _unit(normal), sign[:, None] * apart / np.where(close, 1.0, gap)[:, None])
    return sign * gap, gradient


def winding_number(mesh: Mesh, points: np.ndarray) -> np.ndarray:
    """How often [P] the surface winds round each point [P, 3]: 1 inside, 0 outside (van Oosterom and Strackee 1983)."""
    total = []
    step = max(1, BLOCK // len(mesh.faces))
    for start in range(0, len(points), step):
        arm = mesh.corners[None] - points[start : start + step, None, None]  # [p, T, 3, 3]
        length = np.linalg.norm(arm, axis=-1)
        a, b, c = np.moveaxis(arm, 2, 0)
        la, lb, lc = np.moveaxis(length, 2, 0)
        top = np.sum(a * np.cross(b, c), -1)
        bottom = la * lb * lc + np.sum(a * b, -1) * lc + np.sum(b * c, -1) * la + np.sum(c * a, -1) * lb
        total.append(np.sum(2 * np.arctan2(top, bottom), 1) / (4 * np.pi))
    return np.concatenate(total)


def check_sign(mesh: Mesh, count: int = 400) -> None:
    """Compare the sign of the distance with the winding number at random points, most of them inside.

    Raises:
      AssetError: the mesh cannot be signed, with the number of points that say so.
    """
    rng = np.random.default_rng(0)
    low, high = mesh.bounds
    skin, normal, _ = sample_surface(mesh, count // 2, rng)
    depth = rng.uniform(0, 0.1, (len(skin), 1)) * (high - low).max()
    points = np.concatenate([rng.uniform(low, high, (count, 3)), skin - depth * normal])
    winding = winding_number(mesh, points)
    distance, _ = signed_distance(mesh, points)
    clear = np.abs(distance) > 1e-6 * (high - low).max()
    inside = np.abs(winding) > 0.5
    if not np.any(inside & clear):
        raise AssetError(f"{mesh.name}: cannot be signed: no interior point found in {len(points)}")
    wrong = clear & ((inside != (distance < 0)) | (np.abs(winding - inside) > 0.1))
    if np.any(wrong):
        raise AssetError(
            f"{mesh.name}: cannot be signed: inside and outside disagree at {wrong.sum()} of "
            f"{len(points)} random points; the surface cuts through itself or a part is inside out"
        )


def sample_surface(mesh: Mesh, count: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Random points [count, 3] m, uniform by area, with their face normals [count, 3] and faces [count]."""
    share = np.cumsum(mesh.areas)
    face = np.searchsorted(share, rng.uniform(0, share[-1], count)).clip(0, len(share) - 1)
    u, v = np.sqrt(rng.uniform(size=count)), rng.uniform(size=count)
    weight = np.stack([1 - u, u * (1 - v), u * v], -1)
    return np.einsum("pk,pkd->pd", weight, mesh.corners[face]), mesh.normals[face], face


def _read(source: Any) -> tuple[np.ndarray, np.ndarray, str]:
    if isinstance(source, Mesh):
        return source.vertices, source.faces, source.name
    if isinstance(source, tuple):
        if len(source) != 2:
            raise AssetError(f"mesh: a tuple of {len(source)}; give (vertices, faces)")
        (vertices, faces), name = source, "mesh"
    else:
        if isinstance(source, (str, Path)):
            import trimesh

            path = Path(source)
            if not path.is_file():
                raise AssetError(f"{path}: no such file")
            name = str(path)
            try:
                source = trimesh.load(path, force="mesh", process=False)
            except Exception as error:  # each of trimesh's readers raises its own
                raise AssetError(f"{path}: {' '.join(str(error).split()) or type(error).__name__}") from None
        else:
            name = getattr(source, "metadata", {}).get("name", "mesh")
        if not hasattr(source, "faces") or not hasattr(source, "vertices"):
            raise AssetError(f"{name}: {type(source).__name__} is no triangle mesh")
        vertices, faces = source.vertices, source.faces
    try:
        vertices, faces = np.asarray(vertices, np.float64), np.asarray(faces)
        whole = not faces.size or np.array_equal(faces, faces.astype(np.int64))
    except (TypeError, ValueError) as error:
        raise AssetError(f"{name}: vertices and triangles must be arrays of numbers ({error})") from None
    if not whole:
        raise AssetError(f"{name}: triangles must be whole numbers, the rows of their vertices")
    if vertices.ndim != 2 or vertices.shape[1:] != (3,) or (faces.size and (faces.ndim != 2 or faces.shape[1] != 3)):
        raise AssetError(
            f"{name}: expected vertices [V, 3] and triangles [T, 3], got {vertices.shape} and {faces.shape}"
        )
    return vertices, faces.astype(np.int64), name


def _merge(vertices: np.ndarray, faces: np.ndarray, tolerance: float) -> tuple[np.ndarray, np.ndarray]:
    """Vertices at the same place become one (STL repeats them); triangles that vanish by it are dropped."""
    cell = np.round(vertices / tolerance).astype(np.int64)
    _, first, inverse = np.unique(cell, axis=0, return_index=True, return_inverse=True)
    faces = inverse.reshape(-1)[faces]
    keep = (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])
    return vertices[first], faces[keep]


def _check_closed(name: str, vertices: np.ndarray, faces: np.ndarray, size: float) -> None:
    """Every edge joins two triangles that run along it in opposite directions, and the volume is positive."""
    if not len(faces):
        raise AssetError(f"{name}: encloses no volume (every triangle is a line or a point)")
    edge = faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    low, high = edge.min(1), edge.max(1)
    _, which, count = np.unique(low * len(vertices) + high, return_inverse=True, return_counts=True)
    if np.any(count != 2):
        once, many = int(np.sum(count == 1)), int(np.sum(count > 2))
        what = f"{once} edges belong to one triangle only" if once else f"{many} edges join more than two triangles"
        raise AssetError(f"{name}: the surface is open, {what}; close it (trimesh.repair) or use its convex hull")
    balance = np.zeros(len(count), np.int64)
    np.add.at(balance, which.reshape(-1), np.where(edge[:, 0] == low, 1, -1))
    if np.any(balance):
        raise AssetError(
            f"{name}: normals point both ways, {np.sum(balance != 0)} edges join triangles of opposite "
            "winding; trimesh.repair.fix_winding makes them agree"
        )
    volume = _volume(vertices[faces])
    if abs(volume) < 1e-6 * size**3:
        raise AssetError(f"{name}: encloses no volume ({volume:.3g} m^3 for a size of {size:.3g} m)")
    if volume < 0:
        raise AssetError(f"{name}: normals point inward (volume {volume:.3g} m^3); turn it with mesh.invert()")


def _volume(corners: np.ndarray) -> float:
    a, b, c = np.moveaxis(corners - corners.mean((0, 1)), 1, 0)
    return float(np.sum(a * np.cross(b, c)) / 6)


def _unit(vector: np.ndarray) -> np.ndarray:
    length = np.linalg.norm(vector, axis=-1, keepdims=True)
    return vector / np.where(length > 0, length, 1.0)


# --- the nearest point of a mesh to many points; B bunches of points -----------------------------


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
