"""The MuJoCo model of a trial: the hand with motors and gear play, an object, their contacts.

Each joint is two hinges about one axis. The first is the drive, with the rotor's inertia, friction and the encoder. The
second is the gear play: free within its gap, then stiff. Contacts are springs of given stiffness with elliptic friction
cones; rubber fingertips also have torsional friction. A foreign hand keeps the contacts of its file.
"""

import functools
from typing import NamedTuple

import mujoco
import numpy as np

from dexsim_real.twin.plant.hand_model import HandModel
from dexsim_real.twin.plant.parameters import TrialParameters
from dexsim_real.twin.plant.shapes import ObjectShape

TIMESTEP = 0.0005  # s, of the emulated hand's own model
ROTORS = (8e-4, 4e-4)  # kg m^2, inertia of the strong and the weak motors as seen at the joint
STRONG = 0.8  # Nm, torque limit above which a joint has a strong motor
END_STOP = 300.0  # Nm/rad
_GREASE = 0.02  # Nm s/rad, assumed viscous friction of a gear
_STIFF_FRICTION = (0.002, 1.0)  # solref of dry friction: a sticking joint creeps by less than 1e-3 rad/s
_FAR = 0.2  # m above the palm, where rays start


class Scene:
    """A compiled model and its indices; J joints in the order of the hand, F fingers."""

    def __init__(self, model: mujoco.MjModel, hand: HandModel):
        free, hinges = model.joint("object"), [hand.joints, [f"{name}_play" for name in hand.joints]]
        self.model = model
        drives, plays = (np.array([model.joint(name).id for name in names]) for names in hinges)
        self.drive_qpos, self.drive_dof = model.jnt_qposadr[drives], model.jnt_dofadr[drives]  # each [J]
        self.play_qpos, self.play_dof = model.jnt_qposadr[plays], model.jnt_dofadr[plays]
        self.object_qpos, self.object_dof = int(free.qposadr[0]), int(free.dofadr[0])  # first of seven, of six
        self.object_body = model.body("object").id
        self.tip_site = np.array([model.site(name).id for name in hand.lattices])  # [F] frames of the taxels
        # A foreign fingertip may be of several bodies. Of the own hand's last links only the tip has taxels.
        bodies = model.body_weldid if hand.foreign else np.arange(model.nbody)
        finger = {int(bodies[model.site_bodyid[site]]): f for f, site in enumerate(self.tip_site)}
        # [geoms]: index of the fingertip, -1 for none; whether it is the object's.
        self.finger_of_geom = np.array([finger.get(int(bodies[body]), -1) for body in model.geom_bodyid])
        self.is_object = model.geom_bodyid == self.object_body

    def set_joints(self, data: mujoco.MjData, joints: np.ndarray) -> None:
        """Set the angles [J] rad of the drives, and of the hinges that follow them by an equality."""
        model, data.qpos[self.drive_qpos] = self.model, joints
        for index in np.flatnonzero((model.eq_type == mujoco.mjtEq.mjEQ_JOINT) & (model.eq_obj2id >= 0)):
            follower, drive = model.jnt_qposadr[[model.eq_obj1id[index], model.eq_obj2id[index]]]
            offset, ratio = model.eq_data[index, :2]
            data.qpos[follower] = model.qpos0[follower] + offset + ratio * (data.qpos[drive] - model.qpos0[drive])


def build_scene(hand: HandModel, parameters: TrialParameters, shape: ObjectShape, gravity: np.ndarray) -> Scene:
    """Compile the model of a trial; `gravity` [3] m/s^2 in the palm frame."""
    spec = hand.spec.copy()
    _add_drives(spec, hand, parameters)
    spec.option.gravity = gravity
    if hand.foreign:
        _collide_as_in_the_file(spec, shape)
    else:
        tips = [spec.site(name).parent.name for name in hand.lattices]
        _collide_in_pairs(spec, shape, parameters, tips)
    model = spec.compile()
    set_object(model, parameters)
    scene = Scene(model, hand)
    _set_springs(scene, parameters)
    return scene


def palm_face(scene: Scene, place: np.ndarray) -> float:
    """Height x in m of a foreign palm's surface at a place (y, z) m along it; 0 where there is none."""
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


