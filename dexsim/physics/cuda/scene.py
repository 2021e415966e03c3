"""What the kernel of the `cuda` engine is generated from, and what crosses into it: a scene's constants as C++, and one
list of buffers, printed as the C++ struct `Args` and packed as its bytes.

There is one link for each hinge, in the order of the degrees of freedom. A body without a joint belongs to the link of
its parent. A link's frame has its origin on the hinge and its third axis along it, so that a joint's rotation is one
about z. Link -1 is fixed in the world (the palm), link `hinges` the object, whose frame is its body's.

Contacts are found by kinds (kernel/contacts/). Only kinds that a scene has are compiled: the numbers of the others are
zero.
"""

import ctypes
import dataclasses
import functools
from collections.abc import Callable, Sequence
from typing import Any

import mujoco
import numpy as np
from numpy.typing import ArrayLike

from dexsim.errors import AssetError
from dexsim.hand.load import rotation_matrix
from dexsim.physics.interface import PhysicsScene

LANES = 32
MAX_CONTACTS = 32
"""Contacts of a world: one for each lane."""
_FAST = 4  # hinges of a finger that the kernel eliminates by itself
_PRIMITIVES = ("sphere", "capsule", "ellipsoid", "cylinder", "box")
# What the hand's geoms can touch, and in how many places planes do.
_ROUND = ("sphere", "capsule")
_PLANE_POINTS = {"sphere": 1, "capsule": 2, "ellipsoid": 1, "cylinder": 4, "box": 8}
_ON_OBJECT = {"sphere": _PRIMITIVES, "capsule": _PRIMITIVES, "plane": _PRIMITIVES, "box": ("box",)}
_EXTRA = 48  # contacts beyond a lane each, from which the deepest are chosen


@dataclasses.dataclass(frozen=True)
class Buffer:
    """An array on the device, [worlds, size] in one piece."""

    name: str  # in `Args`
    size: int  # values of a world
    output: bool = False
    ctype: str = "float"  # or int, bool


@dataclasses.dataclass(frozen=True)
class Settings:
    """What is the same for all worlds, in the order of `Args`."""

    substeps: int
    iterations: int  # Newton's, at most
    line_search: int  # evaluations in each of them, at most
    tolerance: float  # of the Newton decrement, where iterations stop
    line_search_tolerance: float  # share of the decrement, where the line search stops


_NUMBERS = [
    ("n", int),
    *((field.name, float if field.type is float else int) for field in dataclasses.fields(Settings)),
]


def declare_args(buffers: Sequence[Buffer]) -> str:
    """`struct Args` in C++: pointers in the order of `buffers`, the number of worlds, `Settings`."""
    pointers = "".join(f"  {'' if buffer.output else 'const '}{buffer.ctype} *{buffer.name};\n" for buffer in buffers)
    numbers = "".join(f"  {kind.__name__} {name};\n" for name, kind in _NUMBERS)
    return f"struct Args {{\n{pointers}{numbers}}};\nstruct Motor {{ float torque, inertia; }};\n"


def args_type(count: int) -> type[ctypes.Structure]:
    """The same struct in ctypes, with one array `pointers` in place of `count` names."""
    numbers = [(name, ctypes.c_float if kind is float else ctypes.c_int) for name, kind in _NUMBERS]
    return type("Args", (ctypes.Structure,), {"_fields_": [("pointers", ctypes.c_void_p * count), *numbers]})


def buffers(scene: PhysicsScene, law: Sequence[Buffer]) -> list[Buffer]:
    """Arguments of the kernel in order, arrays [N, size]: inputs, the motor law's constants, outputs."""
    model, slots, pairs = scene.model, len(scene.slots), len(scene.object_pairs)
    return [
        Buffer("qpos", model.nq),
        Buffer("qvel", model.nv),
        Buffer("warmstart", model.nv),
        Buffer("push", 3),
        Buffer("body_mass", 1),
        Buffer("body_inertia", 3),
        Buffer("body_ipos", 3),
        Buffer("geom_size", 3 * (slots + len(scene.tip_geoms))),
        Buffer("geom_pos", 3 * slots),
        Buffer("geom_quat", 4 * slots),
        Buffer("pair_friction", pairs),
        Buffer("pair_solref", 2 * pairs),
        Buffer("pair_solimp", 5 * pairs),
        *law,
        Buffer("qpos_out", model.nq, output=True),
        Buffer("qvel_out", model.nv, output=True),
        Buffer("warmstart_out", model.nv, output=True),
        Buffer("finger_force", 3 * scene.hand.num_fingers, output=True),
        Buffer("stats", 4, output=True),
    ]


