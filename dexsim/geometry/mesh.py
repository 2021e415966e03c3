"""Triangle meshes: checked at the door, and their exact signed distance in NumPy (for baking and for tests).

The sign is that of the nearest triangle; where several share the nearest point, of the one whose plane is farthest away
(Payne and Toga 1992), which is exact for a closed mesh that does not cut through itself. `check_sign` compares volumes.

A mesh is a `trimesh.Trimesh`, whose name is in its `metadata`. Shapes: V vertices, T triangles, P points. Units: m,
float64.
"""

import hashlib
import sys
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from scipy.ndimage import binary_fill_holes
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist
from trimesh import Trimesh

from dexsim.errors import AssetError

BLOCK = 1 << 20  # point-triangle pairs at a time
SMALLEST, LARGEST = 1e-3, 1.0  # m, size of what a hand can hold
_TIE = 1e-12  # m, triangles whose distances differ by less are equally near
_SAME = 1e-7  # share of a mesh's size to which corners are rounded before they are compared
REPAIRS = ("none", "shell", "hull")
"""What `load_mesh` does with a mesh that is not closed."""
_CELLS = 48  # of a shell's grid along the longest side
_SAMPLES = 50_000  # points on a surface that stand for it
_CLOSE = 0.25  # cells, distance of a shell from the surface that it closes


def load_mesh(source: Any, *, scale: float = 1.0, repair: str = "none") -> Trimesh:
    """Read a mesh file, or take a `trimesh.Trimesh` or a pair (vertices, faces), and check that it is closed, with
    outward triangles.

    Corners at the same place, to about 1e-7 of the mesh's size, become one: STL repeats them.

    Args:
      source: path (any format that trimesh reads), mesh object or arrays.
      scale: factor on the coordinates; 0.001 for files in millimetres.
      repair: one of REPAIRS, for a mesh that fails the check. shell: its voxel shell, with cavities filled; hull: its
        convex hull. Says on standard error how far from the given surface the result is.

    Raises:
      AssetError: not readable, not finite, of no graspable size, open, non-manifold, with inconsistent or inward
        normals, or flat.
    """
    name = str(source) if isinstance(source, (str, Path)) else "mesh"
    try:
        given = trimesh.load(source, force="mesh", process=False) if name != "mesh" else source
    except Exception as error:  # each of trimesh's readers raises its own
        raise AssetError(f"{name}: {' '.join(str(error).split()) or type(error).__name__}") from None
    vertices, faces = given if isinstance(given, tuple) else (given.vertices, given.faces)
    if not len(faces) or not np.all(np.isfinite(vertices)):
        raise AssetError(f"{name}: {'a vertex is not finite' if len(faces) else 'no triangles'}")
    size = float(scale * np.ptp(np.asarray(vertices)[np.ravel(faces)], axis=0).max())  # without loose vertices
    if not SMALLEST <= size <= LARGEST:
        raise AssetError(
            f"{name}: {size:.3g} m across at scale {scale:g}, expected {SMALLEST:g} to {LARGEST:g} m; coordinates are "
            "metres, pass scale=0.001 for a file in millimetres (ObjectConfig.mesh_unit)"
        )
    mesh = _merged(make_mesh(name, scale * np.asarray(vertices, np.float64), faces))
    try:
        _check_closed(mesh, size)
    except AssetError as error:
        if repair == "none":
            raise
        closed = (_shell if repair == "shell" else _hull)(mesh)
        mesh, open_one = _merged(make_mesh(f"{name} after repair", closed.vertices, closed.faces)), mesh
        _check_closed(mesh, size)
        a, b = _points_on(open_one), _points_on(mesh)
        away = 1e3 * max(cKDTree(a).query(b)[0].max(), cKDTree(b).query(a)[0].max())
        print(f"{error}; its {repair} is {away:.2g} mm away", file=sys.stderr)
    return mesh


def make_mesh(name: str, vertices: np.ndarray, faces: np.ndarray) -> Trimesh:
    """A mesh of these arrays as they are, unchecked."""
    return trimesh.Trimesh(vertices, faces, process=False, metadata={"name": name})


def fingerprint(mesh: Trimesh) -> str:
    """SHA-256 of the geometry."""
    digest = hashlib.sha256(np.ascontiguousarray(mesh.vertices, "<f8").tobytes())
    digest.update(np.ascontiguousarray(mesh.faces, "<i8").tobytes())
    return digest.hexdigest()