def add_object(spec: mujoco.MjSpec, shape: ObjectShape) -> None:
    """Add the object as the free body "object", its geoms touching nothing; `set_object` gives it its mass."""
    # Not "simple": its centre of mass leaves its frame when `set_object` moves it.
    body = spec.worldbody.add_body(name="object", pos=[0.5, 0, 0], simple=False)
    body.add_freejoint(name="object")
    for k, part in enumerate(shape.parts):
        size = [*part.size, 0.0, 0.0][:3]
        geom = body.add_geom(name=f"object_{k}", size=size, pos=part.place, quat=part.quat, density=1.0)
        geom.contype = geom.conaffinity = 0
        geom.type = getattr(mujoco.mjtGeom, f"mjGEOM_{part.kind.upper()}")


def set_object(model: mujoco.MjModel, parameters: TrialParameters) -> None:
    """Set mass, inertia and centre of the object: a uniform solid (overlaps count twice), and the trial's errors."""
    body = model.body("object").id
    scale = parameters.mass / model.body_mass[body]
    model.body_mass[body] = parameters.mass
    model.body_inertia[body] *= scale * parameters.inertia_scale
    model.body_ipos[body] += parameters.com_offset
    mujoco.mj_setConst(model, mujoco.MjData(model))


def _add_drives(spec: mujoco.MjSpec, hand: HandModel, parameters: TrialParameters) -> None:
    for j, name in enumerate(hand.joints):
        drive = spec.joint(name)
        drive.armature = parameters.rotor_inertia * ROTORS[0 if hand.torque_limit[j] > STRONG else 1]
        drive.damping = [_GREASE + parameters.viscous_friction[j], 0.0, 0.0]
        drive.frictionloss = 1e-4  # Not 0, so that it has a row in the solver; set at each step.
        drive.solref_friction, drive.solimp_friction[:2] = _STIFF_FRICTION, (0.99, 0.99)
        drive.parent.add_joint(
            name=f"{name}_play",
            type=mujoco.mjtJoint.mjJNT_HINGE,
            axis=drive.axis,
            pos=drive.pos,
            limited=mujoco.mjtLimited.mjLIMITED_TRUE,
            range=[-1, 1],  # set in `_set_springs`: here its unit would be that of the file
            armature=parameters.gear_inertia,
            damping=[2e-4, 0.0, 0.0],
        )


def _collide_as_in_the_file(spec: mujoco.MjSpec, shape: ObjectShape) -> None:
    """Add an object that touches every geom of the hand; of its own it adds no friction, stiffness or damping."""
    bits = functools.reduce(int.__or__, (geom.contype | geom.conaffinity for geom in spec.geoms))
    lowest = min(geom.priority for geom in spec.geoms)
    add_object(spec, shape)
    for geom in spec.body("object").geoms:
        geom.contype = geom.conaffinity = bits
        geom.priority, geom.margin, geom.gap = lowest - 1, 0.0, 0.0
    spec.option.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_GRAVITY)
    # What is held falls asleep, and would hang in the air when it is let go.
    spec.option.enableflags &= ~int(mujoco.mjtEnableBit.mjENBL_SLEEP)


def _collide_in_pairs(spec: mujoco.MjSpec, shape: ObjectShape, parameters: TrialParameters, tips: list[str]) -> None:
    """Put rubber on the fingertips, and add an object that touches the hand's colliding geoms."""
    add_object(spec, shape)
    for geom in [g for g in spec.geoms if g.contype or g.conaffinity]:
        geom.contype = geom.conaffinity = 0
        if geom.type == mujoco.mjtGeom.mjGEOM_PLANE:
            continue
        slide, twist, roll = parameters.link_friction, 1e-4, 1e-5
        rubber = geom.parent.name in tips
        if rubber:
            geom.size = [geom.size[0] + parameters.rubber, *geom.size[1:]]
            slide = parameters.friction
            twist, roll = parameters.torsion * slide, parameters.rolling * slide
        for k in range(len(shape.parts)):
            spec.add_pair(
                geomname1=geom.name,
                geomname2=f"object_{k}",
                condim=6 if rubber else 4,
                friction=[slide, slide, twist, roll, roll],
            )
    option = spec.option
    option.timestep, option.integrator = TIMESTEP, mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    option.cone, option.impratio = mujoco.mjtCone.mjCONE_ELLIPTIC, parameters.cone_ratio
    option.solver, option.iterations, option.tolerance = mujoco.mjtSolver.mjSOL_NEWTON, 30, 1e-9


