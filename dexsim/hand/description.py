"""The hand as a static description, in NumPy: reading and drawing a hand needs no JAX.

Shapes: J joints that have motors, H hinges (more than J where one motor moves two), B bodies, F fingers, N taxels a
finger. Poses are in the palm frame (fingers +z, palm normal +x, thumb side +y; of a left hand -y).
"""

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np

SHAPES = {2: "sphere", 3: "capsule", 4: "ellipsoid", 5: "cylinder", 6: "box"}
"""Primitives by MuJoCo's number of them; a plane is none."""


@dataclasses.dataclass(frozen=True)
class Geom:
    """One primitive of the hand in its link's frame; `size` as in MuJoCo, `touches` the object."""

    name: str
    kind: str
    body: int
    size: np.ndarray
    position: np.ndarray
    rotation: np.ndarray
    touches: bool


@dataclasses.dataclass(frozen=True, eq=False)
class Hand:
    """What is fixed about a hand. Arrays are NumPy, so it can be closed over by jitted code."""

    name: str
    model_path: Path
    palm: str
    joint_names: tuple[str, ...]
    joint_lower: np.ndarray  # [J] rad
    joint_upper: np.ndarray  # [J] rad
    torque_limit: np.ndarray  # [J] Nm, stall torque
    speed_limit: np.ndarray  # [J] rad/s, no-load speed
    gain: np.ndarray  # [J] 1, over the nominal motor gains k_p and k_d
    body_names: tuple[str, ...]
    body_parent: np.ndarray  # [B], -1 for the palm
    body_position: np.ndarray  # [B, 3] m, in the parent's frame
    body_rotation: np.ndarray  # [B, 3, 3]
    body_joint: np.ndarray  # [B] index into joint_names, -1 where rigid
    body_ratio: np.ndarray  # [B] its hinge's angle over that joint's, 1 where it is that joint
    body_offset: np.ndarray  # [B] rad, its hinge's angle where that joint's is 0
    joint_axis: np.ndarray  # [B, 3], of the body's hinge
    joint_anchor: np.ndarray  # [B, 3] m
    joint_reference: np.ndarray  # [B] rad, angle at which the body is as drawn
    finger_names: tuple[str, ...]
    tip_body: np.ndarray  # [F]
    tip_offset: np.ndarray  # [F, 3] m, in the tip body's frame
    root_joint: np.ndarray  # [F] the joint whose torque represents the finger
    force_per_torque: np.ndarray  # [F] N/Nm, force of the finger over that torque; 0: not known
    taxel_grid: tuple[int, int]  # columns, rows; index = column * rows + row
    taxel_position: np.ndarray  # [F, N, 3] m, in the tip body's frame
    taxel_normal: np.ndarray  # [F, N, 3] outward
    taxel_area: np.ndarray  # [F, N] m^2
    geoms: tuple[Geom, ...]
    grasp_posture: tuple[float, ...] = ()  # rad, from which grasps start; empty: not given
    grasp_centre: tuple[float, ...] = ()  # m, where the object of a grasp belongs; empty: not given
    grasp_force: tuple[float, float] = (1.2, 4.8)  # N, target of a finger at command 0 and 1
    rotate_posture: tuple[float, ...] = ()  # rad, from which rotations start; empty: not given
    rotate_reference: tuple[float, ...] = ()  # m, where the object of a rotation belongs; empty: not given
    side: str = "right"  # or "left"
    source: str = ""  # the TOML as it was named, or the name of a shipped hand
    digest: str = ""  # of its files

    @property
    def thumb_side(self) -> float:
        """Sign of y on the thumb's side: -1 for a left hand."""
        return -1.0 if self.side == "left" else 1.0

    @property
    def num_joints(self) -> int:
        return len(self.joint_names)

    @property
    def num_hinges(self) -> int:
        """Hinges of the MJCF: joints, and those that follow them."""
        return int(np.sum(self.body_joint >= 0))

    @property
    def num_fingers(self) -> int:
        return len(self.finger_names)

    @property
    def num_taxels(self) -> int:
        """Taxels of one finger."""
        return self.taxel_position.shape[1]


def unit(vectors: np.ndarray) -> np.ndarray:
    """Vectors [..., 3] of length one."""
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-12)


def primitive_mesh(kind: str, size: np.ndarray) -> Any:
    """A primitive as a `trimesh.Trimesh`; `size` as in MuJoCo, m."""
    import trimesh

    a, b, c = (float(x) for x in size)
    if kind == "box":
        return trimesh.creation.box(extents=(2 * a, 2 * b, 2 * c))
    if kind == "capsule":
        capsule = trimesh.creation.capsule(radius=a, height=2 * b, count=(48, 32))
        return capsule.apply_translation(-capsule.bounds.mean(0))
    if kind == "cylinder":
        return trimesh.creation.cylinder(radius=a, height=2 * b, sections=64)
    ball = trimesh.creation.icosphere(subdivisions=4)
    return ball.apply_scale((a, b, c) if kind == "ellipsoid" else a)
