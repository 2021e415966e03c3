"""The hand, read from files; its description and kinematics are those of `dexsim.hand.kinematics`.

`load_hand` reads an MJCF, a taxel layout and a short TOML, so nothing in the library but the
files under `assets/hand/` knows which hand it is.
"""

import re
from pathlib import Path
from typing import Any

import numpy as np

from dexsim.core.errors import AssetError
from dexsim.core.files import read_toml
from dexsim.hand.coupling import read_followers
from dexsim.hand.files import digest_of, find_hand, shipped_name
from dexsim.hand.kinematics import Geom, Hand
from dexsim.hand.layout import MOST, read_taxels
from dexsim.hand.pads import are_numbers, lay_taxels

_SLACK = 1e-3  # rad, how far a posture may be beyond a joint's range
_ENTRIES = (
    *("name", "model", "palm", "joints", "speed_limits"),
    *("taxels", "taxel_grid", "taxel_pitch", "grasp", "rotate", "fingers"),
)
_FINGER_ENTRIES = ("name", "tip", "root_joint", "force_per_torque", "pad", "facing")


def load_hand(path: str | Path | None = None) -> Hand:
    """Read a hand from its TOML, or a shipped one by its name; the XHand when `path` is None.

    Raises:
      AssetError: a file is missing or broken, or the three do not fit together.
    """
    given, path = path, find_hand(path)
    table = _read_toml(path)
    _check_table(path, table)
    model_path = path.parent / table["model"]
    model = _load_model(path, model_path)
    joints, followers = _find_joints(path, model_path, model, table)
    _check_postures(path, model, joints, table)
    palm = _find(path, model_path, model, "body", table["palm"])
    bodies = [b for b in range(1, model.nbody) if _is_below(model.body_parentid, b, palm)]
    if unnamed := [b for b in bodies if not model.body(b).name]:
        parent = model.body(model.body_parentid[unnamed[0]]).name
        raise AssetError(f"{model_path}: a body of {parent!r} has no name: every link from the palm on needs one")
    row = {body: i for i, body in enumerate(bodies)}
    at = _hinges_of_bodies(model_path, model, palm, row)
    has = at >= 0
    moved = {joint: (joint, 1.0, 0.0) for joint in joints} | followers | {-1: (-1, 1.0, 0.0)}
    body_motor, body_ratio, body_offset = zip(*(moved[hinge] for hinge in at), strict=True)
    tips, root = _find_fingers(path, model_path, model, table, row)
    finger_names = tuple(finger["name"] for finger in table["fingers"])
    tip_body = np.array([row[int(model.site_bodyid[s])] for s in tips], np.int32)
    geoms = _read_geoms(model_path, model, row)
    files: tuple[Path, ...] = (path, model_path)
    if "taxels" in table:
        files = (*files, path.parent / table["taxels"])
        taxels = read_taxels(files[-1], finger_names, table["taxel_grid"])
    else:
        taxels = lay_taxels(path, table, geoms, tip_body)
    parent = np.array([row.get(int(model.body_parentid[b]), -1) for b in bodies])
    for finger, site in zip(table["fingers"], tips, strict=True):
        rooted = int(model.jnt_bodyid[_find(path, model_path, model, "joint", finger["root_joint"])])
        if not _is_below(model.body_parentid, int(model.site_bodyid[site]), rooted):
            raise AssetError(f"{path}: root_joint {finger['root_joint']!r} does not move the tip {finger['tip']!r}")
    identity = np.eye(3)

    return Hand(
        name=table.get("name", path.stem),
        model_path=model_path,
        palm=table["palm"],
        joint_names=tuple(table["joints"]),
        joint_lower=_f32(model.jnt_range[joints, 0]),
        joint_upper=_f32(model.jnt_range[joints, 1]),
        torque_limit=_f32(model.jnt_actfrcrange[joints, 1]),
        speed_limit=_f32(table["speed_limits"]),
        body_names=tuple(model.body(b).name for b in bodies),
        body_parent=parent,
        body_position=_f32([np.zeros(3) if b == palm else model.body_pos[b] for b in bodies]),
        body_rotation=_f32([identity if b == palm else _matrix(model.body_quat[b]) for b in bodies]),
        body_joint=np.array([joints.index(joint) if joint >= 0 else -1 for joint in body_motor], np.int32),
        body_ratio=_f32(body_ratio),
        body_offset=_f32(body_offset),
        joint_axis=_f32(np.where(has[:, None], model.jnt_axis[at], [0, 0, 1])),
        joint_anchor=_f32(np.where(has[:, None], model.jnt_pos[at], 0)),
        joint_reference=_f32(np.where(has, model.qpos0[model.jnt_qposadr[at]], 0)),
        finger_names=finger_names,
        tip_body=tip_body,
        tip_offset=_f32(model.site_pos[tips]),
        root_joint=np.array(root, np.int32),
        force_per_torque=_f32([finger.get("force_per_torque", 0.0) for finger in table["fingers"]]),
        taxel_grid=tuple(table["taxel_grid"]),
        taxel_position=taxels[..., 0:3],
        taxel_normal=taxels[..., 3:6],
        taxel_area=taxels[..., 6],
        geoms=geoms,
        grasp_posture=_numbers(table, "grasp", "posture"),
        grasp_centre=_numbers(table, "grasp", "centre"),
        rotate_posture=_numbers(table, "rotate", "posture"),
        rotate_reference=_numbers(table, "rotate", "reference"),
        source=shipped_name(path) or str(given),
        digest=digest_of(*files),
    )


