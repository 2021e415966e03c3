"""A hand's folder, written: MJCF and TOML of links that are capsules.

Every body is drawn along the palm frame, with its origin on its hinge. So positions are differences of points in the
palm frame, and no body has a rotation of its own.
"""

import dataclasses
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from dexsim.core.files import write_atomic
from dexsim.hand.fit import Capsule, PalmBox
from dexsim.hand.vendor import Link

_TOUCH, _SHELL, _PAD = (0.30, 0.32, 0.36, 1.0), (0.25, 0.27, 0.30, 1.0), (0.85, 0.85, 0.87, 1.0)  # colours
_NOMINAL_TORQUE = 1.1  # Nm, stall torque of the motors that the nominal gains are for
_COUPLING = {"solref": [0.012, 1.0], "solimp": [0.99, 0.999, 0.001, 0.5, 2.0]}  # stiff


@dataclasses.dataclass(frozen=True, eq=False, kw_only=True)
class FingerSheet:
    """What a hand's TOML says of a finger."""

    name: str
    tip_link: int
    root_joint: str
    facing: np.ndarray  # [3] palm frame, of the pad in the drawing


@dataclasses.dataclass(frozen=True, eq=False, kw_only=True)
class HandSheet:
    """All that a hand's folder holds, in the palm frame with every hinge at 0. Links are as in `Description`: the palm
    first, with limits known; `capsules` are those of the links by their index, a fingertip's is its pad."""

    name: str
    side: str  # right or left
    links: tuple[Link, ...]
    palm: PalmBox
    capsules: dict[int, Capsule]
    fingers: tuple[FingerSheet, ...]  # thumb first
    motors: tuple[str, ...]  # joints in the TOML's order
    taxel_grid: tuple[int, int]
    taxel_pitch: tuple[float, float]
    remarks: tuple[str, ...]  # lines of a comment: sources, assumptions, signs
    # Of the first grasp.
    posture: dict[str, float] = dataclasses.field(default_factory=dict)  # rad, by motor
    centre: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros(3))  # m
    finger_force: tuple[float, float] = (1.0, 1.0)  # N, targets at command 0 and 1


def write_hand(sheet: HandSheet, folder: Path) -> Path:
    """Write NAME.xml and NAME.toml into the folder. Returns the TOML's path.

    Raises:
      OSError: a file cannot be written.
    """
    remarks = "".join(f"  {line}\n" for line in sheet.remarks)
    model = _mjcf(sheet).to_xml().replace(">\n", f">\n  <!--\n{remarks.replace('--', '- -')}  -->\n", 1)
    write_atomic(folder / f"{sheet.name}.xml", [model.encode()])
    path = folder / f"{sheet.name}.toml"
    write_atomic(path, [_toml(sheet).encode()])
    return path


