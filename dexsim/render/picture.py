"""The picture of a posed hand, its taxels and the object: shading on top of `dexsim.render.raycast`."""

import dataclasses
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from dexsim.hand.description import Hand
from dexsim.render.colors import FACES, LINK, OBJECT, PALM, TIP, linear
from dexsim.render.panel import force_color
from dexsim.render.raycast import Camera, CameraView, Primitives, VisibleSurface, cast, hit_points, look, normals

_SUPERSAMPLE = 2  # rays a pixel, in each direction
_TAXEL_LIFT = 0.001  # m; the pads follow the taxel lattice to within 1 mm, and no taxel may drown in its pad
_TAXEL_RADIUS = 0.0007  # m; twice that under full load, up to touching its neighbours
_OBJECT_OPACITY = 0.62  # so that fingers behind the object stay visible
_TAXEL_GLOW = 0.6  # how strongly a loaded taxel shows through the object
_GOAL_OPACITY, _GOAL_SCALE, _GOAL_AT = 0.9, 0.45, np.array([-0.066, 0.088])  # m to the right and up of the middle

# Linear RGB.
_SIDES = np.array([linear(color) for color in FACES], np.float32)
_IDLE_TAXEL = (0.08, 0.09, 0.1)
_SKY, _GROUND, _KEY = np.array([[0.46, 0.51, 0.58], [0.18, 0.16, 0.15], [1.5, 1.44, 1.33]], np.float32)
_BACKDROP = np.array([[0.040, 0.047, 0.060], [0.012, 0.014, 0.019]])  # middle, corners


class Pose(NamedTuple):
    """Where the hand's parts are, NumPy."""

    body_position: np.ndarray  # [B, 3] m
    body_rotation: np.ndarray  # [B, 3, 3]
    taxel_position: np.ndarray  # [F, N, 3] m
    taxel_normal: np.ndarray  # [F, N, 3]


def hand_poses(hand: Hand, joint_position: np.ndarray) -> list[Pose]:
    """Poses of T frames from joint angles [T, J] rad, by MuJoCo."""
    import mujoco

    model, data = _plant(hand)
    bodies = [model.body(name).id for name in hand.body_names]
    moving = np.flatnonzero(hand.body_joint >= 0)
    hinges = model.jnt_qposadr[model.body_jntadr[np.array(bodies)[moving]]]
    poses = []
    for angles in np.asarray(joint_position, float):
        data.qpos[hinges] = angles[hand.body_joint[moving]] * hand.body_ratio[moving] + hand.body_offset[moving]
        mujoco.mj_kinematics(model, data)
        palm = data.xmat[bodies[0]].reshape(3, 3)
        position = (data.xpos[bodies] - data.xpos[bodies[0]]) @ palm
        rotation = palm.T @ data.xmat[bodies].reshape(-1, 3, 3)
        tips = rotation[hand.tip_body].swapaxes(-1, -2)
        taxels = position[hand.tip_body, None] + hand.taxel_position @ tips
        poses.append(Pose(*(x.astype(np.float32) for x in (position, rotation, taxels, hand.taxel_normal @ tips))))
    return poses


@lru_cache(maxsize=4)
def _plant(hand: Hand) -> tuple[Any, Any]:
    import mujoco

    model = mujoco.MjModel.from_xml_path(str(hand.model_path))
    return model, mujoco.MjData(model)


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
    view = look(camera, size, _SUPERSAMPLE)
    color = _backdrop(view.size).copy()
    body, held = hand_primitives(hand, pose), object_primitives(kinds, frame)
    taxels, loaded = taxel_primitives(pose, frame.taxel_force, force_range, view.origin)
    goal = goal_primitives(held, frame, camera)

    surface = cast(body, view)
    _paint(color, body, surface, view, camera)
    skin = _in_front(cast(taxels, view), surface.depth)
    _paint(color, taxels, skin, view, camera)
    front = _in_front(cast(held, view), surface.depth)
    _paint(color, held, front, view, camera, _OBJECT_OPACITY)
    # The taxels in contact are between finger and object: draw the loaded ones through the object.
    hidden = (front.index >= 0) & (skin.index >= 0) & np.append(loaded, False)[skin.index]
    behind = dataclasses.replace(skin, index=np.where(hidden, skin.index, -1))
    _paint(color, taxels, behind, view, camera, _TAXEL_GLOW)
    marker = _in_front(cast(goal, view), np.minimum(surface.depth, front.depth))
    _paint(color, goal, marker, view, camera, _GOAL_OPACITY)
    return _develop(color)


def hand_primitives(hand: Hand, pose: Pose) -> Primitives:
    """The hand's geoms, posed; the palm, the links and the fingertips in three tones."""
    geoms = [geom for geom in hand.geoms if geom.kind != "plane"]
    body = np.array([geom.body for geom in geoms])
    turn = pose.body_rotation[body]
    position = np.einsum("gij,gj->gi", turn, [geom.position for geom in geoms])
    tones = [TIP if geom.body in hand.tip_body else PALM if geom.body == 0 else LINK for geom in geoms]
    return Primitives(
        tuple(geom.kind for geom in geoms),
        np.array([geom.size for geom in geoms]),
        pose.body_position[body] + position,
        turn @ np.array([geom.rotation for geom in geoms]),
        np.array([linear(tone) for tone in tones], np.float32),
    )


