"""Refuses hand models with features that our scene drops or MJX silently ignores.

A policy trained on such a model would be for a hand that does not exist.
"""

from pathlib import Path

import mujoco
import numpy as np

from dexsim.core.errors import AssetError

_PHYSICS = ("constraint", "equality", "frictionloss", "limit", "contact", "spring", "damper")
"""Flags that say what a hand is like; gravity is the task's, and others say how MuJoCo works it out."""


def check_model(model: mujoco.MjModel, where: str | Path = "model") -> None:
    """Raise AssetError naming every feature of `model` that the physics would drop, and the elements that have it."""
    elements = {
        "actuator": {
            "actuator delay": np.c_[model.actuator_delay, model.actuator_history[:, 0]],
            "actuator armature": model.actuator_armature,
            "actuator damping": np.c_[model.actuator_damping, model.actuator_dampingpoly],
            "dcmotor actuator": model.actuator_dyntype == mujoco.mjtDyn.mjDYN_DCMOTOR,
            "pid actuator": model.actuator_dyntype == mujoco.mjtDyn.mjDYN_PID,
        },
        "sensor": {
            "sensor delay or interval": np.c_[model.sensor_delay, model.sensor_history[:, 0], model.sensor_interval],
            "tactile sensor": model.sensor_type == mujoco.mjtSensor.mjSENS_TACTILE,
        },
        "joint": {
            "polynomial joint stiffness": model.jnt_stiffnesspoly,
            "polynomial joint damping": model.dof_dampingpoly[model.jnt_dofadr],
        },
    }
    features = []
    for kind, values in elements.items():
        for feature, value in values.items():
            rows = np.flatnonzero(np.any(np.c_[value] != 0, axis=1))
            names = [getattr(model, kind)(int(row)).name or f"#{row}" for row in rows]
            if names:
                features.append(f"{feature} ({kind} {', '.join(names)})")
    option = model.opt
    off = [f for f in _PHYSICS if option.disableflags & int(getattr(mujoco.mjtDisableBit, f"mjDSBL_{f.upper()}"))]
    whole = {
        "plugins": model.nplugin,
        "flex bodies": model.nflex,
        "SDF geoms": np.any(model.geom_type == mujoco.mjtGeom.mjGEOM_SDF),
        "fluid forces (density, viscosity, wind)": option.density or option.viscosity or np.any(option.wind),
        "noslip iterations": option.noslip_iterations,
        f"flags that disable {', '.join(off)}": off,
        "flag override": option.enableflags & mujoco.mjtEnableBit.mjENBL_OVERRIDE,
    }
    features += [feature for feature, there in whole.items() if there]
    if features:
        raise AssetError(f"{where}: cannot simulate: {'; '.join(features)}")
