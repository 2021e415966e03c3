"""The scene that the physics runs: its settings, and the model of hand, object and explicit contact pairs."""

import dataclasses

import mujoco
import numpy as np

from dexsim import contact
from dexsim.config import setting, validate
from dexsim.errors import AssetError, ConfigError
from dexsim.hand import Hand
from dexsim.model_guard import check_model

GEOM_TYPES = {
    "sphere": mujoco.mjtGeom.mjGEOM_SPHERE,
    "box": mujoco.mjtGeom.mjGEOM_BOX,
    "capsule": mujoco.mjtGeom.mjGEOM_CAPSULE,
    "cylinder": mujoco.mjtGeom.mjGEOM_CYLINDER,
    "ellipsoid": mujoco.mjtGeom.mjGEOM_ELLIPSOID,
}


# Primitives that meet a box in closed form with every engine.
_MEETS_BOXES = {"sphere", "capsule", "box"}


@dataclasses.dataclass(frozen=True, kw_only=True)
class PhysicsConfig:
    """Time step, solver and contact model."""

    timestep: float = setting(0.006, unit="s", low=1e-4, high=0.02)
    """One physics sub-step."""
    substeps: int = setting(5, unit="1", low=1, high=200)
    """Sub-steps in one control tick; the control rate is 1 / (timestep * substeps)."""
    iterations: int = setting(3, unit="1", low=1, high=100)
    """Newton iterations of the contact solver."""
    line_search: int = setting(6, unit="1", low=1, high=100)
    """Line-search iterations in each of them."""
    condim: int = setting(3, unit="1", low=1, high=6)
    """Contact dimension between hand and object: 3 sliding, 4 with torsion, 6 with rolling."""
    cone: str = setting("elliptic", choices=("elliptic", "pyramidal"))
    """Friction cone. A pyramid is a linear approximation, and what it holds creeps: at half of what
    friction can bear by 12 to 25 mm/s here (tests/test_contact.py), through the fingers in seconds."""
    friction_ratio: float = setting(20.0, unit="1", low=0.1, high=1000.0)
    """How much harder an elliptic cone resists sliding than penetration (MuJoCo's impratio)."""
    cover: float = setting(0.003, unit="m", low=0.0, high=0.01)
    """Rubber over the fingertips: their geoms, which follow the taxels, touch this far out. Keep it
    equal to `Skin.margin`, so that solver and taxels begin to feel at the same distance."""
    pad_points: int = setting(3, unit="1", low=1, high=8)
    """Spheres in a row that stand for each capsule of a fingertip against the object."""
    tips: str = setting("skin", choices=("skin", "constant"))
    """Stiffness of the fingertips: as the skin's law over the taxels has it, by the tick, which makes
    edges softer than faces; or the same everywhere."""
    settling: float = setting(0.03, unit="s", low=0.005, high=0.2)
    """Time scale on which a contact pushes out what lies in it (at least four time steps)."""
    palm: str = setting("auto", choices=("auto", "face", "box"))
    """Palm as its box, or as a half-space at its face, which carries an object beside the palm, too, but meets every
    primitive in closed form. auto: the box where the object has no cylinder or ellipsoid."""
    contacts: str = setting("closed", choices=("closed", "mjx"))
    """JAX backend only. closed: MJX's rigid bodies with our closed-form contacts and solver, where the
    scene allows (`dexsim.substep`); mjx: `mjx.step` throughout, some six times slower on a CPU."""
    max_contacts: int = setting(20, unit="1", low=4, high=400)
    """Contacts kept per environment (JAX backend: the deepest; Warp: mean over the batch)."""

    def __post_init__(self):
        validate(self)
        if self.condim not in (1, 3, 4, 6):
            raise ConfigError(f"PhysicsConfig.condim = {self.condim}: must be 1, 3, 4 or 6")

    @property
    def control_period(self) -> float:
        """One control tick, s."""
        return self.timestep * self.substeps

    @property
    def pyramid_edges(self) -> int:
        """Edges of a contact's friction pyramid; 0 for an elliptic cone, and without friction."""
        return 2 * (self.condim - 1) if self.cone == "pyramidal" else 0

    @property
    def contact_period(self) -> float:
        """`settling`, s, as far as the time step allows."""
        return max(self.settling, 4 * self.timestep)