def _load_model(path: Path, model_path: Path) -> Any:
    import mujoco

    if not model_path.is_file():
        raise AssetError(f"{model_path}: no such file (model of {path})")
    try:
        model = mujoco.MjModel.from_xml_path(str(model_path))
    except ValueError as error:
        raise AssetError(f"{model_path}: {' '.join(str(error).split())}") from None
    _check_numbers(model, model_path)
    for kind, count in (("body", model.nbody), ("joint", model.njnt), ("geom", model.ngeom)):
        for name in (getattr(model, kind)(index).name for index in range(count)):
            if re.fullmatch(r"object(_\d+)?", name):
                raise AssetError(f"{model_path}: {kind} {name!r}: what the hand holds has this name; choose another")
    return model


def _find(path: Path, model_path: Path, model: Any, kind: str, name: str) -> int:
    """Index of a joint, body or site."""
    import mujoco

    index = mujoco.mj_name2id(model, getattr(mujoco.mjtObj, f"mjOBJ_{kind.upper()}"), name)
    if index < 0:
        raise AssetError(f"{path}: {model_path.name} has no {kind} {name!r}")
    return index


def _find_joints(
    path: Path, model_path: Path, model: Any, table: dict
) -> tuple[list[int], dict[int, tuple[int, float, float]]]:
    """The model's joints in the order of the TOML, and those that follow them (`read_followers`)."""
    import mujoco

    joints = [_find(path, model_path, model, "joint", name) for name in table["joints"]]
    followers = read_followers(model_path, model, joints)
    if len(set(joints)) != model.njnt - len(followers) or len(set(joints)) != len(joints) or model.nq != model.njnt:
        raise AssetError(
            f"{path}: joints lists {len(set(joints))} of the {model.njnt - len(followers)} joints of "
            f"{model_path.name}; every joint must be a hinge, and be listed once or follow one by an equality"
        )
    if np.any(model.jnt_type != mujoco.mjtJoint.mjJNT_HINGE):
        raise AssetError(f"{model_path}: only hinge joints are supported")
    if len(table["speed_limits"]) != len(joints):
        raise AssetError(f"{path}: {len(table['speed_limits'])} speed_limits for {len(joints)} joints")
    for name, joint, (low, high) in zip(table["joints"], joints, model.jnt_actfrcrange[joints], strict=True):
        if not model.jnt_limited[joint] or high <= 0:
            raise AssetError(f"{model_path}: joint {name!r} needs a range and an actuatorfrcrange")
        if not np.isclose(low, -high):
            raise AssetError(
                f"{model_path}: joint {name!r} has the actuatorfrcrange {low:g} to {high:g} Nm: a motor's stall torque "
                "is the same both ways"
            )
    return joints, followers


def _hinges_of_bodies(model_path: Path, model: Any, palm: int, row: dict[int, int]) -> np.ndarray:
    """The model's joint [B] that moves each body; -1 for none."""
    hinges = np.full(len(row), -1)
    for joint in range(model.njnt):
        body = int(model.jnt_bodyid[joint])
        if body not in row or body == palm or hinges[row[body]] >= 0:
            raise AssetError(
                f"{model_path}: joint {model.joint(joint).name!r} must be the only joint of a body below "
                f"{model.body(palm).name!r}"
            )
        hinges[row[body]] = joint
    return hinges


