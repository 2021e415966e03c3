"""The scene that the physics runs: hand, object and explicit contact pairs in one MuJoCo model."""

import re
from pathlib import Path

import mujoco
import numpy as np

from dexsim.errors import AssetError
from dexsim.hand.description import Hand
from dexsim.hand.mjcf import disabled, read_mjcf
from dexsim.physics import contact
from dexsim.physics.config import PhysicsConfig
from dexsim.physics.interface import PhysicsScene
from dexsim.touch.skin import Skin

# Newton iterations and evaluations of a line search with which forces have converged. c and cuda stop by themselves,
# mjx computes all of them. With 6 evaluations C MuJoCo's forces were off by up to 28 N in grips, with 20 by 0.5 N where
# boxes land.
CONVERGED = {"c": (20, 50), "cuda": (10, 10), "mjx": (10, 10)}
_MJX_CONTACTS = 20
"""Contacts that MJX keeps in an environment, the deepest: memory and time grow with them."""
_FRICTION_RATIO = 20.0
"""How much harder a contact resists sliding than penetration (MuJoCo's impratio)."""


def build_scene(
    hand: Hand,
    slots: tuple[str, ...],
    largest: np.ndarray,
    config: PhysicsConfig,
    gravity: tuple[float, float, float],
    backend: str,
    pad_thickness: float = Skin.margin,
) -> PhysicsScene:
    """The scene for an engine: hand, free object, explicit pairs, force sensors, and the addresses of what changes in
    the model. `pad_thickness` is in m. Raises AssetError: the backend cannot simulate the hand's MJCF, or it does not
    go into one scene with the object."""
    check_model(mujoco.MjModel.from_xml_path(str(hand.model_path)), hand.model_path)
    spec = read_mjcf(hand)  # torques come from our actuator model, readings from our sensors
    touching = _touching_geoms(hand, slots)
    contact.thicken_tips(spec, hand, pad_thickness)
    touching = contact.split_pads(spec, hand, touching)
    for geom in spec.geoms:
        geom.contype = geom.conaffinity = 0

    plain = mujoco.MjSpec()  # Its defaults are MuJoCo's: those of the hand's file are for the hand.
    # A template of middling mass: its invweight0 sets the contact stiffness for all objects.
    inertial = {"mass": 0.1, "inertia": [5e-5] * 3, "explicitinertial": True}
    body = spec.worldbody.add_body(name="object", pos=[0.1, 0, 0.1], **inertial)
    body.add_freejoint(name="object")
    for k, kind in enumerate(slots):
        body.add_geom(
            plain.default,
            name=f"object_{k}",
            type=getattr(mujoco.mjtGeom, f"mjGEOM_{kind.upper()}"),
            size=largest[k],
            contype=0,
            conaffinity=0,
            mass=0,
            group=3,
            rgba=[0.85, 0.55, 0.25, 1],
        )
        for name in touching:
            friction = [0.9, 0.9, 0.005, 1e-4, 1e-4]
            spec.add_pair(plain.default, geomname1=name, geomname2=f"object_{k}", condim=3, friction=friction)
    if backend != "mjx":  # it has no sensor that matches bodies
        for b in hand.tip_body:
            # data: bit 1 is the force; reduce: 3 is the net force, in the world frame.
            spec.add_sensor(
                type=mujoco.mjtSensor.mjSENS_CONTACT,
                objtype=mujoco.mjtObj.mjOBJ_BODY,
                objname=hand.body_names[b],
                reftype=mujoco.mjtObj.mjOBJ_BODY,
                refname="object",
                intprm=[2, 3, 1],
                dim=3,
            )
    _set_options(spec, config, gravity, backend)
    for pair in spec.pairs:
        if pair.condim == 1:
            # MJX has no frictionless contacts with elliptic cones; this friction is negligible.
            pair.condim, pair.friction = 3, [1e-3, 1e-3, 0.005, 1e-4, 1e-4]
    try:
        model = spec.compile()
    except ValueError as error:
        raise AssetError(f"{hand.model_path}: with the object in the scene: {' '.join(str(error).split())}") from None
    joints, free = [model.joint(name) for name in hand.joint_names], model.joint("object")
    geoms = np.array([model.geom(f"object_{k}").id for k in range(len(slots))])
    pairs = contact.pairs_with(model, geoms)
    tips = np.array([model.body(hand.body_names[b]).id for b in hand.tip_body])
    compliance, share, _ = contact.pair_constants(model, pairs, tips)
    model.pair_solref[pairs], model.pair_solimp[pairs] = contact.spring(compliance, share * contact.NOMINAL, 2.0)
    rubber, growth = contact.rubber_geoms(model, pairs, tips)
    return PhysicsScene(
        hand=hand,
        config=config,
        slots=slots,
        model=model,
        joint_qpos=np.array([joint.qposadr[0] for joint in joints]),
        joint_dof=np.array([joint.dofadr[0] for joint in joints]),
        object_qpos=np.arange(free.qposadr[0], free.qposadr[0] + 7),
        object_dof=np.arange(free.dofadr[0], free.dofadr[0] + 6),
        object_body=model.body("object").id,
        object_geoms=geoms,
        object_pairs=pairs,
        tip_bodies=tips,
        tip_geoms=rubber,
        tip_growth=growth,
    )


