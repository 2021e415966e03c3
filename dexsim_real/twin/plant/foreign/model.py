"""Reads a user's MJCF of the hand: which joints, palm and fingertips are meant, and whether they fit the hand.

Names need not be those of the hand. Joints are found by name, or by the order of the actuators; the palm is the body
that carries all of them; a fingertip is the site on the body that the finger's last joint moves. A TOML says what
cannot be found:

    model = "my_hand.xml"
    palm = "base"                  # body or site: fingers along z, palm normal x, thumb side y
    joints = ["j0", ..., "j11"]    # in the order of the hand
    tips = ["tip_0", ..., "tip_4"] # sites at the tips, in the order of the fingers
"""

import dataclasses
import tomllib
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from dexsim.hand.kinematics import Hand
from dexsim_real.core.errors import HandError

PREFIX = "plant/"  # of all names of the MJCF in the model of a trial
STIFFNESS, DAMPING = 3.0, 0.1  # Nm/rad, Nm s/rad, of the servo that a torque motor gets
_TIMESTEPS = (1e-4, 5e-3)  # s
_FLAGS = ("contact", "constraint", "actuation")  # of MuJoCo, that must not be disabled
_RANGE = 0.05  # rad, largest difference of an end of a joint's range
_APART = 0.015  # m, largest distance of a fingertip from where the hand has it
_KEYS = {"model": str, "palm": str, "joints": list, "tips": list}


@dataclasses.dataclass(frozen=True)
class ForeignModel:
    """A checked MJCF, in the palm frame; names have the `PREFIX`."""

    path: Path
    spec: mujoco.MjSpec
    joints: tuple[str, ...]  # [J] in the order of the hand
    actuators: tuple[int, ...]  # [J]
    lattices: tuple[str, ...]  # [F] sites: the frames in which the hand gives the taxels of a fingertip


def read_model(path: str | Path, hand: Hand) -> ForeignModel:
    """Read and check an MJCF.

    Args:
      path: the MJCF, or a TOML that names it and its parts.
      hand: whose joints, fingertips and taxels it must have.

    Raises:
      HandError: it cannot be read, or does not fit the hand.
    """
    path = Path(path)
    names: dict[str, Any] = _names(path) if path.suffix == ".toml" else {"model": path.name}
    spec = _load(path.parent / names["model"])
    model = spec.compile()
    if not _TIMESTEPS[0] <= model.opt.timestep <= _TIMESTEPS[1]:
        raise HandError(f"{path}: a timestep of {1e3 * model.opt.timestep:g} ms; 0.1 to 5 ms are possible")
    _check_physics(path, spec, model)
    actuators, joints = _joints(path, model, hand, names.get("joints"))
    data = mujoco.MjData(model)
    data.qpos[model.jnt_qposadr[joints]] = 0.0
    mujoco.mj_kinematics(model, data)
    palm = _palm(path, model, data, joints, names.get("palm"))
    tips = [_tip(path, model, hand, joints, f, names.get("tips")) for f in range(hand.num_fingers)]
    _check_places(path, model, hand, joints, palm, tips)
    if not np.any(model.geom_contype | model.geom_conaffinity):
        raise HandError(f"{path}: no geom can touch anything (contype and conaffinity are 0)")
    lattices = _add_lattices(spec, model, data, hand, palm, tips)
    _set_servos(spec, model, hand, actuators)
    return ForeignModel(
        path,
        _in_palm_frame(spec, palm),
        tuple(PREFIX + model.joint(j).name for j in joints),
        tuple(actuators),
        tuple(PREFIX + name for name in lattices),
    )


def _names(path: Path) -> dict[str, Any]:
    try:
        table = tomllib.loads(path.read_text())
    except RecursionError:
        raise HandError(f"{path}: cannot be read (nested too deep)") from None
    except (OSError, ValueError) as error:
        raise HandError(f"{path}: cannot be read ({_line(error)})") from None
    wrong = [key for key, value in table.items() if key not in _KEYS or not isinstance(value, _KEYS[key])]
    if wrong or "model" not in table:
        raise HandError(
            f"{path}: field {wrong[0] if wrong else 'model'!r}: give model, and where needed {list(_KEYS)[1:]}"
        )
    for key, value in table.items():
        other = [item for item in value if not isinstance(item, str)] if isinstance(value, list) else []
        if other:
            raise HandError(f"{path}: field {key!r}: {other[0]!r:.80} is not a name in quotes")
    return table


