"""A hand's folder, written: MJCF and TOML of links that are capsules.

Every body is drawn along the palm frame, with its origin on its hinge. So positions are differences of points in the
palm frame, and no body has a rotation of its own.
"""

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from dexsim.core.files import write_atomic
from dexsim.hand.anatomy import flexion_links, tip_of
from dexsim.hand.vendor import Draft, Link

_TOUCH, _PAD = (0.30, 0.32, 0.36, 1.0), (0.85, 0.85, 0.87, 1.0)  # colours
_NOMINAL_TORQUE = 1.1  # Nm, stall torque of the motors that the nominal gains are for
_COUPLING = {"solref": [0.012, 1.0], "solimp": [0.99, 0.999, 0.001, 0.5, 2.0]}  # stiff
_GRID = (6, 8)  # columns and rows of taxels, over the front two thirds of a pad and along it
_PITCH = 0.0035  # m, at most


def write_hand(
    draft: Draft, name: str, remarks: Iterable[str], folder: Path, grasp: Mapping[str, Iterable[float]] | None = None
) -> Path:
    """Write NAME.xml and NAME.toml into the folder, with remarks as their first lines and `grasp` as the TOML's table
    of that name. Returns the TOML's path."""
    remarks = tuple(remarks)
    comment = "".join(f"  {line}\n" for line in remarks).replace("--", "- -")
    model = _mjcf(draft, name).to_xml().replace(">\n", f">\n  <!--\n{comment}  -->\n", 1)
    write_atomic(folder / f"{name}.xml", [model.encode()])
    path = folder / f"{name}.toml"
    text = "\n".join([*(f"# {line}" for line in remarks), *_toml(draft, name, grasp or {})])
    write_atomic(path, [f"{text}\n".encode()])
    return path


def _mjcf(draft: Draft, name: str) -> mujoco.MjSpec:
    spec = mujoco.MjSpec()
    spec.modelname = name
    spec.compiler.degree = False
    tips = {chain[-1]: finger for finger, chain in draft.fingers.items()}
    bodies: list[Any] = []
    for at, link in enumerate(draft.links):
        above = draft.links[link.parent].anchor if at else np.zeros(3)
        body = (bodies[link.parent] if at else spec.worldbody).add_body(name=link.name, pos=link.anchor - above)
        body.explicitinertial, body.mass, body.ipos = True, link.mass, link.centre - link.anchor
        body.fullinertia = link.inertia[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
        bodies.append(body)
        if at:
            _add_hinge(spec, body, link)
            _add_capsule(body, link, tips.get(at, ""))
    palm, kinds, (centre, half, _) = bodies[0], mujoco.mjtGeom, draft.palm
    palm.add_geom(name="palm_box", type=kinds.mjGEOM_BOX, pos=centre, size=half, rgba=_TOUCH, group=3)
    # Its face is a half-space for objects that boxes do not meet in closed form.
    face = {"pos": centre + [half[0], 0, 0], "quat": [0.5**0.5, 0, 0.5**0.5, 0], "size": [half[2], half[1], 0.001]}
    palm.add_geom(name="palm_face", type=kinds.mjGEOM_PLANE, rgba=[0] * 4, group=3, **face)
    thumb, *fingers = draft.fingers
    for finger in fingers:
        spec.add_pair(geomname1=f"{thumb}_pad", geomname2=f"{finger}_pad", condim=1)
    return spec


def _add_hinge(spec: mujoco.MjSpec, body: Any, link: Link) -> None:
    damping, armature, stall = (0.005, 0.0002, 0.0) if link.leader else (0.02, 0.001, link.torque)
    hinge = body.add_joint(name=link.joint, axis=link.axis, range=[link.low, link.high], damping=damping)
    hinge.armature, hinge.actfrcrange = armature, [-stall, stall]
    if link.leader:
        polynomial = np.array([link.offset, link.ratio, *[0.0] * (mujoco.mjNEQDATA - 2)])
        of_joints = {"type": mujoco.mjtEq.mjEQ_JOINT, "objtype": mujoco.mjtObj.mjOBJ_JOINT}
        spec.add_equality(name1=link.joint, name2=link.leader, data=polynomial, **of_joints, **_COUPLING)


def _add_capsule(body: Any, link: Link, tip: str) -> None:
    """A link's capsule; of a fingertip it is the pad, with a site at its end."""
    if link.capsule is None:
        return
    ends, radius = link.capsule.ends, link.capsule.radius
    span, quat = ends[1] - ends[0], np.zeros(4)
    length = np.linalg.norm(span)
    mujoco.mju_quatZ2Vec(quat, span)
    body.add_geom(
        name=f"{tip}_pad" if tip else f"{link.name}_capsule",
        type=mujoco.mjtGeom.mjGEOM_CAPSULE,
        pos=ends.mean(0) - link.anchor,
        quat=quat,
        size=[radius, max(length / 2, 1e-4), 0],
        rgba=_PAD if tip else _TOUCH,
        group=3,
    )
    if tip:
        end = ends[1] + radius * span / length
        body.add_site(name=f"{tip}_tip", pos=end - link.anchor, size=[0.002, 0, 0], group=4)


def _toml(draft: Draft, name: str, grasp: Mapping[str, Iterable[float]]) -> list[str]:
    links, motors = draft.links, draft.motors
    pads = [capsule for chain in draft.fingers.values() if (capsule := links[chain[-1]].capsule)]
    across = min(_PITCH, min(pad.radius for pad in pads) * np.pi * 2 / 3 / (_GRID[0] - 1))
    lengths = [float(np.linalg.norm(pad.ends[1] - pad.ends[0])) + pad.radius for pad in pads]
    along = min(_PITCH, min(lengths) / (_GRID[1] - 1))
    lines = [
        f'name = "{name}"',
        f'side = "{draft.side}"',
        f'model = "{name}.xml"',
        f'palm = "{links[0].name}"',
        "joints = [" + ", ".join(f'"{motor.joint}"' for motor in motors) + "]",
        f"speed_limits = {_row(motor.speed for motor in motors)}",
        f"gains = {_row(min(motor.torque / _NOMINAL_TORQUE, 1.0) for motor in motors)}",
        f"taxel_grid = {list(_GRID)}",
        f"taxel_pitch = {_row((across, along))}",
        "\n[grasp]",
        *(f"{name} = {_row(values)}" for name, values in grasp.items()),
    ]
    for finger, chain in draft.fingers.items():
        last = links[chain[-1]]
        facing = np.cross(last.axis, tip_of(links, chain) - last.anchor)
        # Its first motor that flexes represents a finger, or else its first.
        root = next(links[at].joint for at in (*flexion_links(links, chain), *chain) if links[at].is_motor)
        lines += [
            "\n[[fingers]]",
            f'name = "{finger}"',
            f'tip = "{finger}_tip"',
            f'root_joint = "{root}"',
            f'pad = "{finger}_pad"',
            f"facing = {_row(facing / np.linalg.norm(facing))}",
        ]
    return lines


def _row(values: Iterable[Any]) -> str:
    return "[" + ", ".join(f"{round(float(value), 4):g}" for value in values) + "]"
