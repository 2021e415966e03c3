"""The MuJoCo model of a trial: the hand with gear play, an object, their contacts.

Each joint is two hinges about one axis. The first is the drive, with the rotor's inertia, friction and the encoder. The
second is the gear play: free within its gap, then stiff. Contacts are springs of given stiffness with elliptic friction
cones; rubber fingertips also have torsional friction.
"""

import dataclasses
import functools

import mujoco
import numpy as np

from dexsim.hand.kinematics import Hand
from dexsim_real.core.errors import HandError
from dexsim_real.twin.plant.parameters import TrialParameters
from dexsim_real.twin.plant.shapes import ObjectShape

TIMESTEP = 0.0005  # s
ROTORS = (8e-4, 4e-4)  # kg m^2, inertia of the strong and the weak motors as seen at the joint
STRONG = 0.8  # Nm, torque limit above which a joint has a strong motor
END_STOP = 300.0  # Nm/rad
_GREASE = 0.02  # Nm s/rad, assumed viscous friction of a gear
_STIFF_FRICTION = (0.002, 1.0)  # solref of dry friction: a sticking joint creeps by less than 1e-3 rad/s
_KINDS = {
    "sphere": mujoco.mjtGeom.mjGEOM_SPHERE,
    "box": mujoco.mjtGeom.mjGEOM_BOX,
    "cylinder": mujoco.mjtGeom.mjGEOM_CYLINDER,
    "capsule": mujoco.mjtGeom.mjGEOM_CAPSULE,
}


@dataclasses.dataclass(frozen=True)
class Scene:
    """A compiled model and its indices; J joints in the order of the hand, F fingers."""

    model: mujoco.MjModel
    drive_qpos: np.ndarray  # [J]
    drive_dof: np.ndarray  # [J]
    play_qpos: np.ndarray | None  # [J], None without gear play
    play_dof: np.ndarray | None  # [J]
    object_qpos: int  # first of seven
    object_dof: int  # first of six
    object_body: int
    tip_site: np.ndarray  # [F] at the frames in which the hand gives the taxels
    finger_of_geom: np.ndarray  # [geoms] index of the fingertip, -1 for none
    is_object: np.ndarray  # [geoms] bool


def build_scene(hand: Hand, parameters: TrialParameters, shape: ObjectShape | None, gravity: np.ndarray) -> Scene:
    """Compile the model of a trial.

    Args:
      hand: only its geometry, joint ranges and torque limits are used.
      parameters: of the trial.
      shape: of the object; None for the hand alone, with a body without geometry in its place.
      gravity: [3] m/s^2, palm frame.

    Raises:
      HandError: the hand has coupled joints.
    """
    if hand.num_hinges > hand.num_joints:
        raise HandError(f"{hand.model_path}: the emulated hand has gear play, which coupled joints cannot have")
    spec = mujoco.MjSpec.from_file(str(hand.model_path))
    for element in (*spec.actuators, *spec.sensors, *spec.keys):
        spec.delete(element)
    spec.option = mujoco.MjSpec().option  # With the file's flags gravity or contacts could be off.
    _place(spec, hand.palm)
    for body in hand.tip_body:
        spec.body(hand.body_names[body]).add_site(name=f"{hand.body_names[body]}_taxels")
    _add_play(spec, hand, parameters)
    skins = _cover(spec, hand, parameters)
    add_object(spec, parameters, shape)
    _add_pairs(spec, shape, parameters, skins)
    option = spec.option
    option.timestep, option.gravity = TIMESTEP, gravity
    option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    option.cone, option.impratio = mujoco.mjtCone.mjCONE_ELLIPTIC, float(parameters.cone_ratio)
    option.solver, option.iterations, option.tolerance = mujoco.mjtSolver.mjSOL_NEWTON, 30, 1e-9
    model = spec.compile()
    _set_springs(model, parameters, skins)
    return _index(model, hand)


def _place(spec: mujoco.MjSpec, palm: str) -> None:
    """Move the hand so that its palm is the world's origin, wherever its file places it."""
    root = spec.body(palm)
    while root.parent != spec.worldbody:
        root = root.parent
    root.pos, root.quat, root.alt.type = [0, 0, 0], [1, 0, 0, 0], mujoco.mjtOrientation.mjORIENTATION_QUAT
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    if np.array_equal(data.body(palm).xpos, np.zeros(3)) and np.array_equal(data.body(palm).xquat, [1, 0, 0, 0]):
        return
    place = data.body(root.name).xpos, data.body(root.name).xquat
    for back in (
        data.body(palm),
        data.body(root.name),
    ):  # In its frame F the root belongs at F^-1 X^-1 F, X the palm's.
        inverse, moved = (np.empty(3), np.empty(4)), (np.empty(3), np.empty(4))
        mujoco.mju_negPose(*inverse, back.xpos, back.xquat)
        mujoco.mju_mulPose(*moved, *inverse, *place)
        place = moved
    root.pos, root.quat = place