def _load(path: Path) -> mujoco.MjSpec:
    try:
        spec = mujoco.MjSpec.from_file(str(path))
        for element in (*spec.keys, *spec.sensors, *spec.cameras, *spec.lights, *spec.tuples):
            spec.delete(element)
        floors = [g for g in spec.worldbody.geoms if g.type == mujoco.mjtGeom.mjGEOM_PLANE]
        objects = [b for b in spec.worldbody.bodies if _is_loose(b)]  # They would be in the way of the trial's.
        out = {geom.name for geom in (*floors, *(g for body in objects for g in body.find_all("geom")))}
        for pair in [p for p in spec.pairs if {p.geomname1, p.geomname2} & out]:
            spec.delete(pair)
        for element in (*floors, *objects):
            spec.delete(element)
        spec.compile()
    except ValueError as error:
        raise HandError(f"{path}: MuJoCo cannot read it ({_line(error)})") from None
    return spec


def _is_loose(body: mujoco.MjsBody) -> bool:
    """Whether a body of the world moves freely and carries no other joint."""
    joints = body.find_all("joint")
    return len(joints) == 1 and joints[0].type == mujoco.mjtJoint.mjJNT_FREE


def _check_physics(path: Path, spec: mujoco.MjSpec, model: mujoco.MjModel) -> None:
    """Check that all numbers are finite, and that a trial has all that the file asks for, and nothing is disabled."""
    arrays = {name: getattr(model, name) for name in dir(model) if not name.startswith("_")}
    wrong = [
        name
        for name, array in arrays.items()
        if isinstance(array, np.ndarray) and array.dtype.kind == "f" and not np.isfinite(array).all()
    ]
    if wrong:
        raise HandError(f"{path}: a number is nan or infinite: MuJoCo has it in {', '.join(wrong)}")
    if model.nflex:
        raise HandError(f"{path}: flex {spec.flexes[0].name}: the taxels do not feel what is soft; leave it out")
    if spec.compiler.settotalmass > 0:  # It would count the trial's object.
        raise HandError(f"{path}: <compiler settotalmass> is not supported: scale the masses in the file")
    for name in _FLAGS:
        if model.opt.disableflags & int(getattr(mujoco.mjtDisableBit, f"mjDSBL_{name.upper()}")):
            raise HandError(f'{path}: <flag {name}="disable"/>: a trial needs {name}')


def _joints(path: Path, model: mujoco.MjModel, hand: Hand, given: list[str] | None) -> tuple[list[int], list[int]]:
    """Actuators and joints of the MJCF, in the order of the hand."""
    driven: dict[int, int] = {}  # actuator by joint
    for k in range(model.nu):
        joint = int(model.actuator_trnid[k, 0])
        on_joint = model.actuator_trntype[k] == int(mujoco.mjtTrn.mjTRN_JOINT)
        hinge = on_joint and model.jnt_type[joint] == int(mujoco.mjtJoint.mjJNT_HINGE)
        fixed = model.actuator_gaintype[k] == int(mujoco.mjtGain.mjGAIN_FIXED)
        motor = fixed and model.actuator_biastype[k] == int(mujoco.mjtBias.mjBIAS_NONE)
        drivable = hinge and (motor or (fixed and _is_servo(model, k)))
        if not drivable or model.actuator_dyntype[k] != int(mujoco.mjtDyn.mjDYN_NONE) or joint in driven:
            raise HandError(
                f"{path}: actuator {model.actuator(k).name or k}: a hinge takes one motor or position servo without "
                "state, other actuators cannot be driven"
            )
        for name, value in (("gear", model.actuator_gear[k, 0]), ("gain", model.actuator_gainprm[k, 0])):
            if abs(value) < mujoco.mjMINVAL:
                raise HandError(
                    f"{path}: the actuator of {model.joint(joint).name} has a {name} of 0 and moves nothing"
                )
        if model.opt.disableactuator >> model.actuator_group[k] & 1:
            raise HandError(f"{path}: actuatorgroupdisable turns off the actuator of {model.joint(joint).name}")
        driven[joint] = k
    if len(driven) != hand.num_joints:
        raise HandError(f"{path}: {len(driven)} actuated joints, the hand has {hand.num_joints}")
    known = {model.joint(j).name: j for j in driven}
    names = given or (list(hand.joint_names) if set(hand.joint_names) == set(known) else list(known))
    missing = [name for name in names if name not in known]
    if missing or len(set(names)) != hand.num_joints:
        what = f"{missing[0]!r} is not one of them" if missing else f"{len(set(names))} of {hand.num_joints} are named"
        raise HandError(f"{path}: joints: {what}; actuated are {', '.join(known)}")
    joints = [known[name] for name in names]
    for j, (joint, name) in enumerate(zip(joints, names, strict=True)):
        ends = hand.joint_lower[j], hand.joint_upper[j]
        limits = model.jnt_range[joint] if model.jnt_limited[joint] else (-np.inf, np.inf)
        if np.abs(np.subtract(limits, ends)).max() > _RANGE:
            raise HandError(
                f"{path}: joint {name} has a range of {limits[0]:.3f} to {limits[1]:.3f} rad, {hand.joint_names[j]} of "
                f"the hand {ends[0]:.3f} to {ends[1]:.3f}"
            )
    return [driven[j] for j in joints], joints


