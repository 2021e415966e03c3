"""A maker's description of a hand, URDF or MJCF, as plain arrays: the palm and the links that move on it.

Everything is in one frame, the palm body's, with every hinge at 0. So a link has no frame of its own, and a hinge is
an axis and a point on it. Units: m, rad, kg, Nm.
"""

import dataclasses
import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import trimesh

from dexsim.core.config import Config, setting
from dexsim.errors import AssetError, ConfigError
from dexsim.hand.description import SHAPES, primitive_mesh
from dexsim.hand.fit import Capsule, PalmBox
from dexsim.hand.load import is_below, read_coupling

LEAST_MASS = 1e-3
"""kg, of a link that the file gives none."""
_NO_MASS = 2e-6  # kg; a URDF's links without a mass are read with half of it
_NO_INERTIA = 1e-13  # kg m^2, below which MuJoCo takes it for none
_LEAST_INERTIA = 1e-7  # kg m^2
_LARGEST = 2.0  # m, of a link: none of a hand is so large
Direction = tuple[float, float, float]


@dataclasses.dataclass(frozen=True, kw_only=True)
class ImportConfig(Config):
    """What a file does not say, or what is to be read otherwise."""

    palm: str = ""
    """Body of the palm; empty for the one where all fingers begin."""
    thumb: str = ""
    """A link or joint of the thumb; empty to find it."""
    fingers: Direction | None = None
    """Direction in the file's axes in which the fingers point, as 0 0 1; None to find it."""
    normal: Direction | None = None
    """Direction in the file's axes that the palm faces; None to find it."""
    freeze: tuple[str, ...] = ()
    """Joints to fix at 0. Joints above the palm are fixed anyway."""
    couple: tuple[str, ...] = ()
    """FOLLOWER=LEADER:RATIO: a joint that follows another by a tendon."""
    drop_tendons: bool = False
    """Leave tendons out; see --couple."""
    torque: float = setting(0.0, unit="Nm", low=0.0, high=100.0)
    """Stall torque of all motors; 0 for the file's."""
    speed: float = setting(0.0, unit="rad/s", low=0.0, high=1000.0)
    """No-load speed of all motors; 0 for the file's."""


@dataclasses.dataclass(eq=False, kw_only=True)
class Link:
    """Bodies that move as one, and the hinge that moves them; the palm, the first link of a hand, has none. Parents
    come before their children."""

    name: str
    parent: int  # -1 for the palm
    mass: float = LEAST_MASS
    centre: np.ndarray  # [3] m, of mass
    inertia: np.ndarray  # [3, 3] kg m^2 about the centre
    surface: Any = None  # trimesh.Trimesh; None where the file has no shape that can be read
    capsule: Capsule | None = None  # fitted to the surface; a fingertip's is its pad
    joint: str = ""  # name of the hinge
    axis: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros(3))  # unit
    anchor: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros(3))  # m, a point on the axis
    low: float = 0.0
    high: float = 0.0
    torque: float = 0.0  # Nm, stall torque; 0: not known
    speed: float = 0.0  # rad/s, no-load speed; 0: not known
    leader: str = ""  # the hinge that this one follows: angle = offset + ratio * the leader's
    ratio: float = 1.0
    offset: float = 0.0

    @property
    def is_motor(self) -> bool:
        """Whether the hinge has a motor of its own."""
        return bool(self.joint) and not self.leader


@dataclasses.dataclass(eq=False, kw_only=True)
class Draft:
    """A hand on the way from a maker's file to a folder. `read_hand` begins it, in the file's axes; `anatomy.orient`
    finds fingers and signs and turns it into the library's palm frame; `import_hand.fit_links` fills in the rest."""

    name: str
    links: list[Link]
    findings: list[str]  # lines for people: what was found, left out, assumed, and is in doubt
    # From `anatomy.orient`.
    fingers: dict[str, list[int]] = dataclasses.field(default_factory=dict)  # links up to the tip's; thumb first
    side: str = "right"  # or left
    palm: PalmBox = PalmBox(np.zeros(3), np.zeros(3), 0.0)  # from `import_hand.fit_links`

    @property
    def motors(self) -> list[Link]:
        """Links with a motor, finger by finger: the order of joints in the TOML."""
        order = dict.fromkeys(at for chain in self.fingers.values() for at in chain)
        return [self.links[at] for at in order if self.links[at].is_motor]