def spring(inverse_mass: float, stiffness: float, damping: float, step: float) -> tuple[np.ndarray, np.ndarray]:
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
      step: s.
    """
    loss = min(0.5, (0.7 / (damping * inverse_mass * step)) ** 2)
    loss = max(loss, 0.02)
    impedance = 1 - loss
    soft = inverse_mass * loss / impedance
    damping = min(damping / loss**0.5, 0.7 / (impedance * soft * step))
    # In the direct format these are divided by the impedance, the first twice, and d k r has one of its own.
    return (
        np.array([-stiffness * soft * impedance, -damping * soft * impedance]),
        np.array([impedance, impedance, 0.001, 0.5, 2.0]),
    )


def damping_of(restitution: float, stiffness: float, mass: float) -> float:
    """Damping N s/m of a contact spring N/m with this coefficient of restitution for a mass in kg.

    x'' + 2 z x' + x = 0 from x' = 1 until the force is no longer repulsive: the outgoing speed is
    exp(-2 z arccosh(z) / sqrt(z^2 - 1)), by analytic continuation below z = 1 as well.
    """
    ratio = np.linspace(0.025, 6.0, 300, dtype=complex)  # not 1, where it is 0 / 0
    outgoing = np.exp(-2 * ratio * np.arccosh(ratio) / np.sqrt(ratio**2 - 1)).real
    return float(2 * np.interp(restitution, outgoing[::-1], ratio.real[::-1]) * np.sqrt(stiffness * mass))


def _set_springs(scene: Scene, parameters: TrialParameters) -> None:
    """Set the springs of the contacts in pairs, of the gear plays and of the end stops."""
    model, step = scene.model, scene.model.opt.timestep
    for p in range(model.npair):
        ends = [model.pair_geom1[p], model.pair_geom2[p]]
        if not scene.is_object[ends].any():  # A pair of the file, of two fingers.
            continue
        rubber = scene.finger_of_geom[ends].max() >= 0
        stiffness = parameters.stiffness_contact if rubber else parameters.palm_stiffness
        inverse_mass = float(model.body_invweight0[model.geom_bodyid[ends], 0].sum())
        damping = damping_of(parameters.restitution, stiffness, parameters.mass)
        model.pair_solref[p], model.pair_solimp[p] = spring(inverse_mass, stiffness, damping, step)
    half = np.maximum(parameters.gear_play, 1e-6) / 2
    model.jnt_range[model.dof_jntid[scene.play_dof]] = np.stack([-half, half], -1)
    for dofs, stiffness in ((scene.play_dof, parameters.gear_stiffness), (scene.drive_dof, END_STOP)):
        for dof in dofs:
            inverse_mass, joint = float(model.dof_invweight0[dof]), model.dof_jntid[dof]
            damping = 2 * np.sqrt(stiffness / inverse_mass)
            model.jnt_solref[joint], model.jnt_solimp[joint] = spring(inverse_mass, stiffness, damping, step)


class TipContact(NamedTuple):
    """One contact of object and fingertip; palm frame, forces act on the finger."""

    finger: int
    point: np.ndarray  # [3] m
    normal: np.ndarray  # [3] N
    tangent: np.ndarray  # [3] N


def tip_contacts(scene: Scene, data: mujoco.MjData) -> list[TipContact]:
    """Contacts of the object with the fingertips in the state `data`, from MuJoCo's solver."""
    contacts, wrench = [], np.zeros(6)
    for i in range(data.ncon):
        first, second = data.contact.geom[i]
        finger = max(scene.finger_of_geom[first], scene.finger_of_geom[second])
        if finger < 0 or not (scene.is_object[first] or scene.is_object[second]):
            continue
        mujoco.mj_contactForce(scene.model, data, i, wrench)
        # The frame's first row points from the first geom to the second, which feels the force.
        frame = data.contact.frame[i].reshape(3, 3)
        sign = 1.0 if scene.is_object[first] else -1.0
        normal, tangent = sign * wrench[0] * frame[0], sign * wrench[1:3] @ frame[1:]
        contacts.append(TipContact(int(finger), data.contact.pos[i].copy(), normal, tangent))
    return contacts


def tip_forces(contacts: list[TipContact], fingers: int) -> tuple[np.ndarray, np.ndarray]:
    """Force [F, 3] N on each fingertip, and its part [F] N along the sum of the fingertip's contact normals."""
    force, inward = np.zeros((fingers, 3)), np.zeros((fingers, 3))
    for contact in contacts:
        force[contact.finger] += contact.normal + contact.tangent
        inward[contact.finger] += contact.normal
    # One direction stands for the whole fingertip, as in simulation.
    length = np.maximum(np.linalg.norm(inward, axis=-1), 1e-12)
    return force, np.maximum((force * inward).sum(-1) / length, 0.0)
