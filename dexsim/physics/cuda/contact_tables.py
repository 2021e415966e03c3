"""Tables of a scene's contacts for the kernel of the `cuda` engine: who may touch whom, by kinds (kernel/contacts/).

Only kinds that a scene has are compiled: the numbers of the others are zero.
"""

import dataclasses

import mujoco
import numpy as np

from dexsim.core.errors import AssetError
from dexsim.physics.cuda.links import find_links
from dexsim.physics.cuda.scene import number, table
from dexsim.physics.interface import PhysicsScene

_KINDS = {
    int(mujoco.mjtGeom.mjGEOM_SPHERE): "sphere",
    int(mujoco.mjtGeom.mjGEOM_CAPSULE): "capsule",
    int(mujoco.mjtGeom.mjGEOM_ELLIPSOID): "ellipsoid",
    int(mujoco.mjtGeom.mjGEOM_CYLINDER): "cylinder",
    int(mujoco.mjtGeom.mjGEOM_BOX): "box",
    int(mujoco.mjtGeom.mjGEOM_PLANE): "plane",
    int(mujoco.mjtGeom.mjGEOM_MESH): "mesh",
}
_PRIMITIVES = ("sphere", "capsule", "ellipsoid", "cylinder", "box")
# What the hand's geoms can touch, and in how many places planes do.
_ROUND = ("sphere", "capsule")
_PLANE_POINTS = {"sphere": 1, "capsule": 2, "ellipsoid": 1, "cylinder": 4, "box": 8}
_ON_OBJECT = {"sphere": _PRIMITIVES, "capsule": _PRIMITIVES, "plane": _PRIMITIVES, "box": ("box",)}

_EXTRA = 48  # contacts beyond a lane each, from which the deepest are chosen


@dataclasses.dataclass(frozen=True, eq=False)
class _Contacts:
    """The pairs of a scene, of the hand and the object and within the hand."""

    geoms: dict[str, list[int]]  # of the hand that may touch the object, by kind
    others: list[int]  # spheres and capsules that only touch the hand
    object_pair: np.ndarray  # [K, G] pair of a primitive and each of `geoms` in order
    round_pairs: list[tuple[int, int, int]]  # geom, geom or -1 - primitive, pair


def contact_constants(scene: PhysicsScene) -> str:
    """The tables as C++. Slots of one kind follow each other.

    Raises:
      AssetError: a pair is of kinds that have no closed form in the kernel.
    """
    contacts = _find(scene)
    return "\n".join(['#include "contacts/geoms.cuh"', *_sizes(scene, contacts), *_rows(scene, contacts), ""])


def _kind(scene: PhysicsScene, geom: int) -> str:
    return _KINDS.get(int(scene.model.geom_type[geom]), "geom")


def _find(scene: PhysicsScene) -> _Contacts:
    model = scene.model
    primitive = {int(geom): k for k, geom in enumerate(scene.object_geoms)}
    geoms: dict[str, list[int]] = {kind: [] for kind in ("sphere", "capsule", "box", "plane")}
    pairs: dict[tuple[int, int], int] = {}
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
        raise AssetError(f"{scene.hand.model_path}: backend cuda has no contacts of {', '.join(lacking)}")
    order = [geom for kind in geoms.values() for geom in kind]
    object_pair = np.array([[pairs.get((k, geom), -1) for geom in order] for k in range(len(scene.slots))])
    capsules = [(geom, -1 - k, pair) for (k, geom), pair in pairs.items() if _both_capsules(scene, k, geom)]
    others = sorted({geom for *both, _ in hand for geom in both} - set(geoms["sphere"]) - set(geoms["capsule"]))
    return _Contacts(geoms, others, object_pair, capsules + hand)


def _both_capsules(scene: PhysicsScene, primitive: int, geom: int) -> bool:
    return scene.slots[primitive] == "capsule" and _kind(scene, geom) == "capsule"