def check_scene(scene: PhysicsScene) -> None:
    """Raise AssetError with everything that the kernel lacks in a scene of `build_scene`, of a hand of `load_hand`."""
    model = scene.model
    friction = model.pair_friction
    lacking = {
        f"{model.nv - 6} hinges (at most {LANES - 6})": model.nv > LANES,
        "mocap bodies": model.nmocap,
        "dry friction of joints": model.dof_frictionloss.any(),
        "gravity compensation": model.body_gravcomp.any(),
        f"more than {LANES} coupled joints": model.neq > LANES,
        "contacts of another dimension than 3": (model.pair_dim != 3).any(),
        "margins or gaps of contacts": model.pair_margin.any() or model.pair_gap.any(),
        "solreffriction": model.pair_solreffriction.any(),
        "friction that depends on the direction": (friction[:, 0] != friction[:, 1]).any(),
        f"more than {LANES // 3} fingers": scene.hand.num_fingers > LANES // 3,
    }
    if names := [what for what, there in lacking.items() if there]:
        raise AssetError(f"{scene.hand.model_path}: backend cuda cannot simulate: {'; '.join(names)}; backend mjx may")


@dataclasses.dataclass(frozen=True, eq=False)
class Links:
    """Where the bodies of a model are in the kernel's links."""

    link: np.ndarray  # [B] of a body; -1 fixed in the world
    rotation: np.ndarray  # [B, 3, 3] of the body's frame in its link's
    place: np.ndarray  # [B, 3] m
    parent: np.ndarray  # [H] link that carries the hinge of a link; -1 the world
    offset_rotation: np.ndarray  # [H, 3, 3] of a link's frame in its parent's, at joint angle 0
    offset_place: np.ndarray  # [H, 3] m

    @property
    def hinges(self) -> int:
        """Hinges of the hand, which is also the link of the object."""
        return len(self.parent)

    @functools.cached_property
    def chains(self) -> list[list[int]]:
        """The hinges that carry each link, from the palm on."""
        chains: list[list[int]] = []
        for link, parent in enumerate(self.parent):
            chains.append([*(chains[parent] if parent >= 0 else []), link])
        return chains

    def gathering(self) -> list[list[int]]:
        """Steps [H] in which each link adds up what its children have added up: from whom, -1 from none."""
        children: list[list[int]] = [[] for _ in self.parent]
        for link, parent in enumerate(self.parent):
            if parent >= 0:
                children[parent].append(link)
        steps: list[list[int]] = []
        done = np.zeros(self.hinges, int)  # the step after which a link is complete
        for link in reversed(range(self.hinges)):
            for child in sorted(children[link], key=lambda child: done[child]):
                step = max(done[link], done[child])
                while len(steps) <= step:
                    steps.append([-1] * self.hinges)
                steps[step][link] = child
                done[link] = step + 1
        return steps


def find_links(scene: PhysicsScene) -> Links:
    """The links of a scene that `check_scene` has passed."""
    model = scene.model
    hinges = model.nv - 6
    link = np.full(model.nbody, -1)
    rotation, place = np.tile(np.eye(3), (model.nbody, 1, 1)), np.zeros((model.nbody, 3))
    parent, offset_rotation, offset_place = np.full(hinges, -1), np.zeros((hinges, 3, 3)), np.zeros((hinges, 3))
    for body in range(1, model.nbody):
        above = model.body_parentid[body]
        turn = rotation[above] @ rotation_matrix(model.body_quat[body])
        origin = place[above] + rotation[above] @ model.body_pos[body]
        link[body], rotation[body], place[body] = link[above], turn, origin
        if body == scene.object_body:
            link[body], rotation[body], place[body] = hinges, np.eye(3), 0.0
        elif model.body_jntnum[body]:
            joint = model.body_jntadr[body]
            hinge = model.jnt_dofadr[joint]
            axes, anchor = _axes_along(model.jnt_axis[joint]), model.jnt_pos[joint]
            zero = -model.qpos0[model.jnt_qposadr[joint]]
            parent[hinge] = link[above]
            offset_place[hinge] = origin + turn @ anchor
            offset_rotation[hinge] = turn @ axes @ rotation_matrix([np.cos(zero / 2), 0, 0, np.sin(zero / 2)])
            link[body], rotation[body], place[body] = hinge, axes.T, -axes.T @ anchor
    return Links(link, rotation, place, parent, offset_rotation, offset_place)


