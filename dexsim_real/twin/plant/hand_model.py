"""The body of the emulated hand: links, inertias and geoms from an MJCF, in the palm frame.

The hand's own MJCF (`own_model`), or one by somebody else (`read_model`), which need not have its names: joints are
found by name, or by the order of the actuators; the palm is the site "palm", or the body that carries all of them; a
fingertip is the site on the body that the finger's last joint moves. The motors are the emulated hand's in both cases.
"""

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import mujoco
import numpy as np

from dexsim.hand.description import Hand
from dexsim.hand.kinematics import finger_bodies
from dexsim.hand.mjcf import disabled, hand_poses, quaternion, read_mjcf
from dexsim_real.core.errors import HandError

PREFIX = "plant/"  # of all names of the MJCF
_RANGE = 0.05  # rad, largest difference of an end of a joint's range
_DISTANCE = 0.015  # m, largest distance of a fingertip from where the hand has it
_FREE, _HINGE = mujoco.mjtJoint.mjJNT_FREE, mujoco.mjtJoint.mjJNT_HINGE
_IN_PAIRS = 1 << 30  # collision bit of geoms that otherwise touch by explicit pairs alone

Pose = tuple[np.ndarray, np.ndarray]
"""Position [..., 3] m and rotation [..., 3, 3]."""


@dataclasses.dataclass(frozen=True)
class HandModel:
    """A hand in the palm frame, without actuators; J joints and F fingers in the order of the hand."""

    name: str
    spec: mujoco.MjSpec
    joints: list[str]  # [J]
    torque_limit: np.ndarray  # [J] Nm
    lattices: list[str]  # [F] sites: the frames in which the hand gives the taxels of a fingertip
    foreign: bool = False  # contacts, friction, time step and solver are those of the file


def own_model(hand: Hand) -> HandModel:
    """The hand's own MJCF; its collisions, options and motors are left out.

    Coupled joints follow the motor's side of the gear, without its play.
    """
    spec = read_mjcf(hand)
    spec.option = mujoco.MjSpec().option  # With the file's flags gravity or contacts could be off.
    tips = [hand.body_names[body] for body in hand.tip_body]
    lattices = [spec.body(tip).add_site(name=f"{tip}_taxels").name for tip in tips]
    return _in_palm_frame("emulated hand", spec, (np.zeros(3), np.eye(3)), hand, hand.joint_names, lattices)


def read_model(path: str | Path, hand: Hand) -> HandModel:
    """Read and check an MJCF by somebody else; `hand` is the one whose joints, fingertips and taxels it must have.

    Raises HandError: it cannot be read, or does not fit the hand.
    """
    path = Path(path)
    try:
        spec = mujoco.MjSpec.from_file(str(path))
        if problem := disabled(spec.option):
            raise ValueError(f"its {problem}: remove the flag")
        _let_touch(spec)
        _leave_out_scenery(spec)
        model = spec.compile()
        joints = _find_joints(model, hand)
        data = mujoco.MjData(model)
        mujoco.mj_kinematics(model, data)
        palm = _find_palm(data, joints)
        tips = [_find_tip(model, hand, joints, finger) for finger in range(hand.num_fingers)]
        _check_places(model, hand, joints, palm, tips)
    except (OSError, ValueError) as error:
        raise HandError(f"{path}: {' '.join(str(error).split())[:300]}") from None
    lattices = _add_lattices(spec, data, hand, palm, tips)
    for actuator in spec.actuators:
        spec.delete(actuator)
    names = [model.joint(joint).name for joint in joints]
    return _in_palm_frame(path.name, spec, palm, hand, names, lattices, foreign=True)


def _in_palm_frame(
    name: str, spec: mujoco.MjSpec, palm: Pose, hand: Hand, joints: Sequence[str], lattices: list[str], foreign=False
) -> HandModel:
    """The model with its palm as the world's frame, and prefixed names."""
    (place, turn), world = palm, mujoco.MjSpec()
    world.option = spec.option
    world.attach(spec, frame=world.worldbody.add_frame(pos=-turn.T @ place, quat=quaternion(turn.T)), prefix=PREFIX)
    joints, lattices = ([PREFIX + name for name in names] for names in (joints, lattices))
    return HandModel(name, world, joints, hand.torque_limit, lattices, foreign)


# --- reading: ValueError where the file does not fit ---------------------------------------------


def _let_touch(spec: mujoco.MjSpec) -> None:
    """Geoms that the file lets touch by explicit pairs alone may touch the trial's object, and as before one another.

    By their affinity only: two geoms collide when the type of one is in the affinity of the other.
    """
    for name in {name for pair in spec.pairs for name in (pair.geomname1, pair.geomname2)}:
        if (geom := spec.geom(name)) is not None and not geom.contype | geom.conaffinity:
            geom.conaffinity = _IN_PAIRS
    if not any(geom.contype | geom.conaffinity for geom in spec.geoms):
        raise ValueError("no geom can touch anything: all have contype and conaffinity 0, and there are no pairs")


def _leave_out_scenery(spec: mujoco.MjSpec) -> None:
    """Delete floors and loose objects, which would be in the way of the trial's, and what may refer to them."""
    loose = [body for body in spec.worldbody.bodies if [j.type for j in body.find_all("joint")] == [_FREE]]
    floors = [geom for geom in spec.worldbody.geoms if geom.type == mujoco.mjtGeom.mjGEOM_PLANE]
    gone = {geom.name for geom in (*floors, *(g for body in loose for g in body.find_all("geom")))}
    pairs = [pair for pair in spec.pairs if {pair.geomname1, pair.geomname2} & gone]
    others = (*spec.keys, *spec.sensors, *spec.cameras, *spec.lights, *spec.tuples)
    for element in (*others, *pairs, *floors, *loose):
        spec.delete(element)