def build_model(
    hand: Hand,
    slots: tuple[str, ...],
    largest: np.ndarray,
    config: PhysicsConfig,
    gravity: tuple[float, float, float],
    backend: str,
    *,
    rotor_share: float = 0.0,
) -> mujoco.MjModel:
    """The scene as a C MuJoCo model: hand, free object, explicit pairs, force sensors.

    Also what the tests and the emulated hand compare against.
    """
    spec = mujoco.MjSpec.from_file(str(hand.model_path))
    check_model(spec.compile(), backend, hand.model_path)
    for element in (*spec.actuators, *spec.sensors, *spec.keys):
        spec.delete(element)  # torques come from our actuator model, readings from our sensors
    for joint in spec.joints:
        joint.armature *= 1 - rotor_share
    palm = spec.body(hand.palm)
    palm.pos, palm.quat = [0, 0, 0], [1, 0, 0, 0]
    touching = _touching_geoms(hand, slots, config)
    contact.cover_tips(spec, hand, config.cover)
    touching = contact.split_pads(spec, hand, touching, config.pad_points)
    for geom in spec.geoms:
        geom.contype = geom.conaffinity = 0

    # A template of middling mass: its invweight0 sets the contact stiffness for all objects.
    body = spec.worldbody.add_body(
        name="object", mass=0.1, inertia=[5e-5] * 3, explicitinertial=True, pos=[0.1, 0, 0.1]
    )
    body.add_freejoint(name="object")
    for k, kind in enumerate(slots):
        body.add_geom(
            name=f"object_{k}",
            type=GEOM_TYPES[kind],
            size=largest[k],
            contype=0,
            conaffinity=0,
            mass=0,
            group=3,
            rgba=[0.85, 0.55, 0.25, 1],
        )
        for name in touching:
            spec.add_pair(
                geomname1=name, geomname2=f"object_{k}", condim=config.condim, friction=[0.9, 0.9, 0.005, 1e-4, 1e-4]
            )
    if backend == "warp":
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
        if pair.condim == 1 and spec.option.cone == mujoco.mjtCone.mjCONE_ELLIPTIC:
            # MJX-JAX knows no frictionless contacts beside elliptic cones; this one slides as freely.
            pair.condim, pair.friction = 3, [1e-3, 1e-3, 0.005, 1e-4, 1e-4]
    model = spec.compile()
    geoms = np.flatnonzero(model.geom_bodyid == model.body("object").id)
    pairs = contact.pairs_with(model, geoms)
    compliance, share, _ = contact.pair_constants(model, pairs, tip_bodies(model, hand))
    model.pair_solref[pairs], model.pair_solimp[pairs] = contact.spring(
        compliance, share * contact.NOMINAL, 2.0, 0.9, period=config.contact_period, edges=config.pyramid_edges
    )
    return model


def tip_bodies(model: mujoco.MjModel, hand: Hand) -> np.ndarray:
    """Body ids [F] of the fingertips."""
    return np.array([model.body(hand.body_names[b]).id for b in hand.tip_body])


def _touching_geoms(hand: Hand, slots: tuple[str, ...], config: PhysicsConfig) -> list[str]:
    geoms = [g for g in hand.geoms if g.touches]
    palm = hand.body_names.index(hand.palm)
    kinds = {g.kind for g in geoms if g.body == palm}
    if "plane" in kinds:
        use_box = config.palm == "box" or (config.palm == "auto" and "box" in kinds and set(slots) <= _MEETS_BOXES)
        geoms = [g for g in geoms if g.body != palm or (g.kind != "plane") == use_box]
    if not geoms or any(not g.name for g in geoms):
        raise AssetError(
            f"{hand.model_path}: every geom that touches the object (contype or "
            "conaffinity not 0) needs a name, and there must be at least one"
        )
    return [g.name for g in geoms]


def _set_options(spec: mujoco.MjSpec, config: PhysicsConfig, gravity: tuple[float, float, float], backend: str) -> None:
    option = spec.option
    option.timestep, option.gravity = config.timestep, gravity
    option.integrator = mujoco.mjtIntegrator.mjINT_EULER
    # Without friction the cone is a line, and the JAX backend knows it as a pyramid only.
    elliptic = config.cone == "elliptic" and config.condim > 1
    option.solver = mujoco.mjtSolver.mjSOL_NEWTON
    option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC if elliptic else mujoco.mjtCone.mjCONE_PYRAMIDAL
    option.impratio = config.friction_ratio if elliptic else 1.0
    if elliptic and backend == "warp":
        # Warp builds the Hessian of elliptic cones in one go only where the Jacobian is sparse: a
        # third faster here, though a dense one would fit as well.
        option.jacobian = mujoco.mjtJacobian.mjJAC_SPARSE
    option.iterations, option.ls_iterations = config.iterations, config.line_search
    # Box-box has its own kernel only with nativeccd off; eulerdamp costs a factorisation more.
    option.disableflags |= mujoco.mjtDisableBit.mjDSBL_EULERDAMP | mujoco.mjtDisableBit.mjDSBL_NATIVECCD
    # MJX also offers max_geom_pairs, a cull by bounding spheres. It drops touching pairs of long
    # capsules, one tick this finger, the next tick that one, so it stays off.
    spec.add_numeric(name="max_contact_points", data=[float(config.max_contacts)], size=1)