def _axes_along(axis: np.ndarray) -> np.ndarray:
    """A rotation whose third column is `axis`."""
    other = np.eye(3)[np.argmin(np.abs(axis))]
    first = np.cross(other, axis)
    first /= np.linalg.norm(first)
    return np.stack([first, np.cross(axis, first), axis], -1)


def kernel_constants(scene: PhysicsScene) -> str:
    """The constants of a scene as C++. Raises AssetError: the kernel cannot run the scene."""
    check_scene(scene)
    links = find_links(scene)
    return "\n".join(
        [
            '#include "tables.cuh"',
            *_sizes(scene, links),
            *_bodies(scene, links),
            *_joints(scene),
            *_couplings(scene.model),
            *_pairs(scene, links),
            *_contacts(scene, links),
            "",
        ]
    )


def _number(value: float) -> str:
    """A C++ literal of a float32."""
    return f"{np.float32(value):.9e}f"


def _array(name: str, values: ArrayLike, kind: str = "float") -> str:
    """A C++ table [...] of device memory."""
    array = np.asarray(values)
    sizes = "".join(f"[{n}]" for n in array.shape)
    return f"__device__ const {kind} {name}{sizes} = {_list(array, _number if kind == 'float' else str)};"


def _list(values: ArrayLike, literal: Callable[[Any], str] = _number) -> str:
    """The braces of an array [...] of float32, or of what else `literal` prints."""
    if np.ndim(values):
        return "{" + ", ".join(_list(row, literal) for row in np.asarray(values)) + "}"
    return literal(np.asarray(values).item())


def _sizes(scene: PhysicsScene, links: Links) -> list[str]:
    """Numbers of the scene and its tree of links."""
    option, chains, steps, blocks = scene.model.opt, links.chains, links.gathering(), _blocks(scene, links)
    first = last = np.zeros(links.hinges, int)
    if blocks is not None:
        first, last = np.searchsorted(blocks, blocks), np.searchsorted(blocks, blocks, side="right") - 1
    sizes = {
        "HINGES": links.hinges,
        "CHAIN": max(map(len, chains)),
        # Hinges of a finger if every finger is one chain of few; 0: the hand is eliminated as a whole.
        "BLOCK": 0 if blocks is None else int(np.bincount(blocks).max()),
        "PRIMITIVES": len(scene.slots),
        "TIP_GEOMS": len(scene.tip_geoms),
        "OBJECT_PAIRS": len(scene.object_pairs),
        "FINGERS": scene.hand.num_fingers,
        "MAX_CONTACTS": MAX_CONTACTS,
    }
    numbers = {"TIMESTEP": option.timestep, "IMPRATIO": option.impratio}
    numbers |= {f"GRAVITY_{axis}": value for axis, value in zip("XYZ", option.gravity, strict=True)}
    return [
        *(f"constexpr int {name} = {value};" for name, value in sizes.items()),
        *(f"constexpr float {name} = {_number(value)};" for name, value in numbers.items()),
        _array("PARENT", _lanes(links.parent, -1), "int"),
        _array("DEPTH", _lanes([len(chain) - 1 for chain in chains]), "int"),
        _array("BLOCK_FIRST", _lanes(first), "int"),
        _array("BLOCK_LAST", _lanes(last), "int"),
        f"constexpr int GATHER_STEPS = {len(steps)};",
        _array("GATHER_FROM", np.array([_lanes(step, -1) for step in steps] or [_lanes([], -1)]), "int"),
        _array("CHAIN_MASK", [*(sum(1 << h for h in chain) for chain in chains), 0], "int"),
        _array("CHAIN_HINGE", [chain + [-1] * (sizes["CHAIN"] - len(chain)) for chain in chains], "int"),
    ]