def _add_play(spec: mujoco.MjSpec, hand: Hand, parameters: TrialParameters) -> None:
    for j, name in enumerate(hand.joint_names):
        drive, strong = spec.joint(name), hand.torque_limit[j] > STRONG
        drive.armature = float(parameters.rotor_inertia) * ROTORS[0 if strong else 1]
        drive.damping = _fill(drive.damping, _GREASE + float(parameters.viscous_friction[j]))
        drive.frictionloss = 1e-4  # Not 0, so that it has a row in the solver; set at each step.
        drive.solref_friction, drive.solimp_friction[:2] = _STIFF_FRICTION, (0.99, 0.99)
        half = max(float(parameters.gear_play[j]), 1e-6) / 2
        play = drive.parent.add_joint(
            name=f"{name}_play",
            type=mujoco.mjtJoint.mjJNT_HINGE,
            axis=drive.axis,
            pos=drive.pos,
            range=[-half, half],
            armature=float(parameters.gear_inertia),
        )
        play.damping = _fill(play.damping, 2e-4)


def _fill(value, number: float):
    """Damping of a joint, which is a number or the coefficients of a polynomial."""
    if np.ndim(value) == 0:
        return number
    filled = np.zeros_like(value)
    filled[0] = number
    return filled


def _cover(spec: mujoco.MjSpec, hand: Hand, parameters: TrialParameters) -> dict[str, bool]:
    """Put rubber on the fingertips; returns the names of the colliding geoms, and whether they have rubber."""
    tips = {hand.body_names[b] for b in hand.tip_body}
    names = {}
    for geom in spec.geoms:
        touches = bool(geom.contype or geom.conaffinity) and geom.type != mujoco.mjtGeom.mjGEOM_PLANE
        geom.contype = geom.conaffinity = 0
        if touches:
            names[geom.name] = geom.parent.name in tips
            if names[geom.name]:
                geom.size = [geom.size[0] + float(parameters.rubber), *geom.size[1:]]
    return names


def add_object(spec: mujoco.MjSpec, parameters: TrialParameters, shape: ObjectShape | None) -> None:
    """Add the object as the free body "object", its geoms touching nothing."""
    body = spec.worldbody.add_body(name="object", pos=[0.5, 0, 0])
    body.add_freejoint(name="object")
    if shape is None:
        body.explicitinertial, body.mass, body.inertia = True, 0.1, [1e-5] * 3
        return
    mass, centre, inertia = mass_properties(shape, float(parameters.mass))
    body.explicitinertial, body.mass, body.ipos = True, mass, centre + parameters.com_offset
    # Diagonal because of the symmetry of the shapes.
    body.inertia = np.diag(inertia) * float(parameters.inertia_scale)
    for k, part in enumerate(shape.parts):
        body.add_geom(
            name=f"object_{k}",
            type=_KINDS[part.kind],
            size=_three(part.size),
            pos=part.place,
            contype=0,
            conaffinity=0,
            mass=0,
        )


def _three(size: tuple[float, ...]) -> list[float]:
    return [*size, 0.0, 0.0][:3]


@functools.lru_cache(maxsize=64)
def _solid(shape: ObjectShape) -> tuple[float, np.ndarray, np.ndarray]:
    """Mass, centre and inertia about the centre of a uniform solid of density 1, from MuJoCo's compiler."""
    spec = mujoco.MjSpec()
    body = spec.worldbody.add_body(name="solid")
    for part in shape.parts:
        body.add_geom(type=_KINDS[part.kind], size=_three(part.size), pos=part.place, density=1.0)
    spec.compiler.boundmass = 0
    model = spec.compile()
    flat = np.empty(9)
    mujoco.mju_quat2Mat(flat, model.body_iquat[1])
    turn = flat.reshape(3, 3)
    return float(model.body_mass[1]), model.body_ipos[1].copy(), turn @ np.diag(model.body_inertia[1]) @ turn.T


def mass_properties(shape: ObjectShape, mass: float) -> tuple[float, np.ndarray, np.ndarray]:
    """Mass kg, centre [3] m and inertia [3, 3] kg m^2 of a uniform solid of this shape (overlaps count twice)."""
    volume, centre, inertia = _solid(shape)
    return mass, centre, inertia * mass / volume


def _add_pairs(
    spec: mujoco.MjSpec, shape: ObjectShape | None, parameters: TrialParameters, skins: dict[str, bool]
) -> None:
    for k in range(len(shape.parts) if shape else 0):
        for name, rubber in skins.items():
            slide = float(parameters.friction if rubber else parameters.link_friction)
            twist = float(parameters.torsion) * slide if rubber else 1e-4
            roll = float(parameters.rolling) * slide if rubber else 1e-5
            spec.add_pair(
                geomname1=name,
                geomname2=f"object_{k}",
                condim=6 if rubber else 4,
                friction=[slide, slide, twist, roll, roll],
            )


# --- stiffness -----------------------------------------------------------------------------------