def read_hand(path: Path, options: ImportConfig) -> Draft:
    """Read a hand from a URDF or MJCF. Raises AssetError: not readable, not a hand, or something that a hand's folder
    cannot hold."""
    notes: list[str] = []
    try:
        root = ElementTree.fromstring(path.read_bytes())
        if root.tag not in ("robot", "mujoco"):
            raise ConfigError(f"expected <robot> (URDF) or <mujoco> (MJCF), got <{root.tag}>; expand a xacro first")
        spec = _read_urdf(path, root, notes) if root.tag == "robot" else _read_mjcf(path, notes)
        if spec.tendons:
            _drop_tendons(spec, options.drop_tendons)
        # Velocity limits, which MuJoCo does not read.
        limits = [(joint.get("name", ""), limit) for joint in root.findall("joint") for limit in joint.findall("limit")]
        speeds = {name: float(limit.get("velocity", 0)) for name, limit in limits}
        links = _read_links(spec.compile(), options, speeds, notes)
        for link in links:
            if link.surface is not None and np.max(link.surface.extents) > _LARGEST:
                long = f"link {link.name} is {np.max(link.surface.extents):.0f} m long"
                raise ConfigError(f'{long}: meshes in millimetres need scale="0.001 0.001 0.001"')
    except FileNotFoundError:
        raise AssetError(f"{path}: no such file") from None
    except (ElementTree.ParseError, KeyError, ValueError, ConfigError) as error:  # KeyError as in `load_hand`
        raise AssetError(f"{path}: {' '.join(str(error.args[0]).split())}") from None
    return Draft(name=root.get("name") or root.get("model") or path.stem, links=links, findings=notes)


def _read_urdf(path: Path, root: ElementTree.Element, notes: list[str]) -> mujoco.MjSpec:
    """The file as MuJoCo reads it, with meshes that trimesh has read: MuJoCo takes no DAE and GLB, and would not find
    `package://`."""
    assets: dict[str, bytes] = {}
    for link in root.iter("link"):
        for kind in ("visual", "collision"):  # what is drawn is the real shape; the other is often a box round it
            drawn = kind == "collision" and link.find("visual") is not None
            for element in link.findall(kind):
                if drawn or not _embed_mesh(path, element, assets, notes):
                    link.remove(element)
        inertial = link.find("inertial")
        if inertial is not None and np.any(np.linalg.eigvalsh(_tensor(inertial.find("inertia"))) < _NO_INERTIA):
            notes.append(f"note         link {link.get('name')}: its inertia is no inertia, left out")
            link.remove(inertial)
    for extra in root.findall("mujoco"):
        root.remove(extra)
    compiler = ElementTree.SubElement(ElementTree.SubElement(root, "mujoco"), "compiler")
    # MuJoCo would fuse the palm with the world.
    compiler.attrib |= {
        "fusestatic": "false",
        "discardvisual": "false",
        "balanceinertia": "true",
        "boundmass": str(_NO_MASS / 2),
        "boundinertia": "1e-10",
    }
    spec = mujoco.MjSpec.from_string(ElementTree.tostring(root, encoding="unicode"), assets=assets)
    for mesh in spec.meshes:
        mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL  # open ones have no volume
    for geom in spec.geoms:
        geom.density, geom.mass = 0.0, 0.0  # masses are the links'
    return spec


