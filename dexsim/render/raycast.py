"""Pictures of posed primitives by ray casting in NumPy: no OpenGL, no display, the same picture on every machine.

Every pixel's ray is intersected in closed form with each primitive inside that primitive's bounding box on the screen.
In a primitive's own frame the ray of pixel (x, y) is affine in x and y, which makes a primitive a handful of array
operations. Sizes are those of `dexsim.geometry.sdf`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

FAR = np.float32(1e6)  # m, the depth of a pixel that nothing covers


@dataclass(frozen=True, kw_only=True)
class Camera:
    """A pinhole camera that looks at a point of the palm frame."""

    azimuth: float = 0.0
    """Turn about `up` [deg], right-handed; 0 looks from +z (from +x where `up` is along z)."""
    elevation: float = 20.0
    """Height of the camera over the plane across `up` [deg]."""
    distance: float = 0.5
    """From the target to the camera [m]."""
    target: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """The point in the middle of the picture [m], palm frame."""
    up: tuple[float, float, float] = (-1.0, 0.0, 0.0)
    """Against gravity. (-1, 0, 0) is a hand held palm down, (1, 0, 0) palm up."""
    field_of_view: float = 30.0
    """Vertical opening angle [deg]."""


class CameraView(NamedTuple):
    """A camera ready for a picture of one size."""

    origin: np.ndarray  # [3], m
    axes: np.ndarray  # [3, 3], rows right, up, back
    scale: float  # pixels per unit slope
    size: tuple[int, int]  # width, height; the optical axis is in the middle


class Primitives(NamedTuple):
    """G posed primitives in one frame."""

    kind: tuple[str, ...]  # G
    size: np.ndarray  # [G, 3], m
    position: np.ndarray  # [G, 3], m
    rotation: np.ndarray  # [G, 3, 3]
    color: np.ndarray  # [G, 3], linear RGB
    sides: np.ndarray | None = None  # [6, 3], of boxes' sides +x, -x, +y, -y, +z, -z; None: as `color`


@dataclass(frozen=True, eq=False)
class VisibleSurface:
    """What each pixel of a view sees first. Depth runs along the optical axis."""

    depth: np.ndarray  # [H, W], m, FAR where empty
    index: np.ndarray  # [H, W] int, primitive, -1 where empty


def look(camera: Camera, size: tuple[int, int], supersample: int = 1) -> CameraView:
    """The view of `camera` for a picture of `size` (width, height), with `supersample`² rays a pixel."""
    up = _unit(np.asarray(camera.up, np.float64))
    reference = np.array([0.0, 0.0, 1.0]) if abs(up[2]) < 0.9 else np.array([1.0, 0.0, 0.0])
    forward = _unit(reference - up * (reference @ up))
    azimuth, elevation = np.deg2rad(camera.azimuth), np.deg2rad(camera.elevation)
    level = np.cos(azimuth) * forward + np.sin(azimuth) * np.cross(up, forward)
    back = np.cos(elevation) * level + np.sin(elevation) * up
    # The camera's own up leans back with the elevation; this form also holds when looking straight down.
    upward = np.cos(elevation) * up - np.sin(elevation) * level
    axes = np.stack([np.cross(upward, back), upward, back])
    width, height = size[0] * supersample, size[1] * supersample
    scale = height / 2 / np.tan(np.deg2rad(camera.field_of_view) / 2)
    origin = np.asarray(camera.target, np.float64) + camera.distance * back
    return CameraView(origin, axes, float(scale), (width, height))


def project(view: CameraView, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pixels [..., 2] and depths [...] of points [..., 3]; pixel (i, j) covers [i, i+1) x [j, j+1), y down."""
    local = (np.asarray(points) - view.origin) @ view.axes.T
    depth = -local[..., 2]
    scale = view.scale / np.maximum(depth, 1e-6)
    width, height = view.size
    return np.stack([width / 2 + local[..., 0] * scale, height / 2 - local[..., 1] * scale], -1), depth


