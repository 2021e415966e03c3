"""The hand, read from an MJCF, a taxel layout and a short TOML: nothing in the library but the files under
`assets/hand/` knows which hand it is."""

import dataclasses
import hashlib
import re
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from dexsim.core.assets import asset_path
from dexsim.core.config import Config, Range, from_dict, naming_file, setting
from dexsim.core.files import read_toml
from dexsim.errors import AssetError, ConfigError
from dexsim.hand.description import SHAPES, Geom, Hand
from dexsim.hand.layout import MOST, lay_taxels, read_taxels

DEFAULT = "xhand_right"
_SLACK = 1e-3  # rad, how far a posture or a follower may be beyond a joint's range


@dataclasses.dataclass(frozen=True, kw_only=True)
class FingerEntry(Config):
    """A finger in the TOML."""

    name: str
    tip: str
    """Site at its end."""
    root_joint: str
    """The joint whose torque represents the finger."""
    force_per_torque: float = setting(0.0, unit="N/Nm", low=0.0, high=1000.0)
    """Force of the finger over that torque; 0: not known."""
    pad: str = ""
    """Capsule or sphere of the tip's body on which a lattice of taxels is laid."""
    facing: tuple[float, float, float] | None = None
    """Where the lattice's middle faces, in that body's frame."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class GraspEntry(Config):
    """Where grasps start."""

    posture: tuple[float, ...] = setting((), unit="rad")
    centre: tuple[float, float, float] | None = None
    """Of the object, m."""
    finger_force: Range = setting((1.2, 4.8), unit="N", low=0.05, high=40.0)
    """Target of each touching finger but the thumb, at command 0 and 1: what the thumb can oppose. The default is the
    XHand's."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class RotateEntry(Config):
    """Where rotations start."""

    posture: tuple[float, ...] = setting((), unit="rad")
    reference: tuple[float, float, float] | None = None
    """Where the object belongs, m."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class HandFile(Config):
    """The TOML of a hand."""

    name: str = ""
    side: str = setting("right", choices=("right", "left"))
    """Policies see a left hand as its mirror image."""
    model: str
    """The MJCF."""
    palm: str
    """Its body."""
    joints: tuple[str, ...]
    speed_limits: tuple[float, ...] = setting(unit="rad/s", low=1e-3, high=1000.0)
    gains: tuple[float, ...] = setting((), unit="1", low=1e-3, high=10.0)
    """Of each motor, over the nominal gains k_p and k_d (`Randomization`); empty for 1. Weak motors need less: with the
    nominal gain they are at their torque limit, where force follows no command."""
    taxels: str = ""
    """CSV of the taxels (`dexsim.hand.layout`)."""
    taxel_grid: tuple[int, int] = setting(low=1, high=MOST)
    """Columns around a pad, rows along it."""
    taxel_pitch: tuple[float, float] | None = setting(None, unit="m", low=1e-6, high=1.0)
    """Across and along: a lattice on each finger's `pad` in place of a file."""
    grasp: GraspEntry = GraspEntry()
    rotate: RotateEntry = RotateEntry()
    fingers: tuple[FingerEntry, ...]


def find_hand(name: str | Path | None) -> Path:
    """The TOML of a hand that is named by a path, or by the name of a shipped one; None for the default one."""
    text = str(name or DEFAULT)
    if not re.fullmatch(r"\w+", text) or Path(text).is_file():
        return Path(text)
    if text not in shipped_hands():  # a folder of that name is no hand
        raise AssetError(f"hand {text!r}: no such file, and no shipped hand has that name")
    return shipped_hands()[text]


def shipped_hands() -> dict[str, Path]:
    """The TOMLs of the shipped hands by their names."""
    return {path.stem: path for path in sorted(asset_path("hand").rglob("*.toml"))}


def read_mjcf(path: Path) -> bytes:
    """A file's content; of an MJCF that includes others, with their content in its place."""
    data = path.read_bytes()
    if path.suffix != ".xml" or b"<include" not in data:
        return data
    model = ElementTree.fromstring(data)
    _paste_includes(model, path.parent, path.parent)
    return ElementTree.tostring(model)


def _paste_includes(element: ElementTree.Element, top: Path, folder: Path) -> None:
    """MuJoCo looks beside the model first, in `top`, then beside the file that includes, in `folder`."""
    for parent in list(element.iter()):
        for child in parent.findall("include"):
            file = next(path for path in (top / child.attrib["file"], folder / child.attrib["file"]) if path.is_file())
            included = ElementTree.parse(file).getroot()
            _paste_includes(included, top, file.parent)
            place = list(parent).index(child)
            parent[place : place + 1] = included


