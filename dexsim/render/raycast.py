"""Pictures of posed primitives by ray casting in NumPy: no OpenGL, no display, the same picture on every machine.

Every pixel's ray is intersected in closed form with each primitive inside that primitive's bounding box on the
screen, so silhouettes and normals are exact and nothing is tessellated. The ray of pixel (x, y) in a primitive's own
frame is affine in x and y, which makes a primitive a handful of array operations. Sizes follow MuJoCo: box
half-extents; capsule and cylinder (radius, half_length, -) along z; sphere (radius, -, -); ellipsoid semi-axes.
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
    """A camera ready for a picture of one size: axes as rows (right, up, back), focal length in pixels."""

    origin: np.ndarray  # [3], m
    axes: np.ndarray  # [3, 3]
    scale: float  # pixels per unit slope (perspective) or per metre (orthographic)
    centre: tuple[float, float]  # pixel of the optical axis
    size: tuple[int, int]  # width, height
    orthographic: bool = False


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


@dataclass(frozen=True, eq=False)
class ShadingSamples:
    """Surface points to shade, those of one primitive together.

    Components are the first axis: NumPy is several times faster on three long rows than on many short triples.
    """

    pixel: np.ndarray  # [M] int, flat number in the picture
    weight: np.ndarray  # [M], share of the pixel
    index: np.ndarray  # [M] int, primitive
    points: np.ndarray  # [3, M], m


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
    return CameraView(origin, axes, float(scale), (width / 2, height / 2), (width, height))


def project(view: CameraView, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pixels [..., 2] and depths [...] of points [..., 3]; pixel (i, j) covers [i, i+1) x [j, j+1), y down."""
    local = (np.asarray(points) - view.origin) @ view.axes.T
    depth = -local[..., 2]
    scale = view.scale if view.orthographic else view.scale / np.maximum(depth, 1e-6)
    return np.stack([view.centre[0] + local[..., 0] * scale, view.centre[1] - local[..., 1] * scale], -1), depth


def cast(primitives: Primitives, view: CameraView) -> VisibleSurface:
    """The nearest primitive along every ray of the view."""
    width, height = view.size
    depth = np.full((height, width), FAR, np.float32)
    index = np.full((height, width), -1, np.int16)
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
        np.copyto(index[y0:y1, x0:x1], np.int16(g), where=nearer)
    return VisibleSurface(depth, index)