def cast(primitives: Primitives, view: CameraView) -> VisibleSurface:
    """The nearest primitive along every ray of the view."""
    depth = np.full(view.size[::-1], FAR, np.float32)
    index = np.full(view.size[::-1], -1, np.int32)
    for g, (kind, box) in enumerate(zip(primitives.kind, screen_boxes(view, primitives), strict=True)):
        x0, x1, y0, y1 = box
        if x0 >= x1 or y0 >= y1:
            continue
        origin, ray = _local_rays(view, primitives, g, box)
        with np.errstate(divide="ignore", invalid="ignore"):
            hit = _INTERSECT[kind](origin, ray, primitives.size[g].astype(np.float32))
        window = depth[y0:y1, x0:x1]
        nearer = (hit < window) & (hit > 1e-3)
        np.copyto(window, hit, where=nearer)
        np.copyto(index[y0:y1, x0:x1], g, where=nearer)
    return VisibleSurface(depth, index)


def hit_points(view: CameraView, row: np.ndarray, column: np.ndarray, depth: np.ndarray) -> np.ndarray:
    """The points [M, 3] m that pixels [M] see at depths [M] m."""
    width, height = view.size
    ray = np.empty((len(row), 3), np.float32)
    ray[:, 0] = (column + (0.5 - width / 2)) / view.scale
    ray[:, 1] = (height / 2 - 0.5 - row) / view.scale
    ray[:, 2] = -1.0
    return (depth[:, None] * ray) @ view.axes.astype(np.float32) + view.origin.astype(np.float32)