def _embed_mesh(path: Path, element: ElementTree.Element, assets: dict[str, bytes], notes: list[str]) -> bool:
    """Put the mesh of a visual or collision element, if it has one, into `assets`; whether the element has a shape."""
    shape = element.find("geometry/mesh")
    if shape is None:
        return element.find("geometry/*") is not None
    name, file = shape.get("filename", ""), f"{len(assets)}.obj"
    try:
        mesh = trimesh.load(_find_file(path, name), force="mesh", process=False)
    except Exception as error:  # each of trimesh's readers raises its own
        notes.append(f"note         mesh {name}: {' '.join(str(error).split())[:80]}")
        return False
    shape.set("filename", file)
    assets[file] = mesh.export(file_type="obj", include_normals=False, include_texture=False).encode()
    return len(mesh.faces) > 0


def _find_file(path: Path, name: str) -> Path:
    """A mesh that a URDF names: beside it, or below any folder above it that has the rest of the name."""
    rest = Path(name.partition("://")[2] or name)
    names = [Path(*rest.parts[1:]), rest] if name.startswith("package://") else [rest]
    places = [path.parent / rest, *(folder / part for part in names for folder in path.resolve().parents)]
    return next((place for place in places if place.is_file()), places[0])


def _tensor(inertia: ElementTree.Element | None) -> np.ndarray:
    """The tensor [3, 3] of a URDF's <inertia>; zeros for none."""
    names = (("ixx", "ixy", "ixz"), ("ixy", "iyy", "iyz"), ("ixz", "iyz", "izz"))
    return np.array([[0.0 if inertia is None else float(inertia.get(name, 0)) for name in row] for row in names])


def _read_mjcf(path: Path, notes: list[str]) -> mujoco.MjSpec:
    """The file without the shapes whose meshes are missing."""
    if path.suffix != ".xml":
        raise ConfigError("MuJoCo opens an MJCF only as .xml: rename it")
    spec = mujoco.MjSpec.from_file(str(path))
    folder = path.parent / (spec.meshdir or "")
    missing = {mesh.name for mesh in spec.meshes if mesh.file and not (folder / mesh.file).is_file()}
    for geom in [geom for geom in spec.geoms if geom.meshname in missing]:
        spec.delete(geom)
    for mesh in [mesh for mesh in spec.meshes if mesh.name in missing]:
        notes.append(f"note         mesh {mesh.file}: no such file")
        spec.delete(mesh)
    return spec


def _drop_tendons(spec: mujoco.MjSpec, allowed: bool) -> None:
    if not allowed:
        names = ", ".join(tendon.name for tendon in spec.tendons)[:60]
        remedy = "give --drop-tendons and, for joints without a motor, --couple FOLLOWER=LEADER:RATIO"
        raise ConfigError(f"tendons {names}: not supported; {remedy}")
    pulled = [actuator for actuator in spec.actuators if actuator.trntype == mujoco.mjtTrn.mjTRN_TENDON]
    tied = [equality for equality in spec.equalities if equality.type == mujoco.mjtEq.mjEQ_TENDON]
    for element in (*spec.keys, *spec.sensors, *pulled, *tied, *spec.tendons):
        spec.delete(element)


def _find_palm(model: mujoco.MjModel, palm: str, frozen: set[int]) -> int:
    """The body from which all chains of hinges branch off."""
    if palm:
        return model.body(palm).id
    parents, moving = model.body_parentid, {int(model.jnt_bodyid[j]) for j in range(model.njnt) if j not in frozen}
    tips = [body for body in moving if not any(is_below(parents, other, body) for other in moving - {body})]
    if len(tips) < 2:
        raise ConfigError(f"expected a hand of two fingers or more, got {len(tips)} chains of hinges")
    # Parents come before children.
    return max(body for body in range(model.nbody) if all(is_below(parents, tip, body) for tip in tips))


