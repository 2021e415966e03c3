"""A hand's MJCF as an editable MuJoCo specification, placed as the library reckons: in the palm frame."""

import mujoco
import numpy as np

from dexsim.hand.description import Hand


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
    frame, palm = _poses(model, root.name, hand.palm)
    if not np.array_equal(palm, np.eye(4)):
        # The root is at frame @ place, and its palm at frame @ place @ (inverse of frame @ palm): that is to be 1.
        place, quat = np.linalg.inv(frame) @ np.linalg.inv(palm) @ frame, np.empty(4)
        mujoco.mju_mat2Quat(quat, place[:3, :3].ravel())
        root.pos, root.quat = place[:3, 3], quat
    _write_down_masses(spec, model)
    return spec


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


def _poses(model: mujoco.MjModel, *names: str) -> list[np.ndarray]:
    """Where bodies [4, 4] are in the world, with all joints at their references."""
    data, poses = mujoco.MjData(model), []
    mujoco.mj_kinematics(model, data)
    for body in (model.body(name).id for name in names):
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = data.xmat[body].reshape(3, 3), data.xpos[body]
        poses.append(pose)
    return poses
