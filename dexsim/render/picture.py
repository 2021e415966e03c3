"""The picture of a posed hand, its taxels and the object: shading on top of `dexsim.render.raycast`."""

from __future__ import annotations

from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from dexsim.hand.kinematics import Hand
from dexsim.render.colors import FACES, LINK, OBJECT, PALM, TIP, linear
from dexsim.render.panel import force_color
from dexsim.render.raycast import (
    Camera,
    CameraView,
    Primitives,
    VisibleSurface,
    cast,
    crop,
    length,
    look,
    normals,
    project,
    samples,
)

_SUPERSAMPLE = 2
_TAXEL_BIAS = 0.0025  # m; the pads follow the taxel lattice to within 1 mm, and no taxel may drown in its pad
_OBJECT_OPACITY = 0.62  # so that fingers behind the object stay visible
_GOAL_OPACITY, _GOAL_SCALE, _GOAL_AT = 0.9, 0.45, np.array([-0.066, 0.088])  # m to the right and up of the middle
_TAXEL_GLOW = 0.6  # how strongly a loaded taxel shows through the object
_SHADOW_PIXELS = 256

# Linear RGB.
_PALM, _LINK, _TIP, _OBJECT = (linear(color) for color in (PALM, LINK, TIP, OBJECT))
_SIDES = np.array([linear(color) for color in FACES], np.float32)
_IDLE_TAXEL = (0.12, 0.13, 0.15)
_SKY, _GROUND, _KEY = (0.62, 0.68, 0.78), (0.24, 0.22, 0.2), (1.75, 1.68, 1.55)
_BACKDROP = (0.040, 0.047, 0.060), (0.012, 0.014, 0.019)  # middle, corners


class Pose(NamedTuple):
    """Where the hand's parts are, NumPy."""

    body_position: np.ndarray  # [B, 3] m
    body_rotation: np.ndarray  # [B, 3, 3]
    taxel_position: np.ndarray  # [F, N, 3] m
    taxel_normal: np.ndarray  # [F, N, 3]


class Light(NamedTuple):
    """The key light, and what it sees."""

    direction: np.ndarray  # [3], toward the light
    up: np.ndarray  # [3]
    view: CameraView  # orthographic, from the light
    depth: np.ndarray  # [S, S] m


