"""The scene of a view: hand, taxels, contact forces, object and goal as viser draws them.

Geometry is sent once and then moved; a frame costs a few kilobytes.
"""

import dataclasses
from typing import Any, NamedTuple

import numpy as np
import trimesh

from dexsim.hand.description import Hand, primitive_mesh
from dexsim.hand.mjcf import Pose, hand_poses, quaternion
from dexsim.render.panel import force_color
from dexsim.render.picture import FACES, FIELD_OF_VIEW, FLOOR, LINK, OBJECT, PALM, TIP, Color, drawn_geoms, look
from dexsim.render.render import camera_of
from dexsim.render.snapshot import Snapshot

_IDLE = (60, 66, 78)  # sRGB of a taxel that feels nothing
_ARROW = (255, 190, 70)
_METRES_PER_NEWTON = 0.006  # length of a force's arrow
_GOAL_AT = 0.10  # m above the object, where the goal is shown
_GOAL_SCALE = 0.6  # of the object, at which the goal is shown
_AWAY, _ASIDE = 1.3, 0.07  # of a film's camera's distance; m
_LIFT = 0.0004  # m of the taxels off the skin, so that they are not inside it


class Frame(NamedTuple):
    """One moment; NumPy."""

    snapshot: Snapshot
    kinds: tuple[str, ...]
    """Kinds of the object's primitives [K]; empty where the shape is not known."""
    note: str = ""
    """What happened, such as "dropped"."""
    command: float | None = None
    """The command that the page asks for, to which a force loop adds."""


