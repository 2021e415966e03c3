"""A maker's description of a hand, URDF or MJCF, as plain arrays: the palm and the links that move on it.

Everything is in one frame, the palm body's, with every hinge at 0. So a link has no frame of its own, and a joint is
an axis and a point on it. Units: m, rad, kg, Nm.
"""

import dataclasses
import xml.etree.ElementTree as ElementTree
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from dexsim.core.errors import AssetError
from dexsim.hand.description import SHAPES, primitive_mesh
from dexsim.hand.load import is_below, read_coupling

_LEAST_MASS = 1e-3  # kg, of a link that the file gives none
_NO_MASS = 2e-6  # kg; a URDF's links without a mass are read with half of it
_NO_INERTIA = 1e-13  # kg m^2, below which MuJoCo takes it for none
_LEAST_INERTIA = 1e-7  # kg m^2


@dataclasses.dataclass(frozen=True, eq=False, kw_only=True)
class Joint:
    """A hinge. `leader` names the joint that it follows: angle = offset + ratio * the leader's."""

    name: str
    axis: np.ndarray  # [3] unit
    anchor: np.ndarray  # [3] m
    low: float
    high: float
    torque: float = 0.0  # Nm, stall torque; 0: not known
    speed: float = 0.0  # rad/s, no-load speed; 0: not known
    leader: str = ""
    ratio: float = 1.0
    offset: float = 0.0


@dataclasses.dataclass(frozen=True, eq=False, kw_only=True)
class Link:
    """Bodies that move as one. The first link of a hand is its palm, which alone has no joint; parents come first."""

    name: str
    parent: int  # -1 for the palm
    joint: Joint | None
    mass: float
    centre: np.ndarray  # [3] m, of mass
    inertia: np.ndarray  # [3, 3] kg m^2 about the centre
    surface: Any = None  # trimesh.Trimesh; None where the file has no shape that can be read


@dataclasses.dataclass(frozen=True, eq=False, kw_only=True)
class Description:
    """What a maker's file says of a hand."""

    name: str
    kind: str  # MJCF or URDF
    links: tuple[Link, ...]
    frozen: tuple[str, ...]  # joints that were taken for fixed: of a wrist, an arm, a floating base
    notes: tuple[str, ...]  # what could not be read


def read_description(
    path: Path, *, palm: str = "", freeze: Sequence[str] = (), couple: Sequence[str] = (), drop_tendons: bool = False
) -> Description:
    """Read a hand from a URDF or MJCF.

    Args:
      palm: its body; empty for the one where all fingers begin.
      freeze: joints that are to be fixed at 0.
      couple: FOLLOWER=LEADER:RATIO of joints that a tendon couples.
      drop_tendons: leave tendons out.

    Raises:
      AssetError: not readable, not a hand, or something that a hand's folder cannot hold.
    """
    if not path.is_file():
        raise AssetError(f"{path}: no such file")
    try:
        root = ElementTree.fromstring(path.read_bytes())
    except ElementTree.ParseError as error:
        raise AssetError(f"{path}: invalid XML: {error}") from None
    if root.tag not in ("robot", "mujoco"):
        raise AssetError(f"{path}: expected <robot> (URDF) or <mujoco> (MJCF), got <{root.tag}>; expand a xacro first")
    notes: list[str] = []
    try:
        if root.tag == "robot":
            spec, speeds = _read_urdf(path, root, notes), _urdf_speeds(root)
        else:
            spec, speeds = _read_mjcf(path, notes), {}
        tendons = [tendon.name for tendon in spec.tendons]
        if tendons and not drop_tendons:
            raise AssetError(
                f"{path}: tendons {', '.join(tendons)[:60]}: not supported; --drop-tendons gives each of their joints "
                "a motor, and --couple FOLLOWER=LEADER:RATIO makes a joint follow another (ratio of their angles)"
            )
        if tendons:
            pulled = [actuator for actuator in spec.actuators if actuator.trntype == mujoco.mjtTrn.mjTRN_TENDON]
            for element in (*spec.keys, *spec.sensors, *pulled, *spec.tendons):
                spec.delete(element)
        model = spec.compile()
    except ValueError as error:
        raise AssetError(f"{path}: {' '.join(str(error).split())}") from None
    reader = _Reader(path, model, notes)
    return reader.read(root.get("name") or root.get("model") or path.stem, root.tag, palm, freeze, couple, speeds)


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
        inertia = None if inertial is None else inertial.find("inertia")
        if inertial is not None and (inertia is None or np.any(np.linalg.eigvalsh(_tensor(inertia)) < _NO_INERTIA)):
            notes.append(f"link {link.get('name')}: its inertia is no inertia, left out")
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
    import trimesh

    shape = element.find("geometry/mesh")
    if shape is None:
        return element.find("geometry/*") is not None
    name = shape.get("filename", "")
    try:
        mesh = trimesh.load(_find_file(path, name), force="mesh", process=False)
    except Exception as error:  # each of trimesh's readers raises its own
        notes.append(f"mesh {name}: {' '.join(str(error).split())[:80]}")
        return False
    if not len(mesh.faces):
        return False
    file = f"{len(assets)}.obj"
    assets[file] = mesh.export(file_type="obj", include_normals=False, include_texture=False).encode()
    shape.set("filename", file)
    return True