def _read_followers(
    model: mujoco.MjModel, names: list[str], joints: list[int], couple: Sequence[str], notes: list[str]
) -> dict[int, tuple[int, float, float]]:
    """Joints that follow another one: which, by what ratio, from what offset [rad]."""
    direct: dict[int, tuple[int, float, float]] = {}
    for e in range(model.neq):
        if coupling := read_coupling(model, e):
            direct[coupling[0]] = coupling[1:]
        else:
            notes.append(f"note         equality {model.equality(e).name or e}: left out, it couples no two joints")
    for text in couple:
        try:
            follower, leader, ratio = re.split("[=:]", text)
            direct[names.index(follower)] = names.index(leader), float(ratio), 0.0
        except ValueError:
            which = f"joints of {', '.join(names)}"
            raise ConfigError(f"--couple {text}: expected FOLLOWER=LEADER:RATIO, {which}") from None
    followers = {}
    for first, (motor, ratio, offset) in direct.items():
        for _ in range(len(direct)):  # a follower of a follower
            if motor in direct:
                above, factor, shift = direct[motor]
                motor, ratio, offset = above, ratio * factor, offset + ratio * shift
        if motor in joints and motor != first:
            followers[first] = motor, ratio, offset
    return followers


def _stall_torques(model: mujoco.MjModel) -> dict[int, float]:
    """Stall torque of each joint: its own limit, or that of the actuator on it."""
    torques = {j: float(model.jnt_actfrcrange[j, 1]) for j in range(model.njnt) if model.jnt_actfrclimited[j]}
    for a in range(model.nu):
        j, gear = int(model.actuator_trnid[a, 0]), abs(model.actuator_gear[a, 0])
        if model.actuator_trntype[a] != mujoco.mjtTrn.mjTRN_JOINT or j in torques:
            continue
        if model.actuator_forcelimited[a]:
            torques[j] = float(gear * model.actuator_forcerange[a, 1])
        elif model.actuator_ctrllimited[a] and model.actuator_biastype[a] == mujoco.mjtBias.mjBIAS_NONE:
            torques[j] = float(gear * model.actuator_gainprm[a, 0] * model.actuator_ctrlrange[a, 1])
    return torques


def _read_links(model: mujoco.MjModel, options: ImportConfig, speeds: dict[str, float], notes: list[str]) -> list[Link]:
    """The palm and a link for each hinge below it that is not frozen; of two hinges on one body the first moves a link
    without a shape."""
    names, freeze = [model.joint(j).name or f"joint_{j}" for j in range(model.njnt)], options.freeze
    if unknown := set(freeze) - set(names):
        raise ConfigError(f"--freeze {sorted(unknown)[0]}: no such joint; it has {', '.join(names)}")
    palm = _find_palm(model, options.palm, {j for j, joint in enumerate(names) if joint in freeze})
    below = [b for b in range(model.nbody) if b != palm and is_below(model.body_parentid, b, palm)]
    joints = [j for j in range(model.njnt) if model.jnt_bodyid[j] in below and names[j] not in freeze]
    if frozen := [name for j, name in enumerate(names) if j not in joints]:
        notes.append(f"frozen at 0  {', '.join(frozen)}: above the palm, or by --freeze")
    if other := [names[j] for j in joints if model.jnt_type[j] != mujoco.mjtJoint.mjJNT_HINGE]:
        raise ConfigError(f"joint {other[0]!r} is not a hinge: --freeze {other[0]} fixes it at 0")
    followers, torques = _read_followers(model, names, joints, options.couple, notes), _stall_torques(model)
    data = _pose_in_palm_frame(model, palm)
    last = {int(model.jnt_bodyid[j]): j for j in joints}  # of each body that moves
    links, row = [Link(parent=-1, **_read_body(model, data, palm, last))], {palm: 0}
    for j in joints:
        body, above = int(model.jnt_bodyid[j]), int(model.jnt_bodyid[j])
        while above not in row:  # the body itself where another hinge moves it already
            above = int(model.body_parentid[above])
        content = {"name": f"{names[j]}_link", "centre": data.xanchor[j], "inertia": _LEAST_INERTIA * np.eye(3)}
        if j == last[body]:
            content = _read_body(model, data, body, last)
        low, high = model.jnt_range[j] if model.jnt_limited[j] else (-np.pi, np.pi)
        leader, ratio, offset = followers.get(j, (-1, 1.0, 0.0))
        if leader < 0 and not model.jnt_limited[j]:
            notes.append(f"assumed      joint {names[j]}: no range in the file, half a turn to both sides")
        link = Link(
            parent=row[above],
            joint=names[j],
            axis=data.xaxis[j],
            anchor=data.xanchor[j],
            low=float(low),
            high=float(high),
            torque=torques.get(j, 0.0),
            speed=speeds.get(names[j], 0.0),
            leader=names[leader] if leader >= 0 else "",
            ratio=ratio,
            offset=offset,
            **content,
        )
        row[body] = len(links)
        links.append(link)
    return links