class Scene:
    """A hand in the browser: on a server of viser, seen by the camera of a task, which also says where up is."""

    def __init__(self, server: Any, hand: Hand, task: str):
        self._server, self._hand = server, hand
        self._shape: Any = None  # what the object looked like when it was last sent
        view = camera_of(task, hand)
        self._up = np.asarray(view.up, float)
        server.scene.set_up_direction(view.up)
        server.scene.configure_default_lights(True, cast_shadow=False)
        server.scene.add_light_ambient("/light", intensity=1.2)
        size = {"width": 1.2, "height": 1.2, "cell_size": 0.05, "section_size": 0.2}
        tones = {"cell_color": (52, 56, 64), "section_color": (78, 84, 94)}
        place = tuple(np.asarray(view.target) - FLOOR * self._up)
        server.scene.add_grid("/floor", plane="yz", position=place, **size, **tones)  # Every preset's up is along x.
        # Farther away than a film's camera, and aside: the controls cover a part of the page.
        eye = look(dataclasses.replace(view, distance=_AWAY * view.distance), (4, 3))
        aside = _ASIDE * eye.axes[0]
        server.initial_camera.position = tuple(eye.origin + aside)
        server.initial_camera.look_at = tuple(view.target + aside)
        server.initial_camera.fov = float(np.deg2rad(FIELD_OF_VIEW))
        self._links = [server.scene.add_frame(f"/hand/{name}", show_axes=False) for name in hand.body_names]
        for number, geom in enumerate(drawn_geoms(hand)):
            tone = TIP if geom.body in hand.tip_body else PALM if geom.body == 0 else LINK
            name, mesh = f"/hand/{hand.body_names[geom.body]}/{number}", primitive_mesh(geom.kind, geom.size)
            self._add_mesh(name, mesh, tone, geom.position, geom.rotation, flat_shading=geom.kind == "box")
        # Each fingertip carries its taxels, so that they are in place however late a slow browser draws.
        self._taxels = [
            server.scene.add_point_cloud(
                f"/hand/{hand.body_names[body]}/taxels",
                (hand.taxel_position + _LIFT * hand.taxel_normal)[finger].astype(np.float32),
                np.tile(np.array(_IDLE, np.uint8), (hand.num_taxels, 1)),
                point_size=0.0015,
                point_shape="circle",
                precision="float32",
            )
            for finger, body in enumerate(hand.tip_body)
        ]
        shape = {"shaft_radius": 0.0009, "head_radius": 0.0022, "head_length": 0.005}
        self._forces = server.scene.add_arrows("/forces", np.zeros((1, 2, 3)), _ARROW, **shape, visible=False)
        self._object = server.scene.add_frame("/object", show_axes=False, axes_length=0.03, axes_radius=0.001)
        self._goal = server.scene.add_frame("/goal", show_axes=False, visible=False)

    def show(self, frame: Frame, force_range: float) -> None:
        """Draw a frame; taxels are coloured from 0 to `force_range` N."""
        snapshot = frame.snapshot
        pose = hand_poses(self._hand, np.asarray(snapshot.joint_position, np.float32)[None])[0]
        with self._server.atomic():
            for link, position, rotation in zip(self._links, pose.body_position, pose.body_rotation, strict=True):
                link.position, link.wxyz = position, quaternion(rotation)
            force = np.asarray(snapshot.taxel_force)
            colors = np.where(force[..., None] > 0, force_color(force, force_range), np.array(_IDLE, np.uint8))
            for taxels, color in zip(self._taxels, colors, strict=True):
                taxels.colors = color
            arrows = force_arrows(pose, force)
            self._forces.visible = len(arrows) > 0
            if len(arrows):
                self._forces.points = arrows.astype(np.float32)
            self._draw_object(frame)
            self._object.position = snapshot.object_position
            self._object.wxyz = quaternion(snapshot.object_rotation)
            if snapshot.goal_rotation is not None:
                self._goal.visible = True
                self._goal.position = np.asarray(snapshot.object_position) + _GOAL_AT * self._up
                self._goal.wxyz = quaternion(snapshot.goal_rotation)

    def _draw_object(self, frame: Frame) -> None:
        """The object's primitives, and again for the goal, where they are not those of the frame before."""
        snapshot = frame.snapshot
        active = np.flatnonzero(snapshot.primitive_active)
        arrays = snapshot.primitive_size, snapshot.primitive_position, snapshot.primitive_rotation
        shape = tuple(frame.kinds[k] for k in active), *(np.asarray(array)[active].tobytes() for array in arrays)
        if shape == self._shape:
            return
        self._shape = shape
        for root in ("/object/shape", "/goal/shape"):
            self._server.scene.remove_by_name(root)
        self._object.show_axes = len(active) == 0
        for root, scale in (("object", 1.0), ("goal", _GOAL_SCALE)):
            for k in active:
                box = frame.kinds[k] == "box"
                mesh = primitive_mesh(frame.kinds[k], snapshot.primitive_size[k]).apply_scale(scale)
                parts = box_faces(mesh) if box and len(active) == 1 else [(OBJECT, mesh)]
                place, turn = scale * np.asarray(snapshot.primitive_position[k]), snapshot.primitive_rotation[k]
                for number, (color, part) in enumerate(parts):
                    name = f"/{root}/shape/{k}/{number}"
                    self._add_mesh(name, part, color, place, turn, opacity=0.6, flat_shading=box)
        if len(active):
            self._server.scene.add_label("/goal/shape/label", "goal")

    def _add_mesh(
        self, name: str, mesh: trimesh.Trimesh, color: Color, place: np.ndarray, turn: np.ndarray, **options: Any
    ) -> None:
        pose = {"position": place, "wxyz": quaternion(turn)}
        self._server.scene.add_mesh_simple(name, mesh.vertices, mesh.faces, color=color, **pose, **options)


def force_arrows(pose: Pose, taxel_force: np.ndarray) -> np.ndarray:
    """Arrows [M, 2, 3] m of the fingers that feel something: from the centre of force, along what the taxels bear."""
    total = taxel_force.sum(-1)
    touching = total > 0
    force = -np.einsum("fn,fnk->fk", taxel_force, pose.taxel_normal)[touching]
    centre = np.einsum("fn,fnk->fk", taxel_force, pose.taxel_position)[touching] / total[touching, None]
    # The head is at the skin, so that the arrow is outside of the finger.
    return np.stack([centre - _METRES_PER_NEWTON * force, centre], 1)


def box_faces(box: trimesh.Trimesh) -> list[tuple[Color, trimesh.Trimesh]]:
    """The six faces of a box, each with its colour of `FACES`: +x, -x, +y, -y, +z, -z."""
    axis = np.abs(box.face_normals).argmax(-1)
    side = 2 * axis + (box.face_normals[np.arange(len(axis)), axis] < 0)
    return [(FACES[k], box.submesh([np.flatnonzero(side == k)], append=True)) for k in range(6)]