def _bodies(scene: PhysicsScene, links: Links) -> list[str]:
    """Offsets, masses, centres of mass and inertias of the links, in their frames."""
    model, hinges = scene.model, links.hinges
    mass, moment, about = np.zeros(hinges), np.zeros((hinges, 3)), np.zeros((hinges, 3, 3))
    parts = [(body, link) for body, link in enumerate(links.link) if 0 <= link < hinges]
    for body, link in parts:
        centre = links.place[body] + links.rotation[body] @ model.body_ipos[body]
        turn = links.rotation[body] @ rotation_matrix(model.body_iquat[body])
        mass[link] += model.body_mass[body]
        moment[link] += model.body_mass[body] * centre
        about[link] += turn @ np.diag(model.body_inertia[body]) @ turn.T + model.body_mass[body] * _spread(centre)
    centre = moment / mass[:, None]
    inertia = about - mass[:, None, None] * np.array([_spread(c) for c in centre])
    rows, columns = np.triu_indices(3)
    return [
        _array("OFFSET_ROTATION", _lanes(links.offset_rotation.reshape(-1, 9)).T),
        _array("OFFSET_PLACE", _lanes(links.offset_place).T),
        _array("LINK_MASS", _lanes(mass)),
        _array("LINK_CENTRE", _lanes(centre).T),
        _array("LINK_INERTIA", _lanes(inertia[:, rows, columns]).T),
    ]


def _joints(scene: PhysicsScene) -> list[str]:
    model = scene.model
    joint = model.dof_jntid[: model.nv - 6]
    address = model.jnt_qposadr[joint]
    limited, margin = model.jnt_limited[joint] > 0, model.jnt_margin[joint]
    low, high = (np.where(limited, model.jnt_range[joint, k], far) for k, far in ((0, -1e6), (1, 1e6)))
    drive = np.full(len(joint), -1)
    drive[scene.joint_dof] = np.arange(len(scene.joint_dof))
    return [
        _array("DRIVE", _lanes(drive, -1), "int"),
        _array("ARMATURE", _lanes(model.dof_armature[: len(joint)])),
        _array("DAMPING", _lanes(model.dof_damping[: len(joint)])),
        _array("STIFFNESS", _lanes(model.jnt_stiffness[joint])),
        _array("SPRING_ANGLE", _lanes(model.qpos_spring[address])),
        _array("LIMIT_LOW", _lanes(low + margin)),
        _array("LIMIT_HIGH", _lanes(high - margin)),
        _array("LIMIT_COMPLIANCE", _lanes(model.dof_invweight0[: len(joint)])),
        _array("LIMIT_SPRING", _lanes(np.hstack([model.jnt_solref[joint], model.jnt_solimp[joint]])).T),
    ]


def _couplings(model: mujoco.MjModel) -> list[str]:
    """Joints that follow others."""
    first, second = (np.where(joint >= 0, model.jnt_dofadr[joint], -1) for joint in (model.eq_obj1id, model.eq_obj2id))
    zero = [np.where(dof >= 0, model.qpos0[dof], 0.0) for dof in (first, second)]
    compliance = model.dof_invweight0[first] + np.where(second >= 0, model.dof_invweight0[second], 0.0)
    springs = np.hstack([model.eq_solref, model.eq_solimp])
    rows = [
        f"{first[k]}, {second[k]}, {_list([zero[0][k], zero[1][k]])}, {_list(model.eq_data[k, :5])}, "
        f"{_list(springs[k])}, {_number(compliance[k])}"
        for k in range(model.neq)
    ]
    return [
        f"constexpr int COUPLINGS = {model.neq};",
        *_table("Coupling", "COUPLING", rows),
    ]