def digest_of(*files: Path) -> str:
    """A hash of the content of a hand's files."""
    digest = hashlib.sha256()
    for path in files:
        data = read_mjcf(path)
        digest.update(len(data).to_bytes(8, "little") + data)
    return digest.hexdigest()


def load_hand(path: str | Path | None = None) -> Hand:
    """Read a hand from its TOML, or a shipped one by its name; the XHand when `path` is None.

    Raises:
      AssetError: a file is missing or broken, or the three do not fit together.
    """
    file = find_hand(path)
    try:
        return _load(file, next((name for name, own in shipped_hands().items() if own == file.resolve()), str(path)))
    except FileNotFoundError as error:
        raise AssetError(f"{error.filename}: no such file") from None
    except KeyError as error:  # of MuJoCo: a name that the model lacks, and those that it has
        raise AssetError(f"{file}: {error.args[0]}") from None
    except (OSError, ValueError, ConfigError) as error:
        raise AssetError(f"{file}: {' '.join(str(error).split())}") from None


def _load(path: Path, source: str) -> Hand:
    import mujoco  # late: who imports this module for its types alone needs none

    table = from_dict(HandFile, read_toml(path))
    names = [finger.name for finger in table.fingers]
    if not names or len(set(names)) < len(names):
        raise ConfigError(f"[[fingers]] are named {names}: expected one or more, each with a name of its own")
    if (table.taxel_pitch is None) != bool(table.taxels):
        raise ConfigError("give either taxels (a file) or taxel_pitch (a lattice on each finger's pad)")
    files = [path, path.parent / table.model]
    model = mujoco.MjModel.from_xml_path(str(files[1]))
    joints = [model.joint(name).id for name in table.joints]
    followers = _read_followers(model, joints)
    _check_joints(model, table, joints, len(followers))
    palm = model.body(table.palm).id
    bodies = [b for b in range(1, model.nbody) if is_below(model.body_parentid, b, palm)]
    if not all(model.body(b).name for b in bodies):
        raise ConfigError(f"{table.model}: a body below {table.palm!r} has no name: every link needs one")
    row = {body: i for i, body in enumerate(bodies)}
    has = (model.body_jntnum[bodies] > 0) & (np.array(bodies) != palm)
    at = np.where(has, model.body_jntadr[bodies], -1)
    if other := set(range(model.njnt)) - set(at.tolist()):
        raise ConfigError(f"joint {model.joint(min(other)).name!r} must be the only joint of a body below the palm")
    moved = {joint: (joint, 1.0, 0.0) for joint in joints} | followers | {-1: (-1, 1.0, 0.0)}
    body_motor, body_ratio, body_offset = zip(*(moved[hinge] for hinge in at), strict=True)
    tips = _find_tips(model, table, row)
    tip_body = np.array([row[int(model.site_bodyid[s])] for s in tips], np.int32)
    geoms = _read_geoms(model, row)
    if table.taxels:
        files.append(path.parent / table.taxels)
        taxels = read_taxels(files[-1], tuple(names), table.taxel_grid)
    else:
        taxels = _lay_taxels(table, geoms, tip_body)
    identity = np.eye(3)

    return Hand(
        name=table.name or path.stem,
        model_path=files[1],
        palm=table.palm,
        joint_names=table.joints,
        joint_lower=_f32(model.jnt_range[joints, 0]),
        joint_upper=_f32(model.jnt_range[joints, 1]),
        torque_limit=_f32(model.jnt_actfrcrange[joints, 1]),
        speed_limit=_f32(table.speed_limits),
        gain=_f32(table.gains or np.ones(len(joints))),
        body_names=tuple(model.body(b).name for b in bodies),
        body_parent=np.array([row.get(int(model.body_parentid[b]), -1) for b in bodies]),
        body_position=_f32([np.zeros(3) if b == palm else model.body_pos[b] for b in bodies]),
        body_rotation=_f32([identity if b == palm else rotation_matrix(model.body_quat[b]) for b in bodies]),
        body_joint=np.array([joints.index(joint) if joint >= 0 else -1 for joint in body_motor], np.int32),
        body_ratio=_f32(body_ratio),
        body_offset=_f32(body_offset),
        joint_axis=_f32(np.where(has[:, None], model.jnt_axis[at], [0, 0, 1])),
        joint_anchor=_f32(np.where(has[:, None], model.jnt_pos[at], 0)),
        joint_reference=_f32(np.where(has, model.qpos0[model.jnt_qposadr[at]], 0)),
        finger_names=tuple(names),
        tip_body=tip_body,
        tip_offset=_f32(model.site_pos[tips]),
        root_joint=np.array([table.joints.index(finger.root_joint) for finger in table.fingers], np.int32),
        force_per_torque=_f32([finger.force_per_torque for finger in table.fingers]),
        taxel_grid=table.taxel_grid,
        taxel_position=taxels[..., 0:3],
        taxel_normal=taxels[..., 3:6],
        taxel_area=taxels[..., 6],
        geoms=geoms,
        grasp_posture=table.grasp.posture,
        grasp_centre=table.grasp.centre or (),
        grasp_force=table.grasp.finger_force,
        rotate_posture=table.rotate.posture,
        rotate_reference=table.rotate.reference or (),
        side=table.side,
        source=source,
        digest=digest_of(*files),
    )