def _find_fingers(
    path: Path, model_path: Path, model: Any, table: dict, row: dict[int, int]
) -> tuple[list[int], list[int]]:
    """Each finger's tip site and its first joint, as an index into the TOML's."""
    tips = [_find(path, model_path, model, "site", finger["tip"]) for finger in table["fingers"]]
    bodies = [int(body) for body in model.site_bodyid[tips]]
    for number, (finger, body) in enumerate(zip(table["fingers"], bodies, strict=True)):
        if body not in row:
            raise AssetError(f"{path}: tip {finger['tip']!r} is on no body of {table['palm']!r}")
        if body in bodies[:number]:  # The physics gives the force on a link, not where on it.
            raise AssetError(f"{path}: tip {finger['tip']!r} is on {model.body(body).name!r}, as another finger's tip")
        if finger["root_joint"] not in table["joints"]:
            raise AssetError(f"{path}: root_joint {finger['root_joint']!r} is not among joints")
    return tips, [table["joints"].index(finger["root_joint"]) for finger in table["fingers"]]


def _check_postures(path: Path, model: Any, joints: list[int], table: dict) -> None:
    """Postures lie in the joints' ranges: degrees, in the TOML or as ranges of the MJCF, do not."""
    for task in ("grasp", "rotate"):
        for name, joint, angle in zip(table["joints"], joints, _numbers(table, task, "posture"), strict=False):
            low, high = model.jnt_range[joint]
            if not low - _SLACK <= angle <= high + _SLACK:
                raise AssetError(
                    f"{path}: {task}.posture: {angle:g} rad of {name!r} is outside of its range in the MJCF, "
                    f"{low:.4g} to {high:.4g} rad"
                )


def _check_known(path: Path, where: str, table: dict, known: tuple[str, ...]) -> None:
    """A misspelt entry would count as one that is left out."""
    for key in table:
        if key not in known:
            raise AssetError(f"{path}: {where}unknown entry {key!r:.60}: choose from {', '.join(known)}")


def _check_table(path: Path, table: dict) -> None:
    """Entries and their types; names are checked against the model by `load_hand`."""
    _check_known(path, "", table, _ENTRIES)
    kinds = {
        "model": str,
        "taxel_grid": list,
        "palm": str,
        "joints": list,
        "speed_limits": list,
        "fingers": list,
    }
    for key, kind in kinds.items():
        if key not in table:
            raise AssetError(f"{path}: no entry {key!r}")
        if not isinstance(table[key], kind):
            raise AssetError(f"{path}: {key} = {table[key]!r:.60}: expected a {'string' if kind is str else 'list'}")
    if not isinstance(table.get("taxels", ""), str):
        raise AssetError(f"{path}: taxels = {table['taxels']!r:.60}: expected a string")
    if "taxels" in table and "taxel_pitch" in table:
        raise AssetError(f"{path}: taxels is a file and taxel_pitch a lattice in place of it: give one of them")
    for task, place in (("grasp", "centre"), ("rotate", "reference")):
        given = table.get(task, {})
        for key, length in (("posture", len(table["joints"])), (place, 3)):
            values = given.get(key, [0] * length) if isinstance(given, dict) else None
            if not are_numbers(values, length):
                raise AssetError(f"{path}: {task}.{key} = {values!r:.60}: expected {length} numbers")
        _check_known(path, f"[{task}]: ", given, ("posture", place))
    if not isinstance(table.get("name", ""), str):
        raise AssetError(f"{path}: name = {table['name']!r:.60}: expected a string")
    grid, speeds = table["taxel_grid"], table["speed_limits"]
    if len(grid) != 2 or any(type(n) is not int or not 1 <= n <= MOST for n in grid):
        raise AssetError(f"{path}: taxel_grid = {grid!s:.60}: expected two whole numbers above 0, at most {MOST}")
    for v in speeds:
        if type(v) not in (int, float) or not 0 < v <= 1000:
            raise AssetError(f"{path}: {v!r:.60} in speed_limits: expected numbers above 0, at most 1000 rad/s")
    if any(type(name) is not str for name in table["joints"]) or not table["fingers"]:
        raise AssetError(f"{path}: joints must list names, and there must be a finger")
    for number, finger in enumerate(table["fingers"], start=1):
        for key in ("name", "tip", "root_joint"):
            if not isinstance(finger, dict) or not isinstance(finger.get(key), str):
                raise AssetError(f"{path}: finger {number} has no entry {key!r}")
        for key in ("name", "tip"):
            if sum(other[key] == finger[key] for other in table["fingers"][:number]) > 1:
                raise AssetError(f"{path}: finger {number}: {key} = {finger[key]!r:.60} is that of another finger")
        force = finger.get("force_per_torque", 0.0)
        if type(force) not in (int, float) or not 0 <= force <= 1000:
            raise AssetError(f"{path}: finger {number}: force_per_torque = {force!r:.60}: expected 0 to 1000 N/Nm")
        _check_known(path, f"finger {number}: ", finger, _FINGER_ENTRIES)