def _pairs(scene: PhysicsScene, links: Links) -> list[str]:
    """What contacts of each pair move, and the springs of pairs within the hand, which are the same in every world."""
    model = scene.model
    bodies = model.geom_bodyid[np.stack([model.pair_geom1, model.pair_geom2])]
    compliance = model.body_invweight0[bodies, 0].sum(0)
    fingers = {int(body): finger for finger, body in enumerate(scene.tip_bodies)}
    rows = {int(pair): row for row, pair in enumerate(scene.object_pairs)}
    lines: list[str] = []
    springs: list[list[float]] = []
    for pair, (one, two) in enumerate(bodies.T):
        first, second, side = int(links.link[one]), int(links.link[two]), 1.0
        if first == links.hinges:
            first, second, side = second, first, -1.0
        finger = fingers.get(int(two if side < 0 else one), -1) if second == links.hinges else -1
        row = rows.get(pair, -1 - len(springs))
        if row < 0:
            springs.append([model.pair_friction[pair, 0], *model.pair_solref[pair], *model.pair_solimp[pair]])
        lines.append(f"{first}, {second}, {row}, {finger}, {_number(side)}, {_number(compliance[pair])}")
    return [*_table("Pair", "PAIR", lines), _array("HAND_SPRING", np.array(springs or np.zeros((1, 8))))]


def _blocks(scene: PhysicsScene, links: Links) -> np.ndarray | None:
    """The finger [H] of each hinge if each is one chain of few; None where the hand has to be taken as a whole."""
    chains = links.chains
    finger = np.array([chain[0] for chain in chains])
    model = scene.model
    coupled = [(first, second) for first, second in zip(model.eq_obj1id, model.eq_obj2id, strict=True) if second >= 0]
    across = any(finger[model.jnt_dofadr[a]] != finger[model.jnt_dofadr[b]] for a, b in coupled)
    branched = any(chain != list(range(chain[0], link + 1)) for link, chain in enumerate(chains))
    if across or branched or max(map(len, chains)) > _FAST:
        return None
    return finger


def _lanes(values: ArrayLike, fill: float = 0.0) -> np.ndarray:
    """Values [H, ...] for all lanes [32, ...]."""
    array = np.asarray(values)
    return np.concatenate([array, np.full((LANES - len(array), *array.shape[1:]), fill, array.dtype)])


def _spread(centre: np.ndarray) -> np.ndarray:
    """Inertia [3, 3] of a unit mass at `centre`."""
    return np.dot(centre, centre) * np.eye(3) - np.outer(centre, centre)


def _kind(scene: PhysicsScene, geom: int) -> str:
    return mujoco.mjtGeom(scene.model.geom_type[geom]).name.removeprefix("mjGEOM_").lower()


def _sort_pairs(
    scene: PhysicsScene,
) -> tuple[dict[str, list[int]], list[int], np.ndarray, list[tuple[int, int, int]]]:
    """The pairs of a scene, of the hand and the object and within the hand.

    Returns:
      The hand's geoms that may touch the object, by kind; spheres and capsules that only touch the hand; the pair
      [K, G] of a primitive and each of the former in order; pairs of round geoms: geom, geom or -1 - primitive, pair.
    """
    model = scene.model
    primitive = {int(geom): k for k, geom in enumerate(scene.object_geoms)}
    geoms: dict[str, list[int]] = {kind: [] for kind in ("sphere", "capsule", "box", "plane")}
    pairs: dict[tuple[int, int], int] = {}  # of a primitive and a geom
    hand: list[tuple[int, int, int]] = []
    lacking = []
    for pair, (first, second) in enumerate(zip(model.pair_geom1.tolist(), model.pair_geom2.tolist(), strict=True)):
        kind, other = _kind(scene, first), _kind(scene, second)
        with_object = second in primitive
        if other not in _ON_OBJECT.get(kind, ()) if with_object else not {kind, other} <= set(_ROUND):
            lacking.append(f"{kind} {model.geom(first).name!r} on {other} {model.geom(second).name!r}")
        elif with_object:
            pairs[primitive[second], first] = pair
            if first not in geoms[kind]:
                geoms[kind].append(first)
        else:
            hand.append((first, second, pair))
    if lacking:
        raise AssetError(
            f"{scene.hand.model_path}: backend cuda has no contacts of {', '.join(lacking)}; backend mjx may"
        )
    order = [geom for kind in geoms.values() for geom in kind]
    object_pair = np.array([[pairs.get((k, geom), -1) for geom in order] for k in range(len(scene.slots))])
    capsules = [
        (geom, -1 - k, pair)
        for (k, geom), pair in pairs.items()
        if scene.slots[k] == "capsule" and geom in geoms["capsule"]
    ]
    others = sorted({geom for *both, _ in hand for geom in both} - set(geoms["sphere"]) - set(geoms["capsule"]))
    return geoms, others, object_pair, capsules + hand