def read_coupling(model: Any, index: int) -> tuple[int, int, float, float] | None:
    """An equality of two joints: the one that follows, its leader, the ratio and the offset [rad]; None of others.

    MuJoCo's polynomial is q1 - ref1 = a0 + a1 (q2 - ref2) + ...

    Raises:
      ConfigError: it has higher powers.
    """
    import mujoco

    first, second = int(model.eq_obj1id[index]), int(model.eq_obj2id[index])
    if model.eq_type[index] != mujoco.mjtEq.mjEQ_JOINT or second < 0 or not model.eq_active0[index]:
        return None
    a0, ratio, *higher = polycoef = model.eq_data[index, :5].tolist()
    if any(higher) or not ratio:
        name, leader = (model.joint(joint).name for joint in (first, second))
        raise ConfigError(f"joint {name!r} follows {leader!r} by the polycoef {polycoef}, expected a0 a1 0 0 0")
    reference = model.qpos0[model.jnt_qposadr[[first, second]]]
    return first, second, float(ratio), float(reference[0] + a0 - ratio * reference[1])


def _read_followers(model: Any, motors: list[int]) -> dict[int, tuple[int, float, float]]:
    """Hinges that follow a motor (one motor, two joints): for each its motor's joint, the ratio and the offset [rad].

    The MJCF says so by an `<equality>` of joints, which the physics honours too.
    """
    if model.ntendon:
        raise ConfigError(f"tendon {model.tendon(0).name or '#0'!r}: tendons are not supported")
    followers: dict[int, tuple[int, float, float]] = {}
    for index in range(model.neq):
        if (coupling := read_coupling(model, index)) is None:
            name = model.equality(index).name or f"#{index}"
            raise ConfigError(f"equality {name!r}: only active ones of two joints are supported")
        first, second, ratio, offset = coupling
        name, leader = (model.joint(joint).name for joint in (first, second))
        if first in motors or first in followers:
            raise ConfigError(f"an equality moves joint {name!r}, which has a motor or follows another joint already")
        if second not in motors:
            raise ConfigError(f"joint {name!r} follows {leader!r}, which has no motor (see joints)")
        followers[first] = second, ratio, offset
        reach = np.sort(ratio * model.jnt_range[second] + offset)
        low, high = model.jnt_range[first]
        if model.jnt_limited[first] and (reach[0] < low - _SLACK or reach[1] > high + _SLACK):
            taken = f"{leader!r} takes it from {reach[0]:.4g} to {reach[1]:.4g}"
            raise ConfigError(f"joint {name!r} has the range {low:.4g} to {high:.4g} rad, and {taken}")
    return followers


def _check_joints(model: Any, table: HandFile, joints: list[int], followers: int) -> None:
    """Every joint is a hinge that the TOML lists or that follows one, with limits; postures are within them: degrees,
    in the TOML or as ranges of the MJCF, are not."""
    import mujoco

    motors = model.njnt - followers
    hinges = np.all(model.jnt_type == mujoco.mjtJoint.mjJNT_HINGE)
    if len(joints) != motors or len(set(joints)) != motors or not hinges:
        raise ConfigError(
            f"joints lists {len(set(joints))} of the {motors} joints that follow none, expected all: hinges"
        )
    postures = {"grasp.posture": table.grasp.posture, "rotate.posture": table.rotate.posture}
    for name, values in {"speed_limits": table.speed_limits, "gains": table.gains, **postures}.items():
        if len(values) != len(joints) and (values or name == "speed_limits"):
            raise ConfigError(f"{len(values)} {name} for {len(joints)} joints")
    for place, (name, joint) in enumerate(zip(table.joints, joints, strict=True)):
        (low, high), torque = model.jnt_range[joint], model.jnt_actfrcrange[joint]
        if not model.jnt_limited[joint] or torque[1] <= 0 or not np.isclose(torque[0], -torque[1]):
            raise ConfigError(f"joint {name!r} needs a range, and its stall torque as actuatorfrcrange, got {torque}")
        for angle in (posture[place] for posture in postures.values() if posture):
            if not low - _SLACK <= angle <= high + _SLACK:
                span = f"{low:.4g} to {high:.4g} rad"
                raise ConfigError(f"posture: {angle:g} rad of {name!r} is outside of its range in the MJCF, {span}")