def _check_numbers(model, path: Path) -> None:
    """MuJoCo only warns of a NaN in the XML, and takes a joint that drives itself."""
    fields = {
        "body": ("pos", "quat", "ipos", "mass", "inertia"),
        "geom": ("pos", "quat", "size", "friction", "solref", "solimp", "margin", "gap"),
        "jnt": ("pos", "axis", "range", "actfrcrange", "stiffness"),
        "site": ("pos", "quat"),
        "eq": ("data", "solref", "solimp"),
    }
    numbers = [(kind, name, getattr(model, f"{kind}_{name}")) for kind, names in fields.items() for name in names]
    numbers.append(("jnt", "ref", model.qpos0[model.jnt_qposadr]))
    resists = ("damping", "armature", "frictionloss")
    numbers += [("jnt", name, getattr(model, f"dof_{name}")[model.jnt_dofadr]) for name in resists]
    for kind, name, values in numbers:
        infinite = ~np.isfinite(values)
        for wrong, what in ((infinite, "not a finite number"), ((values < 0) & (name in resists), "below 0")):
            if wrong.any():
                row = int(np.argwhere(wrong)[0, 0])
                element = getattr(model, "equality" if kind == "eq" else kind)(row).name or f"#{row}"
                raise AssetError(f"{path}: {kind} {element!r}: {name} is {what}")


def _numbers(table: dict, task: str, key: str) -> tuple[float, ...]:
    return tuple(map(float, table.get(task, {}).get(key, ())))


def _f32(values) -> np.ndarray:
    return np.asarray(values, np.float32)


def _matrix(quat: np.ndarray) -> np.ndarray:
    import mujoco

    matrix = np.zeros(9)
    mujoco.mju_quat2Mat(matrix, quat)
    return matrix.reshape(3, 3)


def _is_below(parent: np.ndarray, body: int, ancestor: int) -> bool:
    while body > 0:
        if body == ancestor:
            return True
        body = int(parent[body])
    return False


def _read_geoms(path: Path, model: Any, row: dict[int, int]) -> tuple[Geom, ...]:
    names = {2: "sphere", 3: "capsule", 4: "ellipsoid", 5: "cylinder", 6: "box", 0: "plane"}
    geoms = []
    for g in range(model.ngeom):
        kind, touches = names.get(int(model.geom_type[g])), bool(model.geom_contype[g] | model.geom_conaffinity[g])
        if kind is None and touches and int(model.geom_bodyid[g]) in row:
            body = model.body(int(model.geom_bodyid[g])).name
            raise AssetError(
                f"{path}: geom {model.geom(g).name or f'#{g}'!r} of {body!r} is no primitive and touches: meshes are "
                "drawn only (contype and conaffinity 0); put capsules, spheres or boxes in its place"
            )
        if int(model.geom_bodyid[g]) in row and kind is not None:
            geoms.append(
                Geom(
                    model.geom(g).name,
                    kind,
                    row[int(model.geom_bodyid[g])],
                    _f32(model.geom_size[g]),
                    _f32(model.geom_pos[g]),
                    _f32(_matrix(model.geom_quat[g])),
                    touches,
                )
            )
    return tuple(geoms)


def _read_toml(path: Path) -> dict:
    try:
        return read_toml(path)
    except FileNotFoundError:
        raise AssetError(f"{path}: no such file") from None
    except (OSError, ValueError) as error:
        raise AssetError(f"{path}: {error}") from None
