"""The picture of a posed hand, its taxels and the object, by MuJoCo's ray caster: no OpenGL, no display, and the same
picture on every machine."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import mujoco
import numpy as np

from dexsim.hand.description import Geom, Hand, unit
from dexsim.hand.mjcf import Pose, quaternion
from dexsim.render.panel import force_color

# Of hand, object and goal, in the live view too: sRGB bytes.
Color = tuple[int, int, int]

PALM: Color = (62, 66, 72)
LINK: Color = (172, 176, 182)
TIP: Color = (58, 98, 92)
OBJECT: Color = (52, 128, 172)
FACES: tuple[Color, ...] = (
    (230, 159, 0),
    (86, 180, 233),
    (0, 158, 115),
    (240, 228, 66),
    (0, 114, 178),
    (204, 121, 167),
)
"""Sides of a box, +x, -x, +y, -y, +z, -z: told apart also by eyes that see fewer colours (Okabe and Ito)."""

_SUPERSAMPLE = 2  # rays a pixel, in each direction
_FAR = 1e6  # m, the depth of a ray that hits nothing
_TAXEL_LIFT = 0.001  # m; the pads follow the taxel lattice to within 1 mm, and no taxel may drown in its pad
_TAXEL_RADIUS = 0.0007  # m; twice that under full load, up to touching its neighbours
_OBJECT_OPACITY = 0.62  # so that fingers behind the object stay visible
_TAXEL_GLOW = 0.6  # how strongly a loaded taxel shows through the object
_ROUNDED = 0.7  # radius of a box's edges over its least half size
_GOAL_OPACITY, _GOAL_SCALE, _GOAL_AT = 0.9, 0.45, np.array([-0.066, 0.088])  # m to the right and up of the middle

# Linear RGB.
_IDLE_TAXEL = (0.08, 0.09, 0.1)
_SKY, _GROUND, _KEY = np.array([[0.46, 0.51, 0.58], [0.18, 0.16, 0.15], [1.5, 1.44, 1.33]])
_BACKDROP = (0.034, 0.040, 0.051)
_TILES = np.array([[0.052, 0.058, 0.068], [0.066, 0.073, 0.084]])  # of the floor, 5 cm wide
FIELD_OF_VIEW = 30.0  # deg, vertical
FLOOR = 0.13  # m below the point that the camera looks at
_HORIZON, _SHADE = 1.2, 0.75  # m, at which the floor has faded to 1/e; depth of the shadow


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


class CameraView(NamedTuple):
    """A camera ready for a picture of one size."""

    origin: np.ndarray  # [3], m
    axes: np.ndarray  # [3, 3], rows right, up, back
    scale: float  # pixels per unit slope
    size: tuple[int, int]  # width, height; the optical axis is in the middle

    def rays(self) -> np.ndarray:
        """Directions [H, W, 3] through the pixels' middles, of length one along the optical axis."""
        width, height = self.size
        x = (np.arange(width) + 0.5 - width / 2) / self.scale
        y = (height / 2 - 0.5 - np.arange(height)) / self.scale
        return x[None, :, None] * self.axes[0] + y[:, None, None] * self.axes[1] - self.axes[2]

    def project(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Pixels [..., 2] and depths [...] of points [..., 3]; pixel (i, j) covers [i, i+1) x [j, j+1), y down."""
        local = (np.asarray(points) - self.origin) @ self.axes.T
        depth = -local[..., 2]
        scale = self.scale / np.maximum(depth, 1e-6)
        width, height = self.size
        return np.stack([width / 2 + local[..., 0] * scale, height / 2 - local[..., 1] * scale], -1), depth


def look(camera: Camera, size: tuple[int, int], supersample: int = 1) -> CameraView:
    """The view of `camera` for a picture of `size` (width, height), with `supersample`² rays a pixel."""
    up = unit(np.asarray(camera.up, np.float64))
    reference = np.array([0.0, 0.0, 1.0]) if abs(up[2]) < 0.9 else np.array([1.0, 0.0, 0.0])
    forward = unit(reference - up * (reference @ up))
    azimuth, elevation = np.deg2rad(camera.azimuth), np.deg2rad(camera.elevation)
    level = np.cos(azimuth) * forward + np.sin(azimuth) * np.cross(up, forward)
    back = np.cos(elevation) * level + np.sin(elevation) * up
    # The camera's own up leans back with the elevation; this form also holds when looking straight down.
    upward = np.cos(elevation) * up - np.sin(elevation) * level
    axes = np.stack([np.cross(upward, back), upward, back])
    width, height = size[0] * supersample, size[1] * supersample
    scale = height / 2 / np.tan(np.deg2rad(FIELD_OF_VIEW) / 2)
    origin = np.asarray(camera.target, np.float64) + camera.distance * back
    return CameraView(origin, axes, float(scale), (width, height))


class Primitives(NamedTuple):
    """G posed primitives in the palm frame; sizes are MuJoCo's."""

    kind: tuple[str, ...]  # G
    size: np.ndarray  # [G, 3], m
    position: np.ndarray  # [G, 3], m
    rotation: np.ndarray  # [G, 3, 3]
    color: np.ndarray  # [G, 6, 3], linear RGB of what faces +x, -x, +y, -y, +z, -z


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
    canvas = Canvas(camera, size)
    body, held = hand_primitives(hand, pose), object_primitives(kinds, frame)
    canvas.paint_floor(np.concatenate([body.position, held.position]))
    links, front = canvas.cast(body), canvas.cast(held)
    depth = links[0]
    canvas.paint(body, links, depth < _FAR)
    canvas.paint_taxels(pose, frame.taxel_force, force_range, depth)
    canvas.paint(held, front, front[0] < depth, _OBJECT_OPACITY)
    # The taxels in contact are between finger and object: draw the loaded ones through the object.
    canvas.paint_taxels(pose, frame.taxel_force, force_range, depth, _TAXEL_GLOW)
    if frame.goal_rotation is not None:
        # The object again, smaller and in its goal orientation.
        turn = frame.goal_rotation @ frame.object_rotation.T
        position = goal_position(camera) + _GOAL_SCALE * (held.position - frame.object_position) @ turn.T
        goal = held._replace(size=_GOAL_SCALE * held.size, position=position, rotation=turn @ held.rotation)
        marker = canvas.cast(goal)
        canvas.paint(goal, marker, marker[0] < np.minimum(depth, front[0]), _GOAL_OPACITY)
    return canvas.develop()


def hand_primitives(hand: Hand, pose: Pose) -> Primitives:
    """The hand's geoms, posed; the palm, the links and the fingertips in three tones."""
    geoms = list(drawn_geoms(hand))
    body = np.array([geom.body for geom in geoms])
    turn = pose.body_rotation[body]
    position = np.einsum("gij,gj->gi", turn, [geom.position for geom in geoms])
    tones = [TIP if geom.body in hand.tip_body else PALM if geom.body == 0 else LINK for geom in geoms]
    return Primitives(
        tuple(geom.kind for geom in geoms),
        np.array([geom.size for geom in geoms]),
        pose.body_position[body] + position,
        turn @ np.array([geom.rotation for geom in geoms]),
        (np.array([[tone] * 6 for tone in tones]) / 255) ** 2.2,
    )


def drawn_geoms(hand: Hand) -> Iterator[Geom]:
    """The hand's geoms as pictures show them: a box rounded, as three boxes and a capsule along each edge."""
    for geom in hand.geoms:
        if geom.kind == "box":
            radius = _ROUNDED * min(geom.size)
            inner = np.asarray(geom.size) - radius
            for axis in range(3):
                turn = geom.rotation @ np.roll(np.eye(3), axis + 1, 0)  # its z is the box's axis
                yield replace(geom, size=inner + radius * (np.arange(3) == axis))
                for signs in ((-1, -1), (-1, 1), (1, -1), (1, 1)):
                    place = geom.position + geom.rotation @ (inner * np.insert(signs, axis, 0))
                    size = np.array([radius, inner[axis], 0])
                    yield replace(geom, kind="capsule", size=size, position=place, rotation=turn)
        elif geom.kind != "plane":
            yield geom


def object_primitives(kinds: tuple[str, ...], frame: Any) -> Primitives:
    """The object's active primitives, posed in the palm frame."""
    active = np.flatnonzero(frame.primitive_active)
    kind = tuple(kinds[k] for k in active)
    tones = FACES if kind == ("box",) else (OBJECT,) * 6
    return Primitives(
        kind,
        frame.primitive_size[active],
        frame.object_position + frame.primitive_position[active] @ frame.object_rotation.T,
        frame.object_rotation @ frame.primitive_rotation[active],
        np.tile((np.array(tones) / 255) ** 2.2, (len(active), 1, 1)),
    )


def goal_position(camera: Camera) -> np.ndarray:
    """Where [3] m the goal is shown: in the upper left of the picture, beside the hand."""
    return np.asarray(camera.target) + _GOAL_AT @ look(camera, (2, 2)).axes[:2]


class Canvas:
    """A picture as it is painted, in linear light [H, W, 3], a colour for each of its rays."""

    def __init__(self, camera: Camera, size: tuple[int, int]):
        self.view = look(camera, size, _SUPERSAMPLE)
        self.rays = self.view.rays()
        self._color = np.full_like(self.rays, _BACKDROP)
        self._up, self._target = unit(np.asarray(camera.up, float)), np.asarray(camera.target)
        axes = self.view.axes
        self._light = unit(0.55 * axes[0] + 0.75 * self._up + 0.75 * axes[2])  # over the camera's right shoulder

    def cast(self, primitives: Primitives) -> tuple[np.ndarray, ...]:
        """What of these each ray sees first: its depth [H, W] m along the optical axis, 1e6 where there is none, index,
        and outward normal [H, W, 3]."""
        spec, rays = mujoco.MjSpec(), self.rays
        for kind, size, position, rotation in zip(*primitives[:4], strict=True):
            shape, quat = getattr(mujoco.mjtGeom, f"mjGEOM_{kind.upper()}"), quaternion(rotation)
            spec.worldbody.add_geom(type=shape, size=np.maximum(size, 1e-6), pos=position, quat=quat)
        model = spec.compile()
        data = mujoco.MjData(model)
        mujoco.mj_kinematics(model, data)
        count = rays.shape[0] * rays.shape[1]
        index, distance, normal = np.full(count, -1, np.int32), np.empty(count), np.empty(3 * count)
        origin = self.view.origin
        mujoco.mj_multiRay(model, data, origin, rays.ravel(), None, True, -1, index, distance, normal, count, _FAR)
        index, depth = index.reshape(rays.shape[:2]), distance.reshape(rays.shape[:2])
        return np.where(index < 0, _FAR, depth), index, normal.reshape(rays.shape)

    def paint_floor(self, above: np.ndarray) -> None:
        """A chequered floor, and on it one soft shadow of what is at the points `above` [P, 3]."""
        down, eye = -self._up, self._target - self.view.origin
        height = FLOOR + eye @ down  # of the camera
        slope = self.rays @ down
        below = height * slope > 0
        level = np.stack([self.view.axes[0], np.cross(self.view.axes[0], down)], -1)
        place = (self.rays[below] * (height / slope[below])[:, None] - eye) @ level  # [M, 2] m from below the target
        tile = _TILES[np.floor(place / 0.05).astype(int).sum(-1) % 2]
        points = (above - self._target) @ level
        away = place - points.mean(0)
        spread = np.linalg.inv(np.cov(points.T) + 0.02**2 * np.eye(2))
        tile = tile * (1 - _SHADE * np.exp(-0.5 * np.sum(away @ spread * away, -1)))[:, None]
        share = np.exp(-np.sum((place / _HORIZON) ** 2, -1))[:, None]
        self._color[below] += share * (tile - self._color[below])

    def paint(self, primitives: Primitives, hits: tuple[np.ndarray, ...], mask: np.ndarray, opacity: float = 1) -> None:
        """Shade what `mask` [H, W] names of a cast by sky, ground and one warm key light, over the picture."""
        _, index, normal = (part[mask] for part in hits)
        away = (1 - np.clip(-np.sum(normal * unit(self.rays[mask]), -1), 0, 1))[:, None]
        shade = _GROUND + (0.5 + 0.5 * normal @ self._up)[:, None] * (_SKY - _GROUND)
        shade += np.maximum(normal @ self._light, 0)[:, None] * _KEY
        local = np.einsum("mk,mkl->ml", normal, primitives.rotation[index])
        axis = np.abs(local).argmax(-1)
        shade *= primitives.color[index, 2 * axis + (local[np.arange(len(axis)), axis] < 0)]
        shade += 0.1 * away**3  # a rim of light
        # Glass-like: more opaque where the surface turns away, so that the silhouette stays crisp.
        self._color[mask] += (opacity + (1 - opacity) * away**2) * (shade - self._color[mask])

    def paint_taxels(
        self, pose: Pose, force: np.ndarray, force_range: float, depth: np.ndarray, glow: float | None = None
    ) -> None:
        """The taxels that face the camera and that no link hides, as discs in the colour of their force [F, N] N; with
        `glow` the loaded ones alone, laid over the picture with that weight. `depth` [H, W] m is that of the links."""
        view = self.view
        visible = np.sum(pose.taxel_normal * (view.origin - pose.taxel_position), -1) > 0
        if glow is not None:
            visible &= force > 0
        level = force[visible]
        hot = (force_color(level, force_range) / 255) ** 2.2
        tone = np.where(level[:, None] > 0, hot, _IDLE_TAXEL)
        pixel, away = view.project(pose.taxel_position[visible] + _TAXEL_LIFT * pose.taxel_normal[visible])
        radius = _TAXEL_RADIUS * (1 + np.clip(level / force_range, 0, 1)) * view.scale / np.maximum(away, 1e-3)
        width, height = view.size
        for (x, y), r, z, hue in zip(pixel, radius, away, tone, strict=True):
            left, right = np.clip((int(x - r), int(x + r) + 2), 0, width)
            top, bottom = np.clip((int(y - r), int(y + r) + 2), 0, height)
            rows, columns = np.ogrid[top:bottom, left:right]
            disc = (columns + 0.5 - x) ** 2 + (rows + 0.5 - y) ** 2 < r**2
            disc &= z < depth[top:bottom, left:right] + _TAXEL_LIFT
            part = self._color[top:bottom, left:right]
            part[disc] += (1.0 if glow is None else glow) * (hue - part[disc])

    def develop(self) -> np.ndarray:
        """sRGB bytes of the picture's pixels."""
        height, width, _ = self._color.shape
        n = _SUPERSAMPLE
        light = self._color.reshape(height // n, n, width // n, n, 3).mean((1, 3))
        return (255 * np.clip(light, 0, 1) ** (1 / 2.2)).round().astype(np.uint8)
