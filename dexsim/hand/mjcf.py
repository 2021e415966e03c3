"""A hand in MuJoCo: its MJCF as an editable specification, and poses of its parts, both in the palm frame."""

from functools import lru_cache
from typing import Any, NamedTuple

import mujoco
import numpy as np

from dexsim.hand.description import Hand

_FLAGS = ("constraint", "equality", "frictionloss", "limit", "contact", "spring", "damper")
"""Flags that say what a hand is like; gravity is the task's, and others say how MuJoCo works it out."""


def read_mjcf(hand: Hand) -> mujoco.MjSpec:
    """The hand's MJCF without actuators, sensors and keyframes, the palm at the world's origin.

    The file may place the palm anywhere: by any kind of orientation, on fixed bodies, in frames. Masses and inertias
    are numbers, however the file gives them.
    """
    spec = mujoco.MjSpec.from_file(str(hand.model_path))
    for element in (*spec.actuators, *spec.sensors, *spec.keys):
        spec.delete(element)
    root = spec.body(hand.palm)
    while root.parent != spec.worldbody:
        root = root.parent
    # `alt` (euler and the like) would outweigh the quaternion.
    root.pos, root.quat, root.alt.type = [0, 0, 0], [1, 0, 0, 0], mujoco.mjtOrientation.mjORIENTATION_QUAT
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)  # all joints are at their references
    frame, palm = (_pose(data.body(name)) for name in (root.name, hand.palm))
    if not np.array_equal(palm, np.eye(4)):
        # The root is at frame @ place, and its palm at frame @ place @ (inverse of frame @ palm): that is to be 1.
        place = np.linalg.inv(frame) @ np.linalg.inv(palm) @ frame
        root.pos, root.quat = place[:3, 3], quaternion(place[:3, :3])
    _write_down_masses(spec, model)
    return spec


def disabled(option: Any) -> str:
    """What an MJCF's <option> disables of what makes a hand; empty if nothing."""
    off = [f for f in _FLAGS if option.disableflags & int(getattr(mujoco.mjtDisableBit, f"mjDSBL_{f.upper()}"))]
    return f"<option> disables {', '.join(off)}" if off else ""


def _write_down_masses(spec: mujoco.MjSpec, model: mujoco.MjModel) -> None:
    """A mass by density would grow with a fingertip's rubber, one by the file's total would shrink with the object."""
    compiler, of_geoms = spec.compiler, mujoco.mjtInertiaFromGeom
    derived = compiler.settotalmass > 0 or compiler.inertiafromgeom == of_geoms.mjINERTIAFROMGEOM_TRUE
    compiler.settotalmass, compiler.inertiafromgeom = -1, of_geoms.mjINERTIAFROMGEOM_AUTO
    for body in spec.bodies[1:]:
        if derived or not body.explicitinertial:
            body.explicitinertial, body.mass, body.inertia = True, model.body_mass[body.id], model.body_inertia[body.id]
            body.ipos, body.iquat = model.body_ipos[body.id], model.body_iquat[body.id]
            body.fullinertia[0], body.ialt.type = np.nan, mujoco.mjtOrientation.mjORIENTATION_QUAT


def quaternion(rotation: np.ndarray) -> np.ndarray:
    """(w, x, y, z) of a rotation matrix [3, 3]."""
    quat = np.empty(4)
    mujoco.mju_mat2Quat(quat, np.asarray(rotation, float).ravel())
    return quat


def _pose(body: Any) -> np.ndarray:
    """Where a body is in the world [4, 4]."""
    return np.block([[body.xmat.reshape(3, 3), body.xpos[:, None]], [0, 0, 0, 1]])


class Pose(NamedTuple):
    """Where the hand's parts are, NumPy."""

    body_position: np.ndarray  # [B, 3] m
    body_rotation: np.ndarray  # [B, 3, 3]
    taxel_position: np.ndarray  # [F, N, 3] m
    taxel_normal: np.ndarray  # [F, N, 3]


def hand_poses(hand: Hand, joint_position: np.ndarray, kind: type = np.float32) -> list[Pose]:
    """Poses of T frames from joint angles [T, J] rad, by MuJoCo; arrays of a `kind`."""
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
        poses.append(Pose(*(x.astype(kind) for x in (position, rotation, taxels, hand.taxel_normal @ tips))))
    return poses


@lru_cache(maxsize=4)
def _plant(hand: Hand) -> tuple[Any, Any]:
    model = mujoco.MjModel.from_xml_path(str(hand.model_path))
    return model, mujoco.MjData(model)
