"""The MuJoCo model of a trial with a user's hand: the MJCF as it is, and the object in front of it.

Friction, stiffness and damping of a contact are those of the hand's geom: the object adds none of its own.
"""

import functools

import mujoco
import numpy as np

from dexsim_real.twin.plant.foreign.model import ForeignModel
from dexsim_real.twin.plant.parameters import TrialParameters
from dexsim_real.twin.plant.scene import Scene, add_object
from dexsim_real.twin.plant.shapes import ObjectShape

_FAR = 0.2  # m above the palm, where rays start


def build_foreign_scene(
    foreign: ForeignModel, parameters: TrialParameters, shape: ObjectShape, gravity: np.ndarray
) -> Scene:
    """Compile the model of a trial; `gravity` [3] m/s^2 in the palm frame."""
    spec = foreign.spec.copy()
    bits = functools.reduce(int.__or__, (geom.contype | geom.conaffinity for geom in spec.geoms))
    lowest = min(geom.priority for geom in spec.geoms)
    add_object(spec, parameters, shape)
    for geom in spec.body("object").geoms:
        geom.contype = geom.conaffinity = bits
        geom.priority, geom.margin, geom.gap = lowest - 1, 0.0, 0.0
    spec.option.gravity = gravity
    spec.option.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_GRAVITY)
    # What is held falls asleep, and would hang in the air when it is let go.
    spec.option.enableflags &= ~int(mujoco.mjtEnableBit.mjENBL_SLEEP)
    return _index(spec.compile(), foreign)


def palm_face(scene: Scene, place: tuple[float, float]) -> float:
    """Height x in m of the palm's surface at a place (y, z) m along it; 0 where there is none."""
    model = scene.model
    data, start = mujoco.MjData(model), np.array([_FAR, *place])
    mujoco.mj_kinematics(model, data)
    geom, down = np.zeros(1, np.int32), np.array([-1.0, 0.0, 0.0])
    while (distance := mujoco.mj_ray(model, data, start, down, None, 1, -1, geom)) >= 0:
        start = start + distance * down
        touches = model.geom_contype[geom[0]] | model.geom_conaffinity[geom[0]]
        if model.body_weldid[model.geom_bodyid[geom[0]]] == 0 and touches:
            return float(start[0])
        start = start + 1e-4 * down  # A finger, or what is only drawn.
    return 0.0


def _index(model: mujoco.MjModel, foreign: ForeignModel) -> Scene:
    joints = [model.joint(name) for name in foreign.joints]
    sites = np.array([model.site(name).id for name in foreign.lattices])
    finger = {int(model.body_weldid[model.site_bodyid[site]]): f for f, site in enumerate(sites)}
    free, body = model.joint("object"), model.body("object").id
    return Scene(
        model=model,
        drive_qpos=np.array([j.qposadr[0] for j in joints]),
        drive_dof=np.array([j.dofadr[0] for j in joints]),
        play_qpos=None,
        play_dof=None,
        object_qpos=int(free.qposadr[0]),
        object_dof=int(free.dofadr[0]),
        object_body=body,
        tip_site=sites,
        finger_of_geom=np.array([finger.get(int(model.body_weldid[b]), -1) for b in model.geom_bodyid]),
        is_object=model.geom_bodyid == body,
    )