def taxel_primitives(
    pose: Pose, force: np.ndarray, force_range: float, eye: np.ndarray
) -> tuple[Primitives, np.ndarray]:
    """The taxels that face the eye as beads on the skin in the colour of their force, and which are loaded."""
    visible = np.sum(pose.taxel_normal * (eye - pose.taxel_position), -1) > 0
    level = force[visible]
    count, loaded = len(level), level > 0
    size = np.zeros((count, 3))
    size[:, 0] = _TAXEL_RADIUS * (1 + np.clip(level / force_range, 0, 1))
    hot = (force_color(level, force_range) / 255) ** 2.2
    position = pose.taxel_position[visible] + _TAXEL_LIFT * pose.taxel_normal[visible]
    color = np.where(loaded[:, None], hot, _IDLE_TAXEL).astype(np.float32)
    return Primitives(("sphere",) * count, size, position, np.tile(np.eye(3), (count, 1, 1)), color), loaded


def object_primitives(kinds: tuple[str, ...], frame: Any) -> Primitives:
    """The object's active primitives, posed in the palm frame."""
    active = np.flatnonzero(frame.primitive_active)
    kind = tuple(kinds[k] for k in active)
    return Primitives(
        kind,
        frame.primitive_size[active],
        frame.object_position + frame.primitive_position[active] @ frame.object_rotation.T,
        frame.object_rotation @ frame.primitive_rotation[active],
        np.tile(np.array(linear(OBJECT), np.float32), (len(active), 1)),
        _SIDES if kind == ("box",) else None,
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


def _in_front(surface: VisibleSurface, depth: np.ndarray) -> VisibleSurface:
    """What of a surface is nearer than `depth` [H, W]."""
    return dataclasses.replace(surface, index=np.where(surface.depth < depth, surface.index, -1))


def _paint(
    color: np.ndarray,
    primitives: Primitives,
    surface: VisibleSurface,
    view: CameraView,
    camera: Camera,
    opacity: float = 1.0,
) -> None:
    """Shade a surface by sky, ground and one warm key light, and lay it over the picture, linear RGB [H, W, 3]."""
    rows, columns = (np.flatnonzero((surface.index >= 0).any(axis)) for axis in (1, 0))
    if not len(rows):
        return
    n = _SUPERSAMPLE
    top, left = rows[0] // n * n, columns[0] // n * n
    window = slice(top, rows[-1] // n * n + n), slice(left, columns[-1] // n * n + n)
    index, color = surface.index[window], color[window]
    # A pixel within one primitive is shaded once, one at an edge in each of its rays.
    inside, needed = index[::n, ::n] >= 0, index >= 0
    others = [(i, j) for i in range(n) for j in range(n) if i + j > 0]
    for i, j in others:
        inside &= index[i::n, j::n] == index[::n, ::n]
    for i, j in others:
        needed[i::n, j::n] &= ~inside
    row, column = np.nonzero(needed)
    index, depth = index[row, column], surface.depth[window][row, column]
    points = hit_points(view, row + top, column + left, depth)
    normal = normals(primitives, index, points)
    up = _unit(np.asarray(camera.up, float))
    light = _unit(0.55 * view.axes[0] + 0.75 * up + 0.75 * view.axes[2])  # over the camera's right shoulder
    up, light, toward = up.astype(np.float32), light.astype(np.float32), view.origin.astype(np.float32) - points
    facing = np.einsum("mi,mi->m", normal, toward) / np.sqrt(np.einsum("mi,mi->m", toward, toward))
    away = (1 - np.clip(facing, 0, 1))[:, None]
    shade = _GROUND + (0.5 + 0.5 * normal @ up)[:, None] * (_SKY - _GROUND)
    shade += np.maximum(normal @ light, 0)[:, None] * _KEY
    shade *= face_colors(primitives, index, normal)
    shade += np.float32(0.1) * away**3  # a rim of light
    # Glass-like: more opaque where the surface turns away, so that the silhouette stays crisp.
    weight = opacity + (1 - opacity) * away**2
    color[row, column] += weight * (shade - color[row, column])
    for i, j in others:
        color[i::n, j::n][inside] = color[::n, ::n][inside]


def face_colors(primitives: Primitives, index: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """The colour [M, 3] of each point: its primitive's, or that of the side of a box that its normal is nearest to."""
    if primitives.sides is None:
        return primitives.color[index]
    local = normal @ primitives.rotation[0].astype(np.float32)
    axis = np.abs(local).argmax(-1)
    return primitives.sides[2 * axis + (local[np.arange(len(axis)), axis] < 0)]


@lru_cache(maxsize=4)
def _backdrop(size: tuple[int, int]) -> np.ndarray:
    """A soft vignette, linear RGB [H, W, 3]."""
    width, height = size
    x, y = np.meshgrid(np.linspace(-1, 1, width), np.linspace(-1, 1, height))
    edge = np.clip((x**2 + y**2) / 1.6, 0, 1)[..., None]
    return (_BACKDROP[0] + (_BACKDROP[1] - _BACKDROP[0]) * edge).astype(np.float32)


def _develop(color: np.ndarray) -> np.ndarray:
    """Linear light of all rays [H, W, 3] as sRGB bytes of pixels."""
    height, width, _ = color.shape
    n = _SUPERSAMPLE
    rays = color.reshape(height // n, n, width // n, n, 3)
    light = np.add.reduce([rays[:, i, :, j] for i in range(n) for j in range(n)]) / (n * n)
    return (255 * np.clip(light, 0, 1) ** (1 / 2.2)).round().astype(np.uint8)


def _unit(vector: np.ndarray) -> np.ndarray:
    return vector / np.linalg.norm(vector, axis=-1, keepdims=True)
