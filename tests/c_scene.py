"""The grasp scene in C MuJoCo, written down a second time: what the physics seam is held against.

Nothing here comes from `dexsim.physics`. The object is compiled with its true sizes, places and
inertia (C MuJoCo ignores geom offsets that are set on a compiled model whose geoms lie at their
body's origin), only its active primitives exist, and forces are summed from `mj_contactForce`.
"""

import mujoco
import numpy as np

KINDS = ("box", "capsule", "cylinder")  # the order of `dexsim.objects.SLOTS`


def compile_scene(hand, target, *, gravity=(9.81, 0.0, 0.0), timestep=0.005, iterations=5,
                  line_search=8, condim=3, margin=0.0,
                  exact=False) -> mujoco.MjModel:
    """One object (`ObjectParams` of NumPy leaves) under the hand; `margin` m for clearances."""
    spec = mujoco.MjSpec.from_file(str(hand.model_path))
    for actuator in list(spec.actuators):
        spec.delete(actuator)
    names = [g.name for g in spec.geoms if (g.contype or g.conaffinity) and g.name != "palm"]
    for geom in spec.geoms:
        geom.contype = geom.conaffinity = 0
    body = spec.worldbody.add_body(name="object", mass=float(target.mass), explicitinertial=True,
                                   ipos=target.com, inertia=target.inertia)
    body.add_freejoint()
    for k in np.flatnonzero(target.active):
        kind = getattr(mujoco.mjtGeom, f"mjGEOM_{KINDS[k].upper()}")
        body.add_geom(name=KINDS[k], type=kind, size=target.size[k], pos=target.position[k],
                      contype=0, conaffinity=0, mass=0)
        for name in names:
            spec.add_pair(geomname1=name, geomname2=KINDS[k], condim=condim, margin=margin,
                          friction=[*[target.friction] * 2, 0.005, 1e-4, 1e-4],
                          solref=target.contact)
    option = spec.option
    option.timestep, option.gravity = timestep, gravity
    option.iterations, option.ls_iterations = iterations, line_search
    option.integrator, option.solver = mujoco.mjtIntegrator.mjINT_EULER, mujoco.mjtSolver.mjSOL_NEWTON
    option.cone = mujoco.mjtCone.mjCONE_PYRAMIDAL
    option.disableflags |= mujoco.mjtDisableBit.mjDSBL_EULERDAMP
    if not exact:
        option.disableflags |= mujoco.mjtDisableBit.mjDSBL_NATIVECCD
    model = spec.compile()
    # Contact softness is the skin's: that of a 0.1 kg object with 5e-5 kg m^2, whatever is held.
    model.body_invweight0[model.body("object").id] = 1 / 0.1, 1 / 5e-5
    return model


def start(model: mujoco.MjModel, qpos, qvel, warmstart=None) -> mujoco.MjData:
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = qpos, qvel
    if warmstart is not None:
        data.qacc_warmstart[:] = warmstart
    return data


def finger_force(model: mujoco.MjModel, data: mujoco.MjData, hand) -> np.ndarray:
    """Force of the object on each tip link [F, 3] N, world axes: a sum over `mj_contactForce`."""
    total = np.zeros((hand.num_fingers, 3))
    target = model.body("object").id
    tips = [model.body(hand.body_names[b]).id for b in hand.tip_body]
    for index, contact in enumerate(data.contact):
        first, second = model.geom_bodyid[contact.geom]
        if target not in (first, second) or contact.exclude:
            continue
        wrench = np.zeros(6)
        mujoco.mj_contactForce(model, data, index, wrench)
        force = contact.frame.reshape(3, 3).T @ wrench[:3]  # from the first geom on the second
        for finger, tip in enumerate(tips):
            if second == tip:
                total[finger] += force
            elif first == tip:
                total[finger] -= force
    return total