def signed_distance(mesh: Trimesh, points: np.ndarray) -> np.ndarray:
    """Exact distance [P] m, negative inside, at points [P, 3] m.

    No triangle is farther away than the nearest corner, and none nearer than its bounding sphere: few are left to
    measure for each point.
    """
    corners, normals = np.asarray(mesh.triangles), np.asarray(mesh.face_normals)
    reach = cKDTree(corners.reshape(-1, 3)).query(points)[0]
    middle = (corners.min(1) + corners.max(1)) / 2
    radius = np.linalg.norm(corners - middle[:, None], axis=-1).max(1) + _TIE
    distance, step = np.empty(len(points)), max(1, BLOCK // len(corners))
    for start in range(0, len(points), step):
        some = points[start : start + step]
        row, face = np.nonzero(cdist(some, middle) - radius <= reach[start : start + step, None])
        offset = some[row] - trimesh.triangles.closest_point(corners[face], some[row])
        gap = np.linalg.norm(offset, axis=-1)
        least = np.full(len(some), np.inf)
        np.minimum.at(least, row, gap)
        off_plane = np.sum(offset * normals[face], -1)
        # The last triangle of each point is the one that tells inside from outside.
        order = np.lexsort((np.where(gap <= least[row] + _TIE, np.abs(off_plane), -1.0), row))
        last = order[np.searchsorted(row[order], np.arange(len(some)), side="right") - 1]
        distance[start : start + step] = np.where(off_plane[last] < 0, -1.0, 1.0) * gap[last]
    return distance


def check_sign(mesh: Trimesh, count: int = 20_000) -> None:
    """Compare the volume where the distance is negative with what the mesh encloses, by random points. Raises
    AssetError: they differ by more than a tenth and the error of sampling: the mesh cannot be signed."""
    low, high = mesh.bounds
    distance = signed_distance(mesh, np.random.default_rng(0).uniform(low, high, (count, 3)))
    inside, enclosed = np.sum(distance < 0), count * mesh.volume / np.prod(high - low)
    if abs(inside - enclosed) > 0.1 * enclosed + 4 * np.sqrt(enclosed):
        why = f"{inside} of {count} random points are inside, expected {enclosed:.0f}; it cuts through itself"
        raise AssetError(f"{mesh.metadata['name']}: cannot be signed: {why}, or a part is inside out")


def sample_surface(mesh: Trimesh, count: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Random points [count, 3] m, uniform by area, with their face normals [count, 3]."""
    points, face = trimesh.sample.sample_surface(mesh, count, seed=rng)
    return np.asarray(points), np.asarray(mesh.face_normals)[face]


def _merged(mesh: Trimesh) -> Trimesh:
    """The mesh with vertices at one place made one, and without triangles that vanish by it."""
    mesh.merge_vertices(digits_vertex=round(-np.log10(_SAME * mesh.extents.max())))
    mesh.update_faces((np.diff(np.sort(mesh.faces, axis=1), axis=1) > 0).all(1))
    return mesh


def _check_closed(mesh: Trimesh, size: float) -> None:
    """Every edge joins two triangles that run along it in opposite directions, and the volume is positive."""
    name = mesh.metadata["name"]
    if not mesh.is_watertight:
        count = np.unique(mesh.edges_sorted, axis=0, return_counts=True)[1]
        single, many = np.sum(count == 1), np.sum(count > 2)
        what = f"open: {single} edges have one triangle" if single else "non-manifold"
        more = f"{'; ' if single else ': '}{many} edges have more than two" if many else ""
        raise AssetError(f"{name}: the surface is {what}{more} (ObjectConfig.mesh_repair closes it: shell or hull)")
    if not mesh.is_winding_consistent:
        raise AssetError(f"{name}: normals point both ways; trimesh.repair.fix_winding makes them agree")
    if mesh.volume < 1e-6 * size**3:
        wrong = "it is flat, or its normals point inward: mesh.invert() turns it"
        raise AssetError(f"{name}: encloses {mesh.volume:.3g} m^3 for a size of {size:.3g} m; {wrong}")


def _hull(mesh: Trimesh) -> Trimesh:
    # Nearly coplanar corners would leave slits between a hull's triangles.
    used = mesh.vertices[mesh.faces.ravel()]
    grid = 1e-4 * np.ptp(used, axis=0).max()
    return trimesh.convex.convex_hull(np.unique(np.round(used / grid), axis=0) * grid)


def _shell(mesh: Trimesh) -> Trimesh:
    """A closed surface round another one: all that cannot be reached from outside through gaps of less than two cells
    is inside. It is the boundary of cells, pulled to the surface."""
    points = _points_on(mesh)
    cell = np.ptp(points, axis=0).max() / _CELLS
    low = points.min(0) - 3 * cell
    count = np.ceil((points.max(0) + 3 * cell - low) / cell).astype(int)
    middles = low + cell * (np.indices(count).reshape(3, -1).T + 0.5)
    tree = cKDTree(points)
    solid = binary_fill_holes(tree.query(middles, distance_upper_bound=cell)[0].reshape(count) <= cell)
    _fill_diagonals(solid)
    boundary = trimesh.voxel.ops.multibox(np.argwhere(solid), remove_internal_faces=True)
    corners = low + cell * (boundary.vertices + 0.5)
    nearest = points[tree.query(corners)[1]]
    boundary.vertices = nearest + _CLOSE * (corners - nearest)
    return boundary


def _fill_diagonals(solid: np.ndarray) -> None:
    """Fill cells [X, Y, Z] until no two of them meet in an edge alone, where four faces would meet."""
    changed = True
    while changed:
        changed = False
        for axis in range(3):
            view = np.moveaxis(solid, axis, 2)
            a, b, c, d = view[:-1, :-1], view[1:, :-1], view[:-1, 1:], view[1:, 1:]
            for full, empty in (((a, d), (b, c)), ((b, c), (a, d))):
                bad = full[0] & full[1] & ~empty[0] & ~empty[1]
                changed |= bool(bad.any())
                empty[0][bad] = True


def _points_on(mesh: Trimesh) -> np.ndarray:
    """Random points on a surface, and its corners."""
    points, _ = sample_surface(mesh, _SAMPLES, np.random.default_rng(0))
    return np.concatenate([points, mesh.vertices])
