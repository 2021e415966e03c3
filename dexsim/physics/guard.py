"""A guard against MJCF features that a physics backend silently ignores or lacks.

MJX accepts several features and computes as if they were not there (delays, actuator armature
and damping, polynomial damping, the tactile sensor). A model that relies on them would train a
policy for a hand that does not exist, so it is refused, by name.
"""

from pathlib import Path

import mujoco
import numpy as np

from dexsim.core.errors import AssetError

_PHYSICS = ("constraint", "equality", "frictionloss", "limit", "contact", "spring", "damper")
"""Flags that say what a hand is like; gravity is the task's, and others say how MuJoCo works it out."""
_UNSUPPORTED_COLLISIONS = {
    ("cylinder", "box"),
    ("cylinder", "mesh"),
    ("ellipsoid", "box"),
    ("ellipsoid", "mesh"),
}


def check_model(model: mujoco.MjModel, backend: str, where: str | Path = "model") -> None:
    """Raise AssetError naming every feature of `model` that `backend` ignores or lacks."""
    problems = _ignored(model) + _LACKING[backend](model)
    if problems:
        raise AssetError(f"{where}: backend {backend} cannot simulate: {'; '.join(problems)}")


def _names(model: mujoco.MjModel, kind: str, rows: np.ndarray) -> str:
    accessor = getattr(model, kind)
    return ", ".join(accessor(int(i)).name or f"#{int(i)}" for i in rows)


def _ignored(model: mujoco.MjModel) -> list[str]:
    """Features that both backends, or our own actuator model in their place, would drop."""
    features = []

    def note(kind: str, feature: str, mask: np.ndarray) -> None:
        rows = np.flatnonzero(mask)
        if rows.size:
            features.append(f"{feature} ({kind} {_names(model, kind, rows)})")

    note("actuator", "actuator delay", (model.actuator_delay > 0) | (model.actuator_history[:, 0] > 0))
    note("actuator", "actuator armature", model.actuator_armature != 0)
    note("actuator", "actuator damping", (model.actuator_damping != 0) | _any_row(model.actuator_dampingpoly))
    for kind, value in (("dcmotor", mujoco.mjtDyn.mjDYN_DCMOTOR), ("pid", mujoco.mjtDyn.mjDYN_PID)):
        note("actuator", f"{kind} actuator", model.actuator_dyntype == value)
    note(
        "sensor",
        "sensor delay or interval",
        (model.sensor_delay > 0) | (model.sensor_history[:, 0] > 0) | _any_row(model.sensor_interval),
    )
    note("sensor", "tactile sensor", model.sensor_type == mujoco.mjtSensor.mjSENS_TACTILE)
    note("sensor", "plugin sensor", model.sensor_type == mujoco.mjtSensor.mjSENS_PLUGIN)
    note("joint", "polynomial joint stiffness", _any_row(model.jnt_stiffnesspoly))
    poly = _any_row(model.dof_dampingpoly)
    joints = np.zeros(model.njnt, bool)
    joints[model.dof_jntid[poly]] = True
    note("joint", "polynomial joint damping", joints)
    if model.nplugin:
        features.append("plugins")
    if model.nflex:
        features.append("flex bodies")
    if np.any(model.geom_type == mujoco.mjtGeom.mjGEOM_SDF):
        features.append("SDF geoms")
    if model.opt.density or model.opt.viscosity or np.any(model.opt.wind):
        features.append("fluid forces (density, viscosity, wind)")
    if model.opt.noslip_iterations:
        features.append("noslip iterations")
    off = [f for f in _PHYSICS if model.opt.disableflags & int(getattr(mujoco.mjtDisableBit, f"mjDSBL_{f.upper()}"))]
    if off:
        features.append(f"flags that disable {', '.join(off)}")
    if model.opt.enableflags & mujoco.mjtEnableBit.mjENBL_OVERRIDE:
        features.append("flag override")
    return features


def _lacking_jax(model: mujoco.MjModel) -> list[str]:
    features = []
    contact = model.sensor_type == mujoco.mjtSensor.mjSENS_CONTACT
    body_like = (mujoco.mjtObj.mjOBJ_BODY, mujoco.mjtObj.mjOBJ_XBODY, mujoco.mjtObj.mjOBJ_SITE)
    matched = contact & (np.isin(model.sensor_objtype, body_like) | np.isin(model.sensor_reftype, body_like))
    net = contact & (model.sensor_intprm[:, 1] == 3)
    for feature, mask in (
        ("contact sensor that matches bodies", matched),
        ("contact sensor with reduce=netforce", net),
    ):
        rows = np.flatnonzero(mask)
        if rows.size:
            features.append(f"{feature} (sensor {_names(model, 'sensor', rows)})")
    if model.opt.integrator == mujoco.mjtIntegrator.mjINT_DISCRETE:
        features.append("integrator discrete")
    if model.opt.solver == mujoco.mjtSolver.mjSOL_PGS:
        features.append("solver PGS")
    for first, second in _colliding_kinds(model):
        if {(first, second), (second, first)} & _UNSUPPORTED_COLLISIONS:
            features.append(f"collision {first}-{second}")
    return features


def _lacking_warp(model: mujoco.MjModel) -> list[str]:
    features = []
    if model.opt.solver == mujoco.mjtSolver.mjSOL_PGS:
        features.append("solver PGS")
    return features


# What the CUDA kernel lacks of a scene, it says itself (`dexsim.physics.cuda.scene.check_scene`).
_LACKING = {"jax": _lacking_jax, "warp": _lacking_warp, "c": lambda model: [], "cuda": lambda model: []}


def _any_row(values: np.ndarray) -> np.ndarray:
    return np.any(values != 0, axis=tuple(range(1, values.ndim)))


def _colliding_kinds(model: mujoco.MjModel) -> set[tuple[str, str]]:
    def kind(geom: int) -> str:
        return mujoco.mjtGeom(model.geom_type[geom]).name.removeprefix("mjGEOM_").lower()

    return {(kind(a), kind(b)) for a, b in zip(model.pair_geom1, model.pair_geom2, strict=True)}