def _mjcf(sheet: HandSheet) -> mujoco.MjSpec:
    spec, kinds = mujoco.MjSpec(), mujoco.mjtGeom
    spec.modelname = sheet.name
    spec.compiler.degree = False
    bodies: list[Any] = []
    tips = {finger.tip_link: finger.name for finger in sheet.fingers}
    for at, link in enumerate(sheet.links):
        joint = link.joint
        origin = np.zeros(3) if joint is None else joint.anchor
        above = spec.worldbody if at == 0 else bodies[link.parent]
        parent = sheet.links[link.parent].joint if at else None
        body = above.add_body(name=link.name, pos=origin - (parent.anchor if parent else 0.0))
        body.explicitinertial, body.mass, body.ipos = True, link.mass, link.centre - origin
        inertia = link.inertia
        body.fullinertia = inertia[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
        if joint is not None:
            hinge = body.add_joint(
                name=joint.name, axis=joint.axis, range=[joint.low, joint.high], damping=0.005 if joint.leader else 0.02
            )
            hinge.limited, hinge.armature = mujoco.mjtLimited.mjLIMITED_TRUE, 0.0002 if joint.leader else 0.001
            if joint.leader:
                data = np.zeros(mujoco.mjNEQDATA)
                data[:2] = joint.offset, joint.ratio
                spec.add_equality(
                    type=mujoco.mjtEq.mjEQ_JOINT, objtype=mujoco.mjtObj.mjOBJ_JOINT, name1=joint.name,
                    name2=joint.leader, data=data, **_COUPLING,
                )  # fmt: skip
            else:
                hinge.actfrclimited, hinge.actfrcrange = mujoco.mjtLimited.mjLIMITED_TRUE, [-joint.torque, joint.torque]
        if at == 0:
            centre, half = sheet.palm.centre, sheet.palm.half
            body.add_geom(name="palm_box", type=kinds.mjGEOM_BOX, pos=centre, size=half, rgba=_TOUCH, group=3)
            # The palm's face as a half-space, for objects that boxes do not meet in closed form.
            body.add_geom(
                name="palm_face", type=kinds.mjGEOM_PLANE, pos=centre + [half[0], 0, 0],
                quat=[0.5**0.5, 0, 0.5**0.5, 0], size=[half[2], half[1], 0.001], rgba=[0, 0, 0, 0], group=3,
            )  # fmt: skip
        elif at in sheet.capsules:
            capsule = sheet.capsules[at]
            middle, span = capsule.ends.mean(0) - origin, capsule.ends[1] - capsule.ends[0]
            quat = np.zeros(4)
            mujoco.mju_quatZ2Vec(quat, span)
            tip = tips.get(at)
            body.add_geom(
                name=f"{tip}_pad" if tip else f"{link.name}_capsule", type=kinds.mjGEOM_CAPSULE, pos=middle, quat=quat,
                size=[capsule.radius, max(np.linalg.norm(span) / 2, 1e-4), 0], rgba=_PAD if tip else _TOUCH, group=3,
            )  # fmt: skip
            if tip:
                end = capsule.ends[1] + capsule.radius * span / np.linalg.norm(span)
                body.add_site(name=f"{tip}_tip", pos=end - origin, size=[0.002, 0, 0], group=4)
        bodies.append(body)
    for finger in sheet.fingers[1:]:
        spec.add_pair(geomname1=f"{sheet.fingers[0].name}_pad", geomname2=f"{finger.name}_pad", condim=1)
    return spec


def _toml(sheet: HandSheet) -> str:
    joints = {link.joint.name: link.joint for link in sheet.links if link.joint}
    speeds, angles = ([f(name) for name in sheet.motors] for f in (lambda n: joints[n].speed, sheet.posture.get))
    lines = [
        *(f"# {line}" for line in sheet.remarks),
        f'name = "{sheet.name}"',
        f'side = "{sheet.side}"',
        f'model = "{sheet.name}.xml"',
        f'palm = "{sheet.links[0].name}"',
        "joints = [" + ", ".join(f'"{name}"' for name in sheet.motors) + "]",
        f"speed_limits = {_row(speeds)}",
        f"gains = {_row(min(joints[name].torque / _NOMINAL_TORQUE, 1.0) for name in sheet.motors)}",
        f"taxel_grid = {list(sheet.taxel_grid)}",
        f"taxel_pitch = {_row(sheet.taxel_pitch)}",
        "\n[grasp]",
        f"posture = {_row(angles)}",
        f"centre = {_row(sheet.centre)}",
        f"finger_force = {_row(sheet.finger_force)}",
    ]
    for finger in sheet.fingers:
        lines += [
            "\n[[fingers]]",
            f'name = "{finger.name}"',
            f'tip = "{finger.name}_tip"',
            f'root_joint = "{finger.root_joint}"',
            f'pad = "{finger.name}_pad"',
            f"facing = {_row(finger.facing)}",
        ]
    return "\n".join(lines) + "\n"


def _row(values: Iterable[Any]) -> str:
    return "[" + ", ".join(f"{round(float(value), 4):g}" for value in values) + "]"