def _pose_in_palm_frame(model: mujoco.MjModel, palm: int) -> mujoco.MjData:
    """Poses of all bodies, joints and geoms with every hinge at 0, in the palm's frame in place of the world's."""
    data = mujoco.MjData(model)
    data.qpos[model.jnt_qposadr[model.jnt_type == mujoco.mjtJoint.mjJNT_HINGE]] = 0.0
    mujoco.mj_kinematics(model, data)
    turn, origin = data.xmat[palm].reshape(3, 3).copy(), data.xpos[palm].copy()
    for points in (data.xpos, data.xipos, data.xanchor, data.geom_xpos):
        points[:] = (points - origin) @ turn
    for axes in (data.xmat, data.ximat, data.geom_xmat):
        axes[:] = (turn.T @ axes.reshape(-1, 3, 3)).reshape(-1, 9)
    data.xaxis[:] = data.xaxis @ turn
    return data


def _read_body(model: mujoco.MjModel, data: mujoco.MjData, body: int, moving: Collection[int]) -> dict[str, Any]:
    """Name, mass and surface of a body with all that is fixed to it: fields of `Link`."""
    members = [body]
    for other in range(body + 1, model.nbody):
        if int(model.body_parentid[other]) in members and other not in moving:
            members.append(other)
    masses = model.body_mass[members]
    # MuJoCo puts the centre of a body without mass and shape anywhere.
    places = np.where((masses > _NO_MASS)[:, None], data.xipos[members], data.xpos[members])
    mass = float(masses.sum())
    centre = masses @ places / mass if mass > 0 else places[0]
    axes, arms = data.ximat[members].reshape(-1, 3, 3), places - centre
    inertia = np.einsum("bij,bj,bkj->ik", axes, model.body_inertia[members], axes)
    inertia += np.sum(masses * np.sum(arms**2, 1)) * np.eye(3) - (masses * arms.T) @ arms  # parallel axes
    parts = [shape for b in members for shape in _read_shapes(model, data, b)]
    surface = trimesh.util.concatenate(parts) if parts else None
    name = (model.body(body).name if body else "palm") or f"link_{body}"
    return {"name": name, "mass": mass, "centre": centre, "inertia": inertia, "surface": surface}


def _read_shapes(model: mujoco.MjModel, data: mujoco.MjData, body: int) -> list[Any]:
    """The shapes of a body: its meshes, or else its primitives."""
    geoms = np.flatnonzero(model.geom_bodyid == body)
    meshes = geoms[model.geom_type[geoms] == mujoco.mjtGeom.mjGEOM_MESH]
    shapes = []
    for g in meshes if len(meshes) else geoms:
        if len(meshes):
            mesh = model.mesh(model.geom_dataid[g])
            vertices = model.mesh_vert[mesh.vertadr[0] :][: mesh.vertnum[0]]
            faces = model.mesh_face[mesh.faceadr[0] :][: mesh.facenum[0]]
            shape = trimesh.Trimesh(vertices, faces, process=False)
        elif kind := SHAPES.get(int(model.geom_type[g])):
            shape = primitive_mesh(kind, model.geom_size[g])
        else:
            continue
        shape.vertices = shape.vertices @ data.geom_xmat[g].reshape(3, 3).T + data.geom_xpos[g]
        shapes.append(shape)
    return shapes