def _find_file(path: Path, name: str) -> Path:
    """A mesh that a URDF names: beside it, or below any folder above it that has the rest of the name."""
    rest = Path(name.partition("://")[2] if "://" in name else name)
    places = [path.parent / rest]
    parts = rest.parts[1:] if name.startswith("package://") else rest.parts
    places += [folder.joinpath(*parts) for folder in path.resolve().parents]
    places += [folder / rest for folder in path.resolve().parents]
    return next((place for place in places if place.is_file()), places[0])


def _urdf_speeds(root: ElementTree.Element) -> dict[str, float]:
    """Velocity limits, which MuJoCo does not read."""
    limits = {joint.get("name", ""): joint.find("limit") for joint in root.findall("joint")}
    return {name: float(limit.get("velocity", 0)) for name, limit in limits.items() if limit is not None}


def _tensor(inertia: ElementTree.Element) -> np.ndarray:
    """The tensor [3, 3] of a URDF's <inertia>."""
    names = (("ixx", "ixy", "ixz"), ("ixy", "iyy", "iyz"), ("ixz", "iyz", "izz"))
    return np.array([[float(inertia.get(name, 0)) for name in row] for row in names])


def _read_mjcf(path: Path, notes: list[str]) -> mujoco.MjSpec:
    """The file without the shapes whose meshes are missing."""
    if path.suffix != ".xml":
        raise AssetError(f"{path}: MuJoCo opens an MJCF only as .xml: rename it")
    spec = mujoco.MjSpec.from_file(str(path))
    folder = path.parent / (spec.meshdir or "")
    missing = {mesh.name for mesh in spec.meshes if mesh.file and not (folder / mesh.file).is_file()}
    for geom in [geom for geom in spec.geoms if geom.meshname in missing]:
        spec.delete(geom)
    for mesh in [mesh for mesh in spec.meshes if mesh.name in missing]:
        notes.append(f"mesh {mesh.file}: no such file")
        spec.delete(mesh)
    return spec


