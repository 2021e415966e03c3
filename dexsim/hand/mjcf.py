"""A hand's MJCF as an editable MuJoCo specification, placed as the library reckons: in the palm frame."""

import mujoco
import numpy as np

from dexsim.hand.kinematics import Hand


def read_mjcf(hand: Hand) -> mujoco.MjSpec:
    """The hand's MJCF without actuators, sensors, keyframes and options, the palm at the world's origin.

    The scene has options of its own: with the file's flags gravity or contacts could be off. The file may place the
    palm anywhere: by any kind of orientation, on fixed bodies, in frames.
    """
    spec = mujoco.MjSpec.from_file(str(hand.model_path))
    for element in (*spec.actuators, *spec.sensors, *spec.keys):
        spec.delete(element)
    spec.option = mujoco.MjSpec().option
    root = spec.body(hand.palm)
    while root.parent != spec.worldbody:
        root = root.parent
    # `alt` (euler and the like) would outweigh the quaternion.
    root.pos, root.quat, root.alt.type = [0, 0, 0], [1, 0, 0, 0], mujoco.mjtOrientation.mjORIENTATION_QUAT
    frame, palm = _poses(spec, root.name, hand.palm)
    if not np.array_equal(palm, np.eye(4)):
        # The root is at frame @ place, and its palm at frame @ place @ (inverse of frame @ palm): that is to be 1.
        place, quat = np.linalg.inv(frame) @ np.linalg.inv(palm) @ frame, np.empty(4)
        mujoco.mju_mat2Quat(quat, place[:3, :3].ravel())
        root.pos, root.quat = place[:3, 3], quat
    return spec


def _poses(spec: mujoco.MjSpec, *names: str) -> list[np.ndarray]:
    """Where bodies [4, 4] are in the world, with all joints at their references."""
    model = spec.compile()
    data, poses = mujoco.MjData(model), []
    mujoco.mj_kinematics(model, data)
    for body in (model.body(name).id for name in names):
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = data.xmat[body].reshape(3, 3), data.xpos[body]
        poses.append(pose)
    return poses