def _is_servo(model: mujoco.MjModel, actuator: int) -> bool:
    """Whether an actuator of fixed gain is a position servo."""
    affine = model.actuator_biastype[actuator] == int(mujoco.mjtBias.mjBIAS_AFFINE)
    return bool(affine and model.actuator_biasprm[actuator, 1] < 0)


def _palm(
    path: Path, model: mujoco.MjModel, data: mujoco.MjData, joints: list[int], given: str | None
) -> tuple[np.ndarray, np.ndarray]:
    """Position [3] and rotation [3, 3] of the palm frame in the world."""
    if given and any(model.site(i).name == given for i in range(model.nsite)):
        site = model.site(given).id
        body, place, turn = int(model.site_bodyid[site]), data.site_xpos[site], data.site_xmat[site]
    else:
        carrying = set.intersection(*(set(_above(model, int(model.jnt_bodyid[j]))) for j in joints))
        body = max(carrying)  # The deepest: a body comes after its parent.
        if given:
            body = next((b for b in range(model.nbody) if model.body(b).name == given), -1)
        if body < 0:
            raise HandError(f"{path}: palm: there is neither a body nor a site {given!r}")
        place, turn = data.xpos[body], data.xmat[body]
    if model.body_weldid[body] != 0:
        raise HandError(f"{path}: the palm ({model.body(body).name}) moves: fix it to the world")
    return place.copy(), turn.reshape(3, 3).copy()


def _above(model: mujoco.MjModel, body: int) -> list[int]:
    """Bodies that carry a body, up to the world."""
    matches = []
    while body:
        body = int(model.body_parentid[body])
        matches.append(body)
    return matches


def _tip(path: Path, model: mujoco.MjModel, hand: Hand, joints: list[int], finger: int, given: list[str] | None) -> int:
    """The site at the tip of a finger."""
    name, body = hand.finger_names[finger], int(hand.tip_body[finger])
    while hand.body_joint[body] < 0:
        body = int(hand.body_parent[body])
    joint = joints[int(hand.body_joint[body])]
    moved = model.body_weldid[model.jnt_bodyid[joint]]
    sites = [s for s in range(model.nsite) if model.body_weldid[model.site_bodyid[s]] == moved]
    label = model.joint(joint).name
    if given:
        matches = [s for s in sites if len(given) == hand.num_fingers and model.site(s).name == given[finger]]
        if not matches:
            raise HandError(
                f"{path}: tips: give {hand.num_fingers} sites; that of {name} on the body that {label} moves"
            )
        return matches[0]
    matches = sites if len(sites) == 1 else [s for s in sites if "tip" in model.site(s).name.lower()]
    if len(matches) != 1:
        raise HandError(
            f"{path}: {len(matches) or 'no'} fingertip sites of {name}: put one site with 'tip' in its name on the "
            f"body that {label} moves, at the tip"
        )
    return matches[0]


def _check_places(
    path: Path,
    model: mujoco.MjModel,
    hand: Hand,
    joints: list[int],
    palm: tuple[np.ndarray, np.ndarray],
    tips: list[int],
) -> None:
    """Check where the fingertips are with all joints at 0, and with each at its upper end."""
    data, at = mujoco.MjData(model), model.jnt_qposadr[joints]
    reference = mujoco.MjModel.from_xml_path(str(hand.model_path))
    for j in range(-1, hand.num_joints):
        posture = np.zeros(hand.num_joints)
        posture[j] = hand.joint_upper[j] if j >= 0 else 0.0
        data.qpos[at] = posture
        mujoco.mj_kinematics(model, data)
        matches = (data.site_xpos[tips] - palm[0]) @ palm[1]
        apart = np.linalg.norm(matches - _hand_tips(reference, hand, posture)[0], axis=-1)
        worst = int(apart.argmax())
        if apart[worst] > _APART:
            where = "all joints at 0" if j < 0 else f"{model.joint(joints[j]).name} at {posture[j]:.2f} rad"
            raise HandError(
                f"{path}: with {where} the tip of {hand.finger_names[worst]} is {1e3 * apart[worst]:.0f} mm from where "
                f"the hand has it: check palm frame, and order, axes and zeros of the joints"
            )