def _contacts(scene: PhysicsScene, links: Links) -> list[str]:
    """What contacts are found between: geoms, pairs and their numbers."""
    model = scene.model
    geoms, others, object_pair, round_pairs = _sort_pairs(scene)
    round_geoms = [*geoms["sphere"], *geoms["capsule"], *others]
    counts = {kind: len(rows) for kind, rows in geoms.items()}
    sizes = {
        "SPHERES": counts["sphere"],
        "CAPSULES": counts["capsule"],
        "BOXES": counts["box"],
        "FIRST_BOX_GEOM": counts["sphere"] + counts["capsule"],
        "FIRST_PLANE_GEOM": counts["sphere"] + counts["capsule"] + counts["box"],
        "ROUND_PAIRS": len(round_pairs),
        "PLANE_POINTS": counts["plane"] * sum(_PLANE_POINTS[kind] for kind in scene.slots),
    }
    for kind in _PRIMITIVES:
        sizes[f"{kind.upper()}_PRIMITIVES"] = scene.slots.count(kind)
        sizes[f"FIRST_{kind.upper()}"] = scene.slots.index(kind) if kind in scene.slots else 0
    # Fingers touch several boxes of a mesh at once: the deepest contacts are chosen.
    sizes["EXTRA_CONTACTS"] = _EXTRA if scene.slots.count("box") > 1 else 0
    sized = {int(geom): len(scene.slots) + k for k, geom in enumerate(scene.tip_geoms)}

    def place(geom: int) -> tuple[str, int, np.ndarray]:
        """Place of a geom in its link's frame in C++, its link, its rotation [3, 3]."""
        body = model.geom_bodyid[geom]
        centre = links.place[body] + links.rotation[body] @ model.geom_pos[geom]
        link = links.link[body] if links.link[body] >= 0 else links.hinges
        return _list(centre), int(link), links.rotation[body] @ rotation_matrix(model.geom_quat[geom])

    round_rows, box_rows, plane_rows = [], [], []
    for geom in round_geoms:
        at, link, turn = place(geom)
        half = model.geom_size[geom, 1] if _kind(scene, geom) == "capsule" else 0.0
        radius = _number(model.geom_size[geom, 0])
        round_rows.append(f"{at}, {link}, {_list(half * turn[:, 2])}, {radius}, {sized.get(geom, -1)}")
    for geom in geoms["box"]:
        at, link, turn = place(geom)
        box_rows.append(f"{at}, {link}, {_list(turn)}, {_list(model.geom_size[geom])}, {sized.get(geom, -1)}")
    for geom in geoms["plane"]:
        at, _, turn = place(geom)
        plane_rows.append(f"{at}, {_list(turn[:, 2])}")
    index = {geom: k for k, geom in enumerate(round_geoms)}
    pair_rows = [f"{index[one]}, {index.get(two, two)}, {pair}" for one, two, pair in round_pairs]
    points = [
        f"{plane}, {k}, {_PRIMITIVES.index(kind)}, {corner}"
        for plane in range(len(plane_rows))
        for k, kind in enumerate(scene.slots)
        for corner in range(_PLANE_POINTS[kind])
    ]
    return [
        *(f"constexpr int {name} = {value};" for name, value in sizes.items()),
        *_table("RoundGeom", "ROUND_GEOM", round_rows),
        *_table("BoxGeom", "BOX_GEOM", box_rows),
        *_table("PlaneGeom", "PLANE_GEOM", plane_rows),
        *_table("RoundPair", "ROUND_PAIR", pair_rows),
        *_table("PlanePoint", "PLANE_POINT", points),
        _array("OBJECT_PAIR", object_pair, "int"),
    ]


def _table(kind: str, name: str, rows: list[str]) -> list[str]:
    """A table of structs, with one row of zeros where there is none."""
    return [
        f"__device__ const {kind} {name}[{max(len(rows), 1)}] = {{",
        *(f"  {{{row}}}," for row in rows or [""]),
        "};",
    ]