def _find_tips(model: Any, table: HandFile, row: dict[int, int]) -> list[int]:
    """Each finger's tip site; its root joint must be one of the TOML's, and move it."""
    tips: list[int] = []
    for finger in table.fingers:
        tip, root = model.site(finger.tip).id, model.joint(finger.root_joint).id
        body, name = int(model.site_bodyid[tip]), f"tip {finger.tip!r}"
        # The physics gives the force on a link, not where on it.
        if body not in row or body in model.site_bodyid[tips]:
            raise ConfigError(f"{name} is on {model.body(body).name!r}, expected a link of {table.palm!r} of its own")
        if finger.root_joint not in table.joints or not is_below(model.body_parentid, body, model.jnt_bodyid[root]):
            raise ConfigError(f"root_joint {finger.root_joint!r} is not among joints, or does not move {name}")
        tips.append(tip)
    return tips


def _lay_taxels(table: HandFile, geoms: tuple[Geom, ...], tip_body: np.ndarray) -> np.ndarray:
    """The taxels [F, N, 7] of lattices on the fingers' pads: position, normal, area in the tip bodies' frames."""
    taxels = []
    for finger, body in zip(table.fingers, tip_body, strict=True):
        with naming_file(f"finger {finger.name!r}"):
            pad = next((geom for geom in geoms if geom.name == finger.pad and geom.body == body), None)
            if pad is None or pad.kind not in ("capsule", "sphere"):
                raise ConfigError(f"pad = {finger.pad!r}: expected a capsule or sphere of the tip's body")
            along = np.asarray(pad.rotation[:, 2], float)
            facing = np.asarray(finger.facing or along, float)
            across = facing - np.dot(facing, along) * along
            if not np.linalg.norm(across) > 1e-3 * np.linalg.norm(facing):
                raise ConfigError(f"facing = {finger.facing}: expected a direction across the pad {pad.name!r}")
            across /= np.linalg.norm(across)
            turn, (radius, half_length, _) = np.stack([across, np.cross(along, across), along], -1), pad.size.tolist()
            capsule = {"radius": radius, "half_length": half_length, "pitch": table.taxel_pitch or 0.0}
            taxels.append(lay_taxels(table.taxel_grid, position=pad.position, rotation=turn, **capsule))
    return _f32(taxels)


def _f32(values) -> np.ndarray:
    return np.asarray(values, np.float32)


def rotation_matrix(quat: Any) -> np.ndarray:
    """[3, 3] of a quaternion (w, x, y, z)."""
    import mujoco

    matrix = np.zeros(9)
    mujoco.mju_quat2Mat(matrix, np.asarray(quat, float))
    return matrix.reshape(3, 3)


def is_below(parent: np.ndarray, body: int, ancestor: int) -> bool:
    """Whether a body [B] of MuJoCo's is another one or below it."""
    while body > 0 and body != ancestor:
        body = int(parent[body])
    return body == ancestor


def _read_geoms(model: Any, row: dict[int, int]) -> tuple[Geom, ...]:
    names = SHAPES | {0: "plane"}
    geoms = []
    for g in range(model.ngeom):
        kind, touches = names.get(int(model.geom_type[g])), bool(model.geom_contype[g] | model.geom_conaffinity[g])
        body = int(model.geom_bodyid[g])
        if body not in row:
            continue
        if kind is None and touches:
            which = f"geom {model.geom(g).name or f'#{g}'!r} of {model.body(body).name!r}"
            raise ConfigError(f"{which} is no primitive and touches: meshes need contype and conaffinity 0")
        if kind is not None:
            size, position, rotation = model.geom_size[g], model.geom_pos[g], rotation_matrix(model.geom_quat[g])
            geoms.append(Geom(model.geom(g).name, kind, row[body], _f32(size), _f32(position), _f32(rotation), touches))
    return tuple(geoms)