def _sizes(scene: PhysicsScene, contacts: _Contacts) -> list[str]:
    counts = {kind: len(geoms) for kind, geoms in contacts.geoms.items()}
    sizes = {
        "SPHERES": counts["sphere"],
        "CAPSULES": counts["capsule"],
        "BOXES": counts["box"],
        "FIRST_BOX_GEOM": counts["sphere"] + counts["capsule"],
        "FIRST_PLANE_GEOM": counts["sphere"] + counts["capsule"] + counts["box"],
        "ROUND_PAIRS": len(contacts.round_pairs),
        "PLANE_POINTS": counts["plane"] * sum(_PLANE_POINTS[kind] for kind in scene.slots),
    }
    for kind in _PRIMITIVES:
        sizes[f"{kind.upper()}_PRIMITIVES"] = scene.slots.count(kind)
        sizes[f"FIRST_{kind.upper()}"] = scene.slots.index(kind) if kind in scene.slots else 0
    # Fingers touch several boxes of a mesh at once: the deepest contacts are chosen.
    sizes["EXTRA_CONTACTS"] = _EXTRA if scene.slots.count("box") > 1 else 0
    return [f"constexpr int {name} = {value};" for name, value in sizes.items()]


def _rows(scene: PhysicsScene, contacts: _Contacts) -> list[str]:
    model, links = scene.model, find_links(scene)
    sized = {int(geom): len(scene.slots) + k for k, geom in enumerate(scene.tip_geoms)}

    def place(geom: int) -> tuple[str, int, np.ndarray]:
        """Place of a geom in its link's frame in C++, its link, its rotation [3, 3]."""
        body = model.geom_bodyid[geom]
        turn = np.zeros(9)
        mujoco.mju_quat2Mat(turn, model.geom_quat[geom])
        centre = links.place[body] + links.rotation[body] @ model.geom_pos[geom]
        link = links.link[body] if links.link[body] >= 0 else links.hinges
        return _list(centre), int(link), links.rotation[body] @ turn.reshape(3, 3)

    round_geoms = [*contacts.geoms["sphere"], *contacts.geoms["capsule"], *contacts.others]
    round_rows, box_rows, plane_rows = [], [], []
    for geom in round_geoms:
        at, link, turn = place(geom)
        half = model.geom_size[geom, 1] if _kind(scene, geom) == "capsule" else 0.0
        radius = number(model.geom_size[geom, 0])
        round_rows.append(f"{at}, {link}, {_list(half * turn[:, 2])}, {radius}, {sized.get(geom, -1)}")
    for geom in contacts.geoms["box"]:
        at, link, turn = place(geom)
        axes = ", ".join(_list(row) for row in turn)
        box_rows.append(f"{at}, {link}, {{{axes}}}, {_list(model.geom_size[geom])}, {sized.get(geom, -1)}")
    for geom in contacts.geoms["plane"]:
        at, _, turn = place(geom)
        plane_rows.append(f"{at}, {_list(turn[:, 2])}")
    index = {geom: k for k, geom in enumerate(round_geoms)}
    pairs = [f"{index[one]}, {index.get(two, two)}, {pair}" for one, two, pair in contacts.round_pairs]
    points = [
        f"{plane}, {k}, {_PRIMITIVES.index(kind)}, {corner}"
        for plane in range(len(plane_rows))
        for k, kind in enumerate(scene.slots)
        for corner in range(_PLANE_POINTS[kind])
    ]
    return [
        *_table("RoundGeom", "ROUND_GEOM", round_rows),
        *_table("BoxGeom", "BOX_GEOM", box_rows),
        *_table("PlaneGeom", "PLANE_GEOM", plane_rows),
        *_table("RoundPair", "ROUND_PAIR", pairs),
        *_table("PlanePoint", "PLANE_POINT", points),
        table("OBJECT_PAIR", contacts.object_pair, "int"),
    ]


def _table(kind: str, name: str, rows: list[str]) -> list[str]:
    """A table of structs, with one row of zeros where there is none."""
    return [
        f"__device__ const {kind} {name}[{max(len(rows), 1)}] = {{",
        *(f"  {{{row}}}," for row in rows or [""]),
        "};",
    ]


def _list(values: np.ndarray) -> str:
    return "{" + ", ".join(map(number, values)) + "}"