def _hand_tips(reference: mujoco.MjModel, hand: Hand, posture: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Positions [F, 3] and rotations [F, 3, 3] of the fingertips in the palm frame, by the hand's own MJCF."""
    data = mujoco.MjData(reference)
    for name, angle in zip(hand.joint_names, posture, strict=True):
        data.joint(name).qpos[0] = angle
    mujoco.mj_kinematics(reference, data)
    palm = data.body(hand.palm)
    bodies = [data.body(hand.body_names[body]) for body in hand.tip_body]
    turns = np.array([palm.xmat.reshape(3, 3).T @ body.xmat.reshape(3, 3) for body in bodies])
    places = [(body.xpos - palm.xpos) @ palm.xmat.reshape(3, 3) for body in bodies]
    return np.array(places) + np.einsum("fij,fj->fi", turns, hand.tip_offset), turns


def _add_lattices(
    spec: mujoco.MjSpec,
    model: mujoco.MjModel,
    data: mujoco.MjData,
    hand: Hand,
    palm: tuple[np.ndarray, np.ndarray],
    tips: list[int],
) -> list[str]:
    """Add the frames of the taxels: at the tip sites, turned as on the hand with all joints at 0."""
    reference = mujoco.MjModel.from_xml_path(str(hand.model_path))
    _, turns = _hand_tips(reference, hand, np.zeros(hand.num_joints))
    names = [f"lattice_{finger}" for finger in hand.finger_names]
    for name, site, turn, offset in zip(names, tips, turns, hand.tip_offset, strict=True):
        turn, body = palm[1] @ turn, int(model.site_bodyid[site])
        frame, quat = data.xmat[body].reshape(3, 3), np.empty(4)
        mujoco.mju_mat2Quat(quat, (frame.T @ turn).ravel())
        place = frame.T @ (data.site_xpos[site] - turn @ offset - data.xpos[body])
        spec.bodies[body].add_site(name=name, pos=place, quat=quat)
    return names


def _set_servos(spec: mujoco.MjSpec, model: mujoco.MjModel, hand: Hand, actuators: list[int]) -> None:
    """Give torque motors a position servo, and every actuator a torque limit."""
    for j, k in enumerate(actuators):
        actuator, joint, gear = spec.actuators[k], int(model.actuator_trnid[k, 0]), model.actuator_gear[k, 0]
        limits = [np.abs(model.actuator_forcerange[k]).max()] if model.actuator_forcelimited[k] else []
        if model.jnt_actfrclimited[joint]:
            limits.append(np.abs(model.jnt_actfrcrange[joint]).max() / abs(gear))
        if _is_servo(model, k):  # Of an angle, not of a share of the range or the like.
            actuator.gainprm[0], actuator.biasprm[0] = -model.actuator_biasprm[k, 1], 0.0
        else:
            if model.actuator_ctrllimited[k]:
                limits.append(np.abs(model.actuator_ctrlrange[k] * model.actuator_gainprm[k, 0]).max())
            actuator.set_to_position(kp=STIFFNESS / gear**2, kv=DAMPING / gear**2)
        limit = min(limits, default=hand.torque_limit[j] / abs(gear))
        actuator.forcelimited, actuator.forcerange = mujoco.mjtLimited.mjLIMITED_TRUE, [-limit, limit]
        actuator.ctrllimited = mujoco.mjtLimited.mjLIMITED_FALSE


def _in_palm_frame(spec: mujoco.MjSpec, palm: tuple[np.ndarray, np.ndarray]) -> mujoco.MjSpec:
    """The same model with the palm frame as its world."""
    quat, world = np.empty(4), mujoco.MjSpec()
    mujoco.mju_mat2Quat(quat, palm[1].T.ravel())
    world.option = spec.option
    world.attach(spec, frame=world.worldbody.add_frame(pos=-palm[1].T @ palm[0], quat=quat), prefix=PREFIX)
    return world


def _line(error: object) -> str:
    return " ".join(str(error).split())[:200]