def _touching_geoms(hand: Hand, slots: tuple[str, ...]) -> list[str]:
    geoms = [g for g in hand.geoms if g.touches]
    palm = hand.body_names.index(hand.palm)
    kinds = {g.kind for g in geoms if g.body == palm}
    if "plane" in kinds:
        # The half-space at the palm's face collides with every primitive in closed form, but also supports objects
        # next to the palm. The palm's box is exact, and every engine has a closed form for it with boxes only.
        use_box = "box" in kinds and set(slots) <= {"box"}
        geoms = [g for g in geoms if g.body != palm or (g.kind != "plane") == use_box]
    if not geoms or any(not g.name for g in geoms):
        raise AssetError(
            f"{hand.model_path}: every geom that touches the object (contype or "
            "conaffinity not 0) needs a name, and there must be at least one"
        )
    return [g.name for g in geoms]


def _set_options(spec: mujoco.MjSpec, config: PhysicsConfig, gravity: tuple[float, float, float], backend: str) -> None:
    spec.option = mujoco.MjSpec().option  # tolerances, flags: none of the hand's file
    option = spec.option
    option.timestep, option.gravity = config.timestep, gravity
    option.integrator = mujoco.mjtIntegrator.mjINT_EULER
    option.solver = mujoco.mjtSolver.mjSOL_NEWTON
    # A pyramid approximates the cone, and objects creep through the fingers at 12 to 25 mm/s with it.
    option.cone, option.impratio = mujoco.mjtCone.mjCONE_ELLIPTIC, _FRICTION_RATIO
    option.iterations, option.ls_iterations = CONVERGED[backend]
    option.iterations = config.iterations or option.iterations
    option.disableflags |= mujoco.mjtDisableBit.mjDSBL_EULERDAMP  # it costs a factorisation more
    # A capsule over a cylinder's rim: the search for more than one contact answers with two at the same place, along
    # the cylinder's axis instead of away from it, and too shallow.
    option.disableflags |= mujoco.mjtDisableBit.mjDSBL_MULTICCD
    if backend != "c":
        # In MJX box-box has its own kernel only with nativeccd off. C MuJoCo has it anyway, and its older convex
        # collisions find contacts of a capsule on a cylinder that are millimetres too deep.
        option.disableflags |= mujoco.mjtDisableBit.mjDSBL_NATIVECCD
    # MJX also offers max_geom_pairs, a cull by bounding spheres. It drops touching pairs of long
    # capsules, one tick this finger, the next tick that one, so it stays off.
    for own in [numeric for numeric in spec.numerics if numeric.name in ("max_contact_points", "max_geom_pairs")]:
        spec.delete(own)
    spec.add_numeric(name="max_contact_points", data=[_MJX_CONTACTS], size=1)


def check_model(model: mujoco.MjModel, where: str | Path = "model") -> None:
    """Raise AssetError naming every feature of a hand that our scene drops or MJX silently ignores: a policy trained on
    such a model would be for a hand that does not exist."""
    option, motors = model.opt, np.isin(model.actuator_dyntype, (mujoco.mjtDyn.mjDYN_DCMOTOR, mujoco.mjtDyn.mjDYN_PID))
    features = {
        "actuator delay": np.c_[model.actuator_delay, model.actuator_history[:, 0]],
        "actuator armature": model.actuator_armature,
        "actuator damping": np.c_[model.actuator_damping, model.actuator_dampingpoly],
        "dcmotor or pid actuators": motors,
        "sensor delay or interval": np.c_[model.sensor_delay, model.sensor_history[:, 0], model.sensor_interval],
        "tactile sensors": model.sensor_type == mujoco.mjtSensor.mjSENS_TACTILE,
        "polynomial joint stiffness": model.jnt_stiffnesspoly,
        "polynomial joint damping": model.dof_dampingpoly,
        "plugins": model.nplugin,
        "flex bodies": model.nflex,
        "SDF geoms": model.geom_type == mujoco.mjtGeom.mjGEOM_SDF,
        "fluid forces (density, viscosity, wind)": np.append(option.wind, (option.density, option.viscosity)),
        "noslip iterations": option.noslip_iterations,
        "names object, object_0, … (reserved)": re.search(rb"\0object(_\d+)?\0", model.names) is not None,
        disabled(option): disabled(option),
        "flag override": option.enableflags & mujoco.mjtEnableBit.mjENBL_OVERRIDE,
    }
    if there := [name for name, values in features.items() if np.any(values)]:
        raise AssetError(f"{where}: cannot simulate: {'; '.join(there)}")