def _find_joints(model: mujoco.MjModel, hand: Hand) -> list[int]:
    """The joints with the hand's names, or those with an actuator; in the order of the hand."""
    hinges = {model.joint(j).name: j for j in range(model.njnt) if model.jnt_type[j] == _HINGE}
    driven = [model.joint(int(joint)).name for joint in model.actuator_trnid[:, 0]]
    names = hand.joint_names if set(hand.joint_names) <= hinges.keys() else driven
    if len(set(names)) != hand.num_joints or set(names) - hinges.keys():
        raise ValueError(f"{len(set(names))} joints, the hand has {hand.num_joints}; hinges are {', '.join(hinges)}")
    for name, end, low, high in zip(names, hand.joint_names, hand.joint_lower, hand.joint_upper, strict=True):
        joint = hinges[name]
        limits = model.jnt_range[joint] if model.jnt_limited[joint] else np.array([-np.inf, np.inf])
        if np.abs(limits - (low, high)).max() > _RANGE:
            actual, expected = f"{limits[0]:.3f} to {limits[1]:.3f} rad", f"{low:.3f} to {high:.3f}"
            raise ValueError(f"joint {name} has a range of {actual}, {end} of the hand {expected}")
    return [hinges[name] for name in names]


def _find_palm(data: mujoco.MjData, joints: list[int]) -> Pose:
    """The palm frame in the world: that of the site "palm", or of the body that carries all joints."""
    model = data.model
    site = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_SITE, "palm")
    # The deepest that carries all: a body comes after its parent.
    carriers = (_carriers(model, int(model.jnt_bodyid[joint])) for joint in joints)
    body = model.site_bodyid[site] if site >= 0 else max(set.intersection(*carriers))
    if model.body_weldid[body] != 0:
        raise ValueError(f"the palm ({model.body(body).name}) moves: fix it to the world")
    frame = data.site(site) if site >= 0 else data.body(body)
    return frame.xpos.copy(), frame.xmat.reshape(3, 3).copy()


def _carriers(model: mujoco.MjModel, body: int) -> set[int]:
    """Bodies that carry a body, up to the world."""
    parent = int(model.body_parentid[body])
    return {parent} | (_carriers(model, parent) if parent else set())


def _find_tip(model: mujoco.MjModel, hand: Hand, joints: list[int], finger: int) -> int:
    """The site at the tip of a finger: the only one on its last link, or the one with "tip" in its name."""
    last = next(body for body in finger_bodies(hand, finger) if hand.body_joint[body] >= 0)
    joint = joints[int(hand.body_joint[last])]
    moved = model.body_weldid[model.jnt_bodyid[joint]]
    sites = [s for s in range(model.nsite) if model.body_weldid[model.site_bodyid[s]] == moved]
    if len(sites) > 1:
        sites = [site for site in sites if "tip" in model.site(site).name.lower()]
    if len(sites) != 1:
        where = f"put one site with 'tip' in its name on the body that {model.joint(joint).name} moves, at the tip"
        raise ValueError(f"{len(sites)} fingertip sites of {hand.finger_names[finger]}: {where}")
    return sites[0]


def _check_places(model: mujoco.MjModel, hand: Hand, joints: list[int], palm: Pose, tips: list[int]) -> None:
    """Check where the fingertips are with all joints at 0, and with each at its upper end."""
    data = mujoco.MjData(model)
    for j in range(-1, hand.num_joints):
        posture = np.where(np.arange(hand.num_joints) == j, hand.joint_upper, 0.0)
        data.qpos[model.jnt_qposadr[joints]] = posture
        mujoco.mj_kinematics(model, data)
        expected, _ = _hand_tips(hand, posture)
        distance = np.linalg.norm((data.site_xpos[tips] - palm[0]) @ palm[1] - expected, axis=-1)
        if not distance.max() <= _DISTANCE:
            where = f"{model.joint(joints[j]).name} at {posture[j]:.2f} rad" if j >= 0 else "all joints at 0"
            tip = f"the tip of {hand.finger_names[distance.argmax()]} is {1e3 * distance.max():.0f} mm"
            todo = "check palm frame, and order, axes and zeros of the joints"
            raise ValueError(f"with {where} {tip} from where the hand has it: {todo}")


def _hand_tips(hand: Hand, posture: np.ndarray) -> Pose:
    """Positions [F, 3] and rotations [F, 3, 3] of the fingertips in the palm frame, by the hand's MJCF."""
    (pose,) = hand_poses(hand, posture[None], float)
    turns = pose.body_rotation[hand.tip_body]
    return pose.body_position[hand.tip_body] + np.einsum("fij,fj->fi", turns, hand.tip_offset), turns


def _add_lattices(spec: mujoco.MjSpec, data: mujoco.MjData, hand: Hand, palm: Pose, tips: list[int]) -> list[str]:
    """Add the frames of the taxels: at the tip sites, turned as on the hand with all joints at 0 (as in `data`)."""
    turns = palm[1] @ _hand_tips(hand, np.zeros(hand.num_joints))[1]
    names = [f"lattice_{finger}" for finger in hand.finger_names]
    for name, site, turn, offset in zip(names, tips, turns, hand.tip_offset, strict=True):
        body = int(data.model.site_bodyid[site])
        frame = data.xmat[body].reshape(3, 3)
        place = frame.T @ (data.site_xpos[site] - turn @ offset - data.xpos[body])
        spec.bodies[body].add_site(name=name, pos=place, quat=quaternion(frame.T @ turn))
    return names