def samples(view: CameraView, surface: VisibleSurface, n: int) -> ShadingSamples:
    """Where to shade a surface cast with n x n rays a pixel: once a pixel inside a primitive, once a ray at an edge."""
    indices = [surface.index[i::n, j::n] for i in range(n) for j in range(n)]
    depths = [surface.depth[i::n, j::n] for i in range(n) for j in range(n)]
    inside = indices[0] >= 0
    for other in indices[1:]:
        inside &= other == indices[0]
    pixels = [np.flatnonzero(inside)]
    parts = [indices[0].reshape(-1)[pixels[0]]]
    ways = [np.asarray(sum(x.reshape(-1)[pixels[0]] for x in depths)) * np.float32(1 / n**2)]
    shift = [(0.5 * n, 0.5 * n)]
    for k, (some, far) in enumerate(zip(indices, depths, strict=True)):
        pixels.append(np.flatnonzero((some >= 0) & ~inside))
        parts.append(some.reshape(-1)[pixels[-1]])
        ways.append(far.reshape(-1)[pixels[-1]])
        shift.append((k % n + 0.5, k // n + 0.5))
    counts = [len(part) for part in pixels]
    index = np.concatenate(parts)
    order = np.argsort(index, kind="stable")
    pixel, depth = np.concatenate(pixels)[order].astype(np.int32), np.concatenate(ways)[order]
    dx, dy = (np.repeat(np.array(values, np.float32), counts)[order] for values in zip(*shift, strict=True))
    weight = np.repeat(np.array([1] + [1 / n**2] * n**2, np.float32), counts)[order]
    row, column = np.divmod(pixel, np.int32(view.size[0] // n))
    slope = np.float32(1 / view.scale) if view.orthographic else depth * np.float32(1 / view.scale)
    x = (column * np.float32(n) + dx - np.float32(view.centre[0])) * slope
    y = (np.float32(view.centre[1]) - row * np.float32(n) - dy) * slope
    points = view.axes.T.astype(np.float32) @ np.stack([x, y, -depth]) + view.origin.astype(np.float32)[:, None]
    return ShadingSamples(pixel, weight, index[order], points)


def normals(primitives: Primitives, index: np.ndarray, points: np.ndarray, bevel: float = 0.003) -> np.ndarray:
    """Outward unit normals [3, M] at points [3, M] of primitives [M], sorted as in `ShadingSamples`.

    Edges of boxes and cylinders are shaded as if rounded by `bevel` [m].
    """
    result = np.empty_like(points)
    edges = np.searchsorted(index, np.arange(len(primitives.kind) + 1))
    for g, kind in enumerate(primitives.kind):
        members = slice(edges[g], edges[g + 1])
        rotation = primitives.rotation[g].astype(np.float32)
        local = rotation.T @ (points[:, members] - primitives.position[g].astype(np.float32)[:, None])
        size = primitives.size[g].astype(np.float32)
        result[:, members] = rotation @ _local_normal(kind, local, size, np.float32(bevel))
    return result / np.maximum(length(result), np.float32(1e-9))


def length(vectors: np.ndarray) -> np.ndarray:
    """Lengths [M] of vectors [3, M]."""
    return np.sqrt(vectors[0] * vectors[0] + vectors[1] * vectors[1] + vectors[2] * vectors[2])


def _local_normal(kind: str, p: np.ndarray, size: np.ndarray, bevel: np.float32) -> np.ndarray:
    if kind == "sphere":
        return p
    if kind == "ellipsoid":
        return p / (size * size)[:, None]
    if kind == "capsule":
        return np.stack([p[0], p[1], p[2] - np.clip(p[2], -size[1], size[1])])
    if kind == "box":
        core = np.maximum(size - bevel, 0.5 * size)[:, None]
        return p - np.clip(p, -core, core)
    radius, half = (size[0], size[1])  # cylinder: the bevelled edge lies between its side and its caps
    core_r, core_z = max(radius - bevel, 0.5 * radius), max(half - bevel, 0.5 * half)
    outward = 1 - np.minimum(1, core_r / np.maximum(np.hypot(p[0], p[1]), np.float32(1e-9)))
    return np.stack([p[0] * outward, p[1] * outward, p[2] - np.clip(p[2], -core_z, core_z)])


def screen_boxes(view: CameraView, primitives: Primitives) -> np.ndarray:
    """Pixel windows [G, 4] (x0, x1, y0, y1) that certainly hold the primitives; empty outside the picture."""
    points = np.empty((len(primitives.kind), 16, 3))
    for g, (kind, (a, b, c), turn) in enumerate(
        zip(primitives.kind, primitives.size, primitives.rotation, strict=True)
    ):
        if kind in ("sphere", "capsule"):  # a cube along the camera's axes about each end is tighter than a turned box
            end = b * turn[:, 2] if kind == "capsule" else np.zeros(3)
            points[g, :8] = a * (_CORNERS @ view.axes) + end
            points[g, 8:] = points[g, :8] - 2 * end
        else:
            points[g, :8] = points[g, 8:] = _CORNERS * ((a, a, b) if kind == "cylinder" else (a, b, c)) @ turn.T
    pixels, depth = project(view, points + primitives.position[:, None])
    limit = np.array(view.size)
    low = np.clip(np.floor(np.nan_to_num(pixels.min(1), nan=0)), 0, limit).astype(int)
    high = np.clip(np.ceil(np.nan_to_num(pixels.max(1), nan=0)), 0, limit).astype(int)
    if not view.orthographic:
        around = (depth.min(1) <= 1e-3) & (depth.max(1) > 0)  # reaches behind the camera: no bound is safe
        low[around], high[around] = 0, limit
        high[depth.max(1) <= 0] = 0
    return np.stack([low[:, 0], high[:, 0], low[:, 1], high[:, 1]], -1)


def crop(view: CameraView, primitives: Primitives, multiple: int) -> tuple[CameraView, tuple[slice, slice]]:
    """The part of the view that holds the primitives, on multiples of `multiple` pixels, and its (rows, columns)."""
    boxes = screen_boxes(view, primitives)
    boxes = boxes[(boxes[:, 0] < boxes[:, 1]) & (boxes[:, 2] < boxes[:, 3])]
    if len(boxes) == 0:
        boxes = np.zeros((1, 4), int)
    x0, y0 = boxes[:, [0, 2]].min(0) // multiple * multiple
    x1, y1 = -(-boxes[:, [1, 3]].max(0) // multiple) * multiple
    centre = (view.centre[0] - x0, view.centre[1] - y0)
    return view._replace(centre=centre, size=(int(x1 - x0), int(y1 - y0))), (slice(y0, y1), slice(x0, x1))


def _local_rays(
    view: CameraView, primitives: Primitives, g: int, box: tuple[int, int, int, int]
) -> tuple[tuple, tuple]:
    """Origin and direction of each ray in the frame of primitive g, three components each (scalar or [h, w])."""
    x0, x1, y0, y1 = box
    x = (np.arange(x0, x1, dtype=np.float32) + np.float32(0.5 - view.centre[0])) / np.float32(view.scale)
    y = (np.float32(view.centre[1] - 0.5) - np.arange(y0, y1, dtype=np.float32)) / np.float32(view.scale)
    turn = (view.axes @ primitives.rotation[g]).astype(np.float32)  # camera axes in the primitive's frame
    start = ((view.origin - primitives.position[g]) @ primitives.rotation[g]).astype(np.float32)
    base = start if view.orthographic else -turn[2]
    sweep = tuple((x * turn[0, k] + base[k])[None, :] + (y * turn[1, k])[:, None] for k in range(3))
    return (sweep, tuple(-turn[2])) if view.orthographic else (tuple(start), sweep)


# Each of these takes a ray o + t d in the primitive's frame and returns the first t. Where the ray misses they return
# NaN (the root of a negative number), which compares as not nearer.


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
_CORNERS = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], np.float64)


def _unit(vector: np.ndarray) -> np.ndarray:
    return vector / np.linalg.norm(vector)