class _Reader:
    """A compiled model on its way to a `Description`."""

    def __init__(self, path: Path, model: mujoco.MjModel, notes: list[str]):
        self.path, self.model, self.notes = path, model, notes
        self.data = mujoco.MjData(model)
        hinge = model.jnt_type == mujoco.mjtJoint.mjJNT_HINGE
        self.data.qpos[model.jnt_qposadr[hinge]] = 0.0
        mujoco.mj_kinematics(model, self.data)

    def read(
        self, name: str, tag: str, palm: str, freeze: Sequence[str], couple: Sequence[str], speeds: dict[str, float]
    ) -> Description:
        model = self.model
        names = [model.joint(j).name or f"joint_{j}" for j in range(model.njnt)]
        if unknown := set(freeze) - set(names):
            raise AssetError(f"{self.path}: --freeze {sorted(unknown)[0]}: no such joint; it has {', '.join(names)}")
        at = self._find_palm(palm, {j for j, joint in enumerate(names) if joint in freeze})
        below = [b for b in range(model.nbody) if b != at and is_below(model.body_parentid, b, at)]
        joints = [j for j in range(model.njnt) if model.jnt_bodyid[j] in below and names[j] not in freeze]
        for j in joints:
            if model.jnt_type[j] != mujoco.mjtJoint.mjJNT_HINGE:
                raise AssetError(f"{self.path}: joint {names[j]!r} is not a hinge: --freeze {names[j]} fixes it at 0")
        followers = self._followers(names, joints, couple)
        torques = self._torques()
        axes, anchors = self.data.xaxis.copy(), self.data.xanchor.copy()
        turn, origin = self.data.xmat[at].reshape(3, 3), self.data.xpos[at]
        moving = {int(model.jnt_bodyid[j]) for j in joints}
        links, row = [self._link(at, -1, None, at, moving)], {at: 0}
        for body in (b for b in below if b in moving):
            above = int(model.body_parentid[body])
            while above not in row:
                above = int(model.body_parentid[above])
            own = [j for j in joints if model.jnt_bodyid[j] == body]
            for j in own:
                low, high = model.jnt_range[j] if model.jnt_limited[j] else (-np.pi, np.pi)
                leader, ratio, offset = followers.get(j, (-1, 1.0, 0.0))
                joint = Joint(
                    name=names[j],
                    axis=turn.T @ axes[j],
                    anchor=turn.T @ (anchors[j] - origin),
                    low=float(low),
                    high=float(high),
                    torque=torques.get(j, 0.0),
                    speed=speeds.get(names[j], 0.0),
                    leader=names[leader] if leader >= 0 else "",
                    ratio=ratio,
                    offset=offset,
                )
                parent = len(links) - 1 if j != own[0] else row[above]
                links.append(self._link(body if j == own[-1] else -1, parent, joint, at, moving))
            row[body] = len(links) - 1
        kept = {link.joint.name for link in links if link.joint}
        frozen = tuple(joint for joint in names if joint not in kept)
        kind = {"robot": "URDF", "mujoco": "MJCF"}[tag]
        return Description(name=name, kind=kind, links=tuple(links), frozen=frozen, notes=tuple(self.notes))

    def _find_palm(self, palm: str, frozen: set[int]) -> int:
        """The body from which all chains of hinges branch off."""
        model = self.model
        if palm:
            at = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, palm)
            if at < 0:
                bodies = ", ".join(model.body(b).name for b in range(1, model.nbody))
                raise AssetError(f"{self.path}: --palm {palm}: no such body; it has {bodies[:300]}")
            return at
        moving = {int(model.jnt_bodyid[j]) for j in range(model.njnt) if j not in frozen}
        paths = []
        for body in moving:
            if not any(other != body and is_below(model.body_parentid, other, body) for other in moving):
                path = [body]
                while path[-1]:
                    path.append(int(model.body_parentid[path[-1]]))
                paths.append(path[::-1])
        if len(paths) < 2:
            raise AssetError(f"{self.path}: expected a hand of two fingers or more, got {len(paths)} chains of hinges")
        depth = 0
        while all(len(path) > depth + 1 and path[depth + 1] == paths[0][depth + 1] for path in paths):
            depth += 1
        return paths[0][depth]

    def _link(self, body: int, parent: int, joint: Joint | None, palm: int, moving: set[int]) -> Link:
        """A link of a body and what is fixed to it. -1: the first of two hinges of one body, a link of its own."""
        import trimesh

        if body < 0:
            assert joint is not None
            small = _LEAST_INERTIA * np.eye(3)
            return Link(
                name=f"{joint.name}_link", parent=parent, joint=joint, mass=_LEAST_MASS, centre=joint.anchor,
                inertia=small,
            )  # fmt: skip
        model, data = self.model, self.data
        members = [body]
        for other in range(body + 1, model.nbody):
            if int(model.body_parentid[other]) in members and other not in moving:
                members.append(other)
        turn, origin = data.xmat[palm].reshape(3, 3), data.xpos[palm]
        masses = model.body_mass[members]
        # MuJoCo puts the centre of a body without mass and shape anywhere.
        places = np.where((masses > _NO_MASS)[:, None], data.xipos[members], data.xpos[members])
        places = (places - origin) @ turn
        mass = float(masses.sum())
        centre = masses @ places / mass if mass > 0 else places[0]
        axes, arms = turn.T @ data.ximat[members].reshape(-1, 3, 3), places - centre
        inertia = np.einsum("bij,bj,bkj->ik", axes, model.body_inertia[members], axes)
        inertia += np.sum(masses * np.sum(arms**2, 1)) * np.eye(3) - (masses * arms.T) @ arms  # parallel axes
        parts = [shape for b in members for shape in self._shapes_of(b)]
        surface = trimesh.util.concatenate(parts) if parts else None
        if surface is not None:
            surface.apply_translation(-origin)
            surface.apply_transform(np.block([[turn.T, np.zeros((3, 1))], [np.zeros((1, 3)), np.ones((1, 1))]]))
        name = model.body(body).name if body else "palm"
        name = name or f"link_{body}"
        return Link(
            name=name, parent=parent, joint=joint, mass=mass, centre=centre, inertia=inertia, surface=surface
        )  # fmt: skip

    def _shapes_of(self, body: int) -> list[Any]:
        """The shapes of a body in the world: its meshes, or else its primitives."""
        model = self.model
        geoms = [g for g in range(model.ngeom) if model.geom_bodyid[g] == body]
        meshes = [g for g in geoms if model.geom_type[g] == mujoco.mjtGeom.mjGEOM_MESH]
        return [self._geom(g) for g in meshes or geoms if model.geom_type[g] in SHAPES or g in meshes]

    def _geom(self, g: int) -> Any:
        import trimesh

        model = self.model
        if kind := SHAPES.get(model.geom_type[g]):
            shape = primitive_mesh(kind, model.geom_size[g])
        else:
            mesh = model.geom_dataid[g]
            vertices = model.mesh_vert[model.mesh_vertadr[mesh] :][: model.mesh_vertnum[mesh]]
            faces = model.mesh_face[model.mesh_faceadr[mesh] :][: model.mesh_facenum[mesh]]
            shape = trimesh.Trimesh(vertices, faces, process=False)
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = self.data.geom_xmat[g].reshape(3, 3), self.data.geom_xpos[g]
        return shape.apply_transform(pose)

    def _torques(self) -> dict[int, float]:
        """Stall torque of each joint: its own limit, or that of the actuator on it."""
        model = self.model
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

    def _followers(
        self, names: list[str], joints: list[int], couple: Sequence[str]
    ) -> dict[int, tuple[int, float, float]]:
        """Joints that follow a motor's: which, by what ratio, from what offset [rad]."""
        model = self.model
        direct: dict[int, tuple[int, float, float]] = {}
        for e in range(model.neq):
            coupling = read_coupling(self.path, model, e)
            if coupling is None:
                self.notes.append(f"equality {model.equality(e).name or f'#{e}'}: left out, it couples no two joints")
            else:
                direct[coupling[0]] = coupling[1:]
        for text in couple:
            follower, _, rest = text.partition("=")
            leader, _, number = rest.partition(":")
            try:
                direct[names.index(follower)] = names.index(leader), float(number or 1), 0.0
            except ValueError:
                raise AssetError(
                    f"{self.path}: --couple {text}: expected FOLLOWER=LEADER:RATIO, joints of {', '.join(names)}"
                ) from None
        followers = {}
        for first, (motor, ratio, offset) in direct.items():
            for _ in range(len(direct)):  # a follower of a follower
                if motor in direct:
                    above, factor, shift = direct[motor]
                    motor, ratio, offset = above, ratio * factor, offset + ratio * shift
            if motor in joints and motor != first:
                followers[first] = motor, ratio, offset
        return followers