def normals(primitives: Primitives, index: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Outward unit normals [M, 3] at points [M, 3] of primitives [M]; edges of boxes and cylinders look rounded."""
    result = np.empty_like(points)
    order = np.argsort(index, kind="stable")
    edges = np.searchsorted(index[order], np.arange(len(primitives.kind) + 1))
    for g in np.unique(index):
        members = order[edges[g] : edges[g + 1]]
        turn, size = (part[g].astype(np.float32) for part in (primitives.rotation, primitives.size))
        local = (points[members] - primitives.position[g].astype(np.float32)) @ turn
        result[members] = _local_normal(primitives.kind[g], local, size) @ turn.T
    return result / np.maximum(np.sqrt(np.einsum("mi,mi->m", result, result)), np.float32(1e-9))[:, None]


def _local_normal(kind: str, p: np.ndarray, size: np.ndarray) -> np.ndarray:
    """How points [M, 3] of a primitive of this kind stand out from its core, in its own frame."""
    if kind == "ellipsoid":
        return p / size**2
    if kind == "box":
        return p - np.clip(p, -0.9 * size, 0.9 * size)
    core, half = np.zeros_like(p), size[1]
    if kind == "capsule":
        core[:, 2] = np.clip(p[:, 2], -half, half)
    if kind == "cylinder":
        core[:, :2] = p[:, :2] * np.minimum(1.0, 0.9 * size[0] / np.hypot(p[:, 0], p[:, 1]))[:, None]
        core[:, 2] = np.clip(p[:, 2], -0.9 * half, 0.9 * half)
    return p - core


def screen_boxes(view: CameraView, primitives: Primitives) -> np.ndarray:
    """Pixel windows [G, 4] (x0, x1, y0, y1) that certainly hold the primitives; empty outside the picture."""
    size = primitives.size
    reach = {
        "sphere": size[:, 0],
        "ellipsoid": size.max(-1, initial=0.0),
        "capsule": size[:, 0] + size[:, 1],
        "cylinder": np.hypot(size[:, 0], size[:, 1]),
        "box": np.linalg.norm(size, axis=-1),
    }
    radius = np.array([reach[kind][g] for g, kind in enumerate(primitives.kind)])
    local = (primitives.position - view.origin) @ view.axes.T
    # Of a cube along the camera's axes: a point between its corners projects between theirs.
    corners = local[:, None] + radius[:, None, None] * np.array([[x, x, z] for x in (-1, 1) for z in (-1, 1)])
    nearest = -corners[..., 2].max(1)
    slope = corners[..., :2] / np.maximum(-corners[..., 2:], 1e-3)
    limit = np.array(view.size)
    low, high = slope.min(1) * view.scale, slope.max(1) * view.scale
    x0, x1 = low[:, 0] + limit[0] / 2, high[:, 0] + limit[0] / 2
    y0, y1 = limit[1] / 2 - high[:, 1], limit[1] / 2 - low[:, 1]
    boxes = np.stack([np.floor(x0), np.ceil(x1), np.floor(y0), np.ceil(y1)], -1)
    boxes = np.clip(boxes, 0, limit.repeat(2)).astype(int)
    boxes[nearest <= 1e-3] = [0, limit[0], 0, limit[1]]  # reaches behind the camera: no bound is safe
    return boxes


def _local_rays(
    view: CameraView, primitives: Primitives, g: int, box: tuple[int, int, int, int]
) -> tuple[tuple, tuple]:
    """Origin (three numbers) and direction (three arrays [h, w]) of each ray in the frame of primitive g."""
    x0, x1, y0, y1 = box
    width, height = view.size
    x = ((np.arange(x0, x1) + 0.5 - width / 2) / view.scale).astype(np.float32)
    y = ((height / 2 - 0.5 - np.arange(y0, y1)) / view.scale).astype(np.float32)
    turn = (view.axes @ primitives.rotation[g]).astype(np.float32)  # camera axes in the primitive's frame
    start = ((view.origin - primitives.position[g]) @ primitives.rotation[g]).astype(np.float32)
    return tuple(start), tuple((x * turn[0, k] - turn[2, k])[None, :] + (y * turn[1, k])[:, None] for k in range(3))


# Each takes a ray o + t d in the primitive's frame and returns the first t; where the ray misses, NaN (the root of a
# negative number), which compares as not nearer.


def _ball(o, d, radius):
    a = d[0] * d[0] + d[1] * d[1] + d[2] * d[2]
    b = o[0] * d[0] + o[1] * d[1] + o[2] * d[2]
    c = o[0] * o[0] + o[1] * o[1] + o[2] * o[2] - radius * radius
    return -(b + np.sqrt(b * b - a * c)) / a


def _sphere(o, d, size):
    return _ball(o, d, size[0])


def _ellipsoid(o, d, size):
    return _ball(tuple(o[k] / size[k] for k in range(3)), tuple(d[k] / size[k] for k in range(3)), np.float32(1))


def _tube(o, d, radius):
    """Coefficients a, b, c of a t² + 2 b t + c = 0, where the ray crosses the endless cylinder about z."""
    a = np.maximum(d[0] * d[0] + d[1] * d[1], np.float32(1e-12))
    return a, o[0] * d[0] + o[1] * d[1], o[0] * o[0] + o[1] * o[1] - radius * radius


def _capsule(o, d, size):
    half = size[1]
    a, b, c = _tube(o, d, size[0])
    enter = -(b + np.sqrt(b * b - a * c)) / a
    z = o[2] + enter * d[2]
    # Beyond the straight part the ray can only meet the cap on that side.
    rise = o[2] - np.where(z > 0, half, -half)
    a, b, c = a + d[2] * d[2], b + rise * d[2], c + rise * rise
    return np.where(np.abs(z) <= half, enter, -(b + np.sqrt(b * b - a * c)) / a)


def _slab(o, d, half):
    inverse = np.float32(1) / (d + np.float32(1e-12))  # a ray along the slab must not divide by zero
    middle, reach = -o * inverse, np.abs(half * inverse)
    return middle - reach, middle + reach


def _cylinder(o, d, size):
    a, b, c = _tube(o, d, size[0])
    root, caps = np.sqrt(b * b - a * c), _slab(o[2], d[2], size[1])
    enter, leave = np.maximum(-(b + root) / a, caps[0]), np.minimum((root - b) / a, caps[1])
    return np.where(enter <= leave, enter, FAR)


def _box(o, d, size):
    slabs = [_slab(o[k], d[k], size[k]) for k in range(3)]
    enter = np.maximum(np.maximum(slabs[0][0], slabs[1][0]), slabs[2][0])
    leave = np.minimum(np.minimum(slabs[0][1], slabs[1][1]), slabs[2][1])
    return np.where(enter <= leave, enter, FAR)


_INTERSECT = {"sphere": _sphere, "ellipsoid": _ellipsoid, "capsule": _capsule, "cylinder": _cylinder, "box": _box}


def _unit(vector: np.ndarray) -> np.ndarray:
    return vector / np.linalg.norm(vector)