def draw_scene(
    hand: Hand,
    kinds: tuple[str, ...],
    frame: Any,
    pose: Pose,
    camera: Camera,
    size: tuple[int, int],
    force_range: float,
) -> np.ndarray:
    """uint8 [H, W, 3] of one `Snapshot`; taxels are coloured from 0 to `force_range` [N]."""
    full = look(camera, size, _SUPERSAMPLE)
    body, held = hand_primitives(hand, pose), object_primitives(kinds, frame)
    plain = hand_primitives(hand, pose, rounded=False)
    goal = goal_primitives(held, frame, camera)
    everything = _together(plain, held)
    view, window = crop(full, _together(everything, goal), _SUPERSAMPLE)
    rows, columns = (slice(part.start // _SUPERSAMPLE, part.stop // _SUPERSAMPLE) for part in window)
    light = _key_light(everything, len(plain.kind), view, camera.up)

    color = _backdrop(size)[:, rows, columns].reshape(3, -1)
    surface = cast(body, view)
    _paint(color, body, surface, view, light, bevel=1e-4)
    pixel, rays, loaded = _taxel_rays(surface, view, pose, frame.taxel_force, force_range)
    _blend(color, pixel, rays, 1.0)
    front = cast(held, view)
    front.index[front.depth > surface.depth] = -1
    _paint(color, held, front, view, light, bevel=0.003, opacity=_OBJECT_OPACITY)
    # The taxels in contact are between finger and object: draw the loaded ones through the object.
    _blend(color, pixel[loaded], rays[loaded], _TAXEL_GLOW)
    marker = cast(goal, view)
    marker.index[marker.depth > np.minimum(surface.depth, front.depth)] = -1
    _paint(color, goal, marker, view, light, bevel=0.001, opacity=_GOAL_OPACITY)

    picture = _developed_backdrop(size).copy()
    picture[rows, columns] = _develop(color.reshape(3, rows.stop - rows.start, columns.stop - columns.start))
    return picture


def hand_primitives(hand: Hand, pose: Pose, rounded: bool = True) -> Primitives:
    """The hand's geoms, posed; the palm, the links and the fingertips in three tones. `rounded` breaks box edges."""
    local, rows = _hand_parts(hand, rounded)
    turn = pose.body_rotation[rows]
    position = pose.body_position[rows] + np.einsum("gij,gj->gi", turn, local.position)
    return local._replace(position=position, rotation=turn @ local.rotation)


def object_primitives(kinds: tuple[str, ...], frame: Any) -> Primitives:
    """The object's active primitives, posed in the palm frame."""
    active = np.flatnonzero(frame.primitive_active)
    position = frame.object_position + frame.primitive_position[active] @ frame.object_rotation.T
    rotation = frame.object_rotation @ frame.primitive_rotation[active]
    color = np.tile(np.array(_OBJECT, np.float32), (len(active), 1))
    kind = tuple(kinds[k] for k in active)
    return Primitives(
        kind, frame.primitive_size[active], position, rotation, color, _SIDES if kind == ("box",) else None
    )


def goal_position(camera: Camera) -> np.ndarray:
    """Where [3] m the goal is shown: in the upper left of the picture, beside the hand."""
    return np.asarray(camera.target) + _GOAL_AT @ look(camera, (2, 2)).axes[:2]


def goal_primitives(held: Primitives, frame: Any, camera: Camera) -> Primitives:
    """The object again, smaller and in its goal orientation; nothing for a task without one."""
    if frame.goal_rotation is None:
        return Primitives((), *(part[:0] for part in held[1:5]))
    turn = frame.goal_rotation @ frame.object_rotation.T
    position = goal_position(camera) + _GOAL_SCALE * (held.position - frame.object_position) @ turn.T
    return held._replace(size=_GOAL_SCALE * held.size, position=position, rotation=turn @ held.rotation)


def _together(first: Primitives, second: Primitives) -> Primitives:
    """Both, in one colour each: for shadows and bounds."""
    parts = (np.concatenate(pair) for pair in zip(first[1:5], second[1:5], strict=True))
    return Primitives(first.kind + second.kind, *parts)


@lru_cache(maxsize=4)
def _hand_parts(hand: Hand, rounded: bool) -> tuple[Primitives, np.ndarray]:
    """The hand's primitives in their links' frames, and the link of each."""
    tips = set(np.asarray(hand.tip_body).tolist())
    parts = []
    for geom in hand.geoms:
        tone = _TIP if geom.body in tips else _PALM if geom.body == 0 else _LINK
        pieces = [(geom.kind, geom.size, np.zeros(3), np.eye(3))]
        if geom.kind == "box" and rounded:
            pieces = _rounded_box(geom.size, 0.2 * float(min(geom.size)))
        for kind, size, position, rotation in pieces if geom.kind != "plane" else ():
            parts.append(
                (kind, size, geom.position + geom.rotation @ position, geom.rotation @ rotation, tone, geom.body)
            )
    kind, size, position, rotation, tone, rows = zip(*parts, strict=True)
    return Primitives(kind, *(np.asarray(x, np.float32) for x in (size, position, rotation, tone))), np.asarray(rows)


def _rounded_box(half: np.ndarray, radius: float) -> list[tuple]:
    """A box with round edges as three boxes and twelve capsules: (kind, size, position, rotation) of each."""
    core = np.asarray(half) - radius
    pieces = [("box", core + radius * np.eye(3)[axis], np.zeros(3), np.eye(3)) for axis in range(3)]
    for axis in range(3):
        u, v = (axis + 1) % 3, (axis + 2) % 3
        along = np.eye(3)[:, [u, v, axis]]  # turns z into this axis
        for signs in ((-1, -1), (-1, 1), (1, -1), (1, 1)):
            position = np.zeros(3)
            position[[u, v]] = core[[u, v]] * signs
            pieces.append(("capsule", np.array([radius, core[axis], 0]), position, along))
    return pieces


def _paint(
    color: np.ndarray,
    primitives: Primitives,
    surface: VisibleSurface,
    view: CameraView,
    light: Light,
    bevel: float,
    opacity: float = 1.0,
) -> None:
    """Shade a surface and lay it over the picture, linear RGB [3, h * w]."""
    hits = samples(view, surface, _SUPERSAMPLE)
    pixel, weight, index, points = hits.pixel, hits.weight, hits.index, hits.points
    normal, toward = normals(primitives, index, points, bevel), _toward(view, points)
    away = 1 - np.clip(_dot(normal, toward), 0, 1)
    # Glass-like: more opaque where the surface turns away, so that the silhouette stays crisp.
    weight = weight * (opacity + (1 - opacity) * away * away)
    keep = 1 - np.bincount(pixel, weight, color.shape[1]).astype(np.float32)
    shaded = _shade(_tones(primitives, index, normal), points, normal, toward, away, light)
    for plane, values in zip(color, shaded, strict=True):
        plane *= keep
        plane += np.bincount(pixel, weight * values, len(plane)).astype(np.float32)


def _tones(primitives: Primitives, index: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """The colour [3, M] of each sample: its primitive's, or that of the side of a box that its normal is nearest to."""
    if primitives.sides is None or not len(index):
        return np.ascontiguousarray(primitives.color.T)[:, index]
    local = primitives.rotation[0].T.astype(np.float32) @ normal
    axis = np.abs(local).argmax(0)
    return primitives.sides.T[:, 2 * axis + (local[axis, np.arange(len(axis))] < 0)]


def _shade(tones, points, normal, toward, away, light: Light) -> np.ndarray:
    """Linear RGB [3, M]: sky and ground, one warm key light with shadow, a faint highlight and a rim."""
    lit = light.direction @ normal
    day = np.flatnonzero(lit > 0)
    lit = np.maximum(lit, 0)
    lit[day] *= _visible(light, points[:, day], normal[:, day])
    half = toward + light.direction[:, None]
    gloss = np.maximum(_dot(normal, half) / length(half), 0)
    for _ in range(5):  # to the 32nd power
        gloss *= gloss
    height = (light.up @ normal) * np.float32(0.5) + np.float32(0.5)
    shine = np.float32(0.16) * gloss * lit + away * away * away * (np.float32(0.035) + np.float32(0.065) * height)
    color = np.empty_like(points)
    for c in range(3):
        ambient = np.float32(0.75 * _GROUND[c]) + height * np.float32(0.75 * (_SKY[c] - _GROUND[c]))
        color[c] = tones[c] * (ambient + lit * np.float32(_KEY[c])) + shine
    return color


def _taxel_rays(surface: VisibleSurface, view: CameraView, pose: Pose, force: np.ndarray, force_range: float):
    """Every taxel that faces the camera as a disc on the skin, in the colour of its force.

    Returns:
      pixels [M], linear RGB [M, 3], and whether the taxel is loaded [M], of each ray that meets a disc.
    """
    centre, normal = pose.taxel_position.reshape(-1, 3), pose.taxel_normal.reshape(-1, 3)
    pixels, depth = project(view, centre)
    seen = (np.sum(normal * (view.origin - centre), -1) > 0) & (depth > 0.02)
    order = np.flatnonzero(seen)[np.argsort(-depth[seen])]  # the nearest last: the last one written to a ray stays
    pixels, level = pixels[order], force.reshape(-1)[order]
    centre = ((centre[order] - view.origin) @ view.axes.T).astype(np.float32)
    normal = (normal[order] @ view.axes.T).astype(np.float32)
    # A loaded taxel is drawn larger, up to touching its neighbours (pitch 2.3 mm).
    radius = (0.0007 + 0.0007 * np.clip(level / force_range, 0, 1)).astype(np.float32)

    reach = int(np.ceil(radius.max(initial=0) * view.scale / max(depth[order].min(initial=1), 1e-3))) + 1
    offset = np.arange(-reach, reach + 1)
    column = pixels[:, 0].astype(int)[:, None, None] + offset[None, None, :]
    row = pixels[:, 1].astype(int)[:, None, None] + offset[None, :, None]
    x = ((column + 0.5 - view.centre[0]) / view.scale).astype(np.float32)
    y = ((view.centre[1] - 0.5 - row) / view.scale).astype(np.float32)
    c, n = centre[:, None, None], normal[:, None, None]
    slope = n[..., 0] * x + n[..., 1] * y - n[..., 2]
    along = np.sum(c * n, -1) / np.where(np.abs(slope) < 1e-6, np.float32(-1e-6), slope)
    distance2 = (x * along - c[..., 0]) ** 2 + (y * along - c[..., 1]) ** 2 + (-along - c[..., 2]) ** 2
    inside = (column >= 0) & (column < view.size[0]) & (row >= 0) & (row < view.size[1])
    inside &= (distance2 < radius[:, None, None] ** 2) & (along > 0)
    taxel, i, j = np.nonzero(inside)
    row, column, along = row[taxel, i, 0], column[taxel, 0, j], along[taxel, i, j]
    visible = along - np.float32(_TAXEL_BIAS) < surface.depth[row, column]
    row, column, taxel = row[visible], column[visible], taxel[visible]
    last = np.empty(surface.depth.shape, np.int32)
    last[row, column] = taxel
    top = last[row, column] == taxel
    row, column, taxel = row[top], column[top], taxel[top]

    hot = (force_color(level, force_range) / np.float32(255)) ** np.float32(2.2)
    facing = -np.sum(normal * centre, -1) / np.linalg.norm(centre, axis=-1)
    tone = np.where(level[:, None] > 0, hot, np.array(_IDLE_TAXEL, np.float32) * (0.35 + 0.65 * facing[:, None]))
    pixel = (row // _SUPERSAMPLE) * (view.size[0] // _SUPERSAMPLE) + column // _SUPERSAMPLE
    return pixel, tone[taxel].astype(np.float32), level[taxel] > 0


def _blend(color: np.ndarray, pixel: np.ndarray, rays: np.ndarray, opacity: float) -> None:
    """Lay the colours [M, 3] of single rays over the pixels [M] that they belong to."""
    share = opacity / _SUPERSAMPLE**2
    keep = 1 - share * np.bincount(pixel, minlength=color.shape[1])
    for plane, values in zip(color, rays.T, strict=True):
        plane[:] = plane * keep + share * np.bincount(pixel, values, len(plane))


def _key_light(primitives: Primitives, hand: int, view: CameraView, up: tuple[float, float, float]) -> Light:
    """A light over the camera's right shoulder, with a shadow map that fits the first `hand` primitives.

    Fitted to the hand alone, since a lost object may be anywhere.
    """
    upward = np.asarray(up, np.float64)
    light = _unit(0.55 * view.axes[0] + 0.75 * upward + 0.75 * view.axes[2])
    side = _unit(np.cross(light, view.axes[1]))
    axes, half = np.stack([side, np.cross(light, side), light]), _SHADOW_PIXELS / 2
    # No primitive reaches farther from its centre than the length of its size times the root of 2 (a stubby capsule).
    lateral = primitives.position[:hand] @ axes.T
    reach = np.linalg.norm(primitives.size[:hand], axis=-1)[:, None] * 1.4143
    low, high = (lateral - reach).min(0), (lateral + reach).max(0)
    middle, radius = (low + high) / 2 @ axes, float((high - low)[:2].max() / 2)
    above = CameraView(middle + light, axes, half / radius, (half, half), (_SHADOW_PIXELS, _SHADOW_PIXELS), True)
    return Light(light.astype(np.float32), upward.astype(np.float32), above, cast(primitives, above).depth)


def _visible(light: Light, points: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """How much of the key light reaches each point [3, M], 0.1..1; softened over one pixel of its map."""
    view = light.view
    axes = view.axes.astype(np.float32)
    # Lifting the point off its surface keeps it out of its own shadow.
    x, y, z = axes @ (points + normal * np.float32(0.0025)) - (axes @ view.origin.astype(np.float32))[:, None]
    limit, own = np.float32(view.size[0] - 2.001), -z - np.float32(0.0015)
    column = np.clip(x * np.float32(view.scale) + np.float32(view.centre[0] - 0.5), 0, limit)
    row = np.clip(np.float32(view.centre[1] - 0.5) - y * np.float32(view.scale), 0, limit)
    left, top = column.astype(np.int32), row.astype(np.int32)
    at, right, down = top * np.int32(view.size[0]) + left, column - left, row - top
    # Comparing first and interpolating then gives a soft edge without steps.
    free = [(light.depth.reshape(-1)[at + np.int32(step)] > own) for step in (0, 1, view.size[0], view.size[0] + 1)]
    above, below = (
        free[0] + right * (free[1] * np.float32(1) - free[0]),
        free[2] + right * (free[3] * np.float32(1) - free[2]),
    )
    return np.float32(0.1) + np.float32(0.9) * (above + down * (below - above))


@lru_cache(maxsize=4)
def _backdrop(size: tuple[int, int]) -> np.ndarray:
    """A soft vignette, linear RGB [3, H, W]."""
    width, height = size
    x, y = np.meshgrid(np.linspace(-1, 1, width), np.linspace(-1, 1, height))
    edge = np.clip((x**2 + y**2) / 1.6, 0, 1)
    inner, outer = (np.asarray(tone)[:, None, None] for tone in _BACKDROP)
    return (inner + (outer - inner) * edge).astype(np.float32)


@lru_cache(maxsize=4)
def _developed_backdrop(size: tuple[int, int]) -> np.ndarray:
    return _develop(_backdrop(size))


def _develop(color: np.ndarray) -> np.ndarray:
    """Linear light [3, H, W] as sRGB bytes [H, W, 3]."""
    return _tone_table()[np.clip(color * np.float32(4095), 0, 4095).astype(np.int16).transpose(1, 2, 0)]


@lru_cache(maxsize=1)
def _tone_table() -> np.ndarray:
    return (255 * np.linspace(0, 1, 4096) ** (1 / 2.2)).round().astype(np.uint8)


def _toward(view: CameraView, points: np.ndarray) -> np.ndarray:
    """Unit vectors [3, M] from points to the camera."""
    away = view.origin.astype(np.float32)[:, None] - points
    return away / length(away)


def _dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _unit(vector: np.ndarray) -> np.ndarray:
    return vector / np.linalg.norm(vector)