def spring(inverse_mass: float, stiffness: float, damping: float) -> tuple[np.ndarray, np.ndarray]:
    """solref and solimp of a constraint whose force at rest is `stiffness` r, for a penetration r.

    A constraint of impedance d and regularisation R = A (1 - d) / d gives a force (d k r + b v + a_0) / (A + R), a_0
    being the acceleration without it: d k r / R at rest, and a motion x'' = -d (d k x + b x') by itself
    (documentation, chapter Computation, section Constraint model). So k follows from the stiffness at rest, at which
    the motion by itself is that of a spring softer by 1 - d, and b is set for the damping ratio asked for in that
    motion. d is just large enough that the explicit damping is stable for a step: d b dt <= 0.7.

    Args:
      inverse_mass: A in 1/kg (or 1/(kg m^2)), MuJoCo's estimate for the two bodies.
      stiffness: N/m (Nm/rad).
      damping: N s/m (Nm s/rad) for this stiffness.
    """
    loss = min(0.5, (0.7 / (damping * inverse_mass * TIMESTEP)) ** 2)
    loss = max(loss, 0.02)
    impedance = 1 - loss
    soft = inverse_mass * loss / impedance
    damping = min(damping / loss**0.5, 0.7 / (impedance * soft * TIMESTEP))
    # In the direct format these are divided by the impedance, the first twice, and d k r has one of its own.
    return (
        np.array([-stiffness * soft * impedance, -damping * soft * impedance]),
        np.array([impedance, impedance, 0.001, 0.5, 2.0]),
    )


@functools.lru_cache(maxsize=1)
def _bounces() -> tuple[np.ndarray, np.ndarray]:
    """Damping ratios z and their coefficients of restitution, by integrating a bounce.

    x'' + 2 z x' + x = 0 from x' = 1 until the force 2 z x' + x is no longer repulsive.
    """
    ratios = np.linspace(0.02, 6.0, 300)
    position, speed = np.zeros_like(ratios), np.ones_like(ratios)
    leaving, step = np.zeros_like(ratios), 0.002
    done = np.zeros(ratios.shape, bool)
    for _ in range(20000):
        force = -(2 * ratios * speed + position)
        now = ~done & (force >= 0) & (speed < 0)
        leaving[now], done = -speed[now], done | now
        if done.all():
            break
        speed = np.where(done, speed, speed + step * force)
        position = np.where(done, position, position + step * speed)
    return ratios, leaving


def damping_of(restitution: float, stiffness: float, mass: float) -> float:
    """Damping N s/m of a contact spring N/m with this coefficient of restitution for a mass in kg."""
    ratios, outcome = _bounces()
    ratio = np.interp(restitution, outcome[::-1], ratios[::-1])
    return float(2 * ratio * np.sqrt(stiffness * mass))


def _set_springs(model: mujoco.MjModel, parameters: TrialParameters, skins: dict[str, bool]) -> None:
    mass, restitution = float(parameters.mass), float(parameters.restitution)
    for p in range(model.npair):
        ids = (model.pair_geom1[p], model.pair_geom2[p])
        names = [model.geom(g).name for g in ids]
        ours = [name for name in names if name in skins]
        if not any(name.startswith("object_") for name in names):
            continue
        stiffness = float(parameters.stiffness_contact if skins[ours[0]] else parameters.palm_stiffness)
        inverse_mass = float(model.body_invweight0[model.geom_bodyid[list(ids)], 0].sum())
        damping = damping_of(restitution, stiffness, mass)
        model.pair_solref[p], model.pair_solimp[p] = spring(inverse_mass, stiffness, damping)
    for j in range(model.njnt):
        if model.joint(j).name.endswith("_play"):
            inverse_mass = float(model.dof_invweight0[model.jnt_dofadr[j]])
            stiffness = float(parameters.gear_stiffness)
            model.jnt_solref[j], model.jnt_solimp[j] = spring(
                inverse_mass, stiffness, 2 * np.sqrt(stiffness / inverse_mass)
            )
        elif model.jnt_limited[j]:  # the drive's end stops
            inverse_mass = float(model.dof_invweight0[model.jnt_dofadr[j]])
            model.jnt_solref[j], model.jnt_solimp[j] = spring(
                inverse_mass, END_STOP, 2 * np.sqrt(END_STOP / inverse_mass)
            )


def _index(model: mujoco.MjModel, hand: Hand) -> Scene:
    drives = [model.joint(name) for name in hand.joint_names]
    plays = [model.joint(f"{name}_play") for name in hand.joint_names]
    tips = [hand.body_names[b] for b in hand.tip_body]
    finger = {model.body(name).id: f for f, name in enumerate(tips)}
    free, body = model.joint("object"), model.body("object").id
    return Scene(
        model=model,
        drive_qpos=np.array([j.qposadr[0] for j in drives]),
        drive_dof=np.array([j.dofadr[0] for j in drives]),
        play_qpos=np.array([j.qposadr[0] for j in plays]),
        play_dof=np.array([j.dofadr[0] for j in plays]),
        object_qpos=int(free.qposadr[0]),
        object_dof=int(free.dofadr[0]),
        object_body=body,
        tip_site=np.array([model.site(f"{name}_taxels").id for name in tips]),
        finger_of_geom=np.array([finger.get(int(b), -1) for b in model.geom_bodyid]),
        is_object=model.geom_bodyid == body,
    )
