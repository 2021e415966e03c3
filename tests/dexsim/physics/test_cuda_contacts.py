"""Contacts of the `cuda` engine, in the emulation of a warp, against C MuJoCo: pairs of every kind near contact."""

import ctypes
import functools

import mujoco
import numpy as np
import pytest
import warp_emulation
from physics_states import scene_of_model
from scipy.spatial.transform import Rotation

from dexsim.hand.load import rotation_matrix
from dexsim.physics.cuda.scene import (
    MAX_CONTACTS,
    Buffer,
    args_type,
    declare_args,
    find_links,
    kernel_constants,
)
from dexsim.physics.interface import PhysicsScene

pytestmark = pytest.mark.skipif(warp_emulation.compiler is None, reason="the emulation of a warp needs g++")

WORLDS = 120
CONTACT = np.dtype([("gap", "f4"), ("point", "f4", 3), ("normal", "f4", 3), ("pair", "i4")], align=True)
# Geoms of a hand, each on a link of its own but for the plane; `tip` and `block` have their sizes from the world.
HAND = {
    "ball": ("sphere", [0.008, 0, 0]),
    "tip": ("sphere", [0.009, 0, 0]),
    "rod": ("capsule", [0.008, 0.02, 0]),
    "pin": ("capsule", [0.009, 0.015, 0]),
    "palm": ("box", [0.02, 0.04, 0.05]),
    "block": ("box", [0.01, 0.015, 0.012]),
    "floor": ("plane", [0, 0, 1]),
}
WITHIN = [("rod", "pin"), ("ball", "rod"), ("ball", "tip")]
KINDS = ("sphere", "capsule", "ellipsoid", "cylinder", "box")
MESH = ("box", "box")
CASES = [
    *((KINDS, hand, kind) for hand in ("ball", "rod", "floor") for kind in KINDS),
    *((KINDS, *pair) for pair in WITHIN),
    *((MESH, hand, "box") for hand in ("tip", "rod", "palm", "block", "floor")),
]


@functools.cache
def scene_of(slots: tuple[str, ...]) -> PhysicsScene:
    """A scene of `HAND` and an object of primitives `slots`."""
    random = np.random.default_rng(len(slots))
    spec = mujoco.MjSpec()
    spec.option.disableflags = mujoco.mjtDisableBit.mjDSBL_EULERDAMP | mujoco.mjtDisableBit.mjDSBL_MULTICCD
    spec.option.cone, spec.option.timestep = mujoco.mjtCone.mjCONE_ELLIPTIC, 0.006
    solid = {"mass": 1, "inertia": [1, 1, 1], "explicitinertial": True}
    for name, (kind, size) in HAND.items():
        body = spec.worldbody
        if kind != "plane":
            body = body.add_body(name=name, **solid)
            body.add_joint(axis=random.normal(size=3), pos=random.normal(size=3) * 0.01)
        place = {"pos": random.normal(size=3) * 0.01, "quat": random.normal(size=4)}
        body.add_geom(name=name, type=geom_type(kind), size=size, contype=0, conaffinity=0, **place)
    body = spec.worldbody.add_body(name="object", **solid)
    body.add_freejoint()
    for k, kind in enumerate(slots):
        body.add_geom(name=f"object_{k}", type=geom_type(kind), size=[0.02] * 3, contype=0, conaffinity=0)
        for name, (own, _) in HAND.items():
            if own != "box" or kind == "box":
                spec.add_pair(geomname1=name, geomname2=f"object_{k}", condim=3)
    for one, two in WITHIN:
        spec.add_pair(geomname1=one, geomname2=two, condim=3)
    model = spec.compile()
    model.geom_rbound[model.geom_type != mujoco.mjtGeom.mjGEOM_PLANE] = 1.0  # their sizes differ between worlds
    sized = np.array([model.geom(name).id for name in ("tip", "block")])
    return scene_of_model(model, slots, np.arange(model.nv - 6), np.array([model.body("tip").id]), sized)


def geom_type(kind: str) -> int:
    return getattr(mujoco.mjtGeom, f"mjGEOM_{kind.upper()}")


@functools.cache
def in_links(slots: tuple[str, ...]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The link [G] of each geom, its rotation [G, 3, 3] and place [G, 3] there: the palm's after those of the hinges,
    the object's last."""
    model, links = scene_of(slots).model, find_links(scene_of(slots))
    body, hinges = model.geom_bodyid, links.hinges
    turn = links.rotation[body] @ np.array([rotation_matrix(quat) for quat in model.geom_quat])
    place = links.place[body] + np.einsum("gij,gj->gi", links.rotation[body], model.geom_pos)
    return np.choose(links.link[body] + 1, [hinges, *range(hinges), hinges + 1]), turn, place


@functools.cache
def finder(slots: tuple[str, ...]):
    """`find_contacts` of the scene of these slots."""
    scene = scene_of(slots)
    buffers = [
        Buffer("geom_size", 3 * (len(slots) + len(scene.tip_geoms))),
        Buffer("geom_pos", 3 * len(slots)),
        Buffer("geom_quat", 4 * len(slots)),
    ]
    text = "\n".join([declare_args(buffers), kernel_constants(scene)])
    library = ctypes.CDLL(str(warp_emulation.build(text, "contacts.cpp")))

    def find(worlds):
        """Contacts [N, MAX_CONTACTS] of worlds and their numbers [N]."""
        names = ("size", "place", "quat", "links", "object")
        arrays = [np.array([getattr(world, name) for world in worlds], np.float32) for name in names]
        pointers = [ctypes.c_void_p(array.ctypes.data) for array in arrays]
        contacts, count = np.zeros((len(worlds), MAX_CONTACTS), CONTACT), np.zeros(len(worlds), np.int32)
        args = args_type(3)((ctypes.c_void_p * 3)(*pointers[:3]), len(worlds))
        outputs = (part.ctypes.data_as(ctypes.c_void_p) for part in (contacts, count))
        library.find(ctypes.byref(args), *pointers[3:], *outputs)
        return contacts, count

    return find


class World:
    """A random world in which a pair is near contact and all else is far away."""

    def __init__(self, scene: PhysicsScene, pair: int, random: np.random.Generator):
        model, slots = scene.model, len(scene.slots)
        first, second = int(model.pair_geom1[pair]), int(model.pair_geom2[pair])
        self.scene, self.pair = scene, pair
        tips = model.geom_size[scene.tip_geoms] * random.uniform(0.8, 1.2)
        self.size = rounded(np.array([*(draw_size(kind, random) for kind in scene.slots), *tips]))
        self.quat = random.normal(size=(slots, 4))
        self.quat /= np.linalg.norm(self.quat, axis=1, keepdims=True)
        self.turn = np.array([rotation_matrix(quat) for quat in self.quat])
        self.place = np.array([[40.0 * (k + 1), 0, 0] for k in range(slots)])
        self.place[scene.object_geoms == second] = random.normal(size=3) * 0.01
        self.place = rounded(self.place)
        hinges = model.nv - 6
        self.links = np.array([pose(np.eye(3), [10.0 * k, -50, 50]) for k in range(hinges)] + [pose(np.eye(3), 0)])
        self.object = pose(np.eye(3), [0, 0, 200])
        self.data = mujoco.MjData(model)
        self._write()
        self._meet(first, second, random)

    def contacts(self) -> np.ndarray:
        """The pair's in C MuJoCo, as `CONTACT`."""
        model, data = self.scene.model, self.data
        # As float32 has them; not the rotations, which C MuJoCo needs to be ones.
        self.links[:, 9:], self.object[9:] = rounded(self.links[:, 9:]), rounded(self.object[9:])
        self._write()
        mujoco.mj_collision(model, data)
        first, second = int(model.pair_geom1[self.pair]), int(model.pair_geom2[self.pair])
        rows = []
        for contact in data.contact[: data.ncon]:
            if {*contact.geom.tolist()} == {first, second} and contact.dist < 0:
                side = 1 if contact.geom1 == first else -1
                rows.append((contact.dist, contact.pos, side * contact.frame[:3], self.pair))
        return np.array(rows, CONTACT)

    def _write(self) -> None:
        """The geoms' sizes and poses in C MuJoCo."""
        scene, model = self.scene, self.scene.model
        slots = len(scene.slots)
        model.geom_size[scene.object_geoms], model.geom_size[scene.tip_geoms] = self.size[:slots], self.size[slots:]
        link, turn, place = (part.copy() for part in in_links(scene.slots))
        turn[scene.object_geoms], place[scene.object_geoms] = self.turn, self.place
        at = np.vstack([self.links, self.object])[link]
        rotation = at[:, :9].reshape(-1, 3, 3)
        self.data.geom_xpos[:] = at[:, 9:] + np.einsum("gij,gj->gi", rotation, place)
        self.data.geom_xmat[:] = (rotation @ turn).reshape(-1, 9)

    def _meet(self, first: int, second: int, random: np.random.Generator) -> None:
        """Bring the geom `second` near `first`, with a gap of -4 to 1 mm."""
        model, data = self.scene.model, self.data
        if model.geom_bodyid[first]:
            self._move(first, draw_rotation(random), 0.05 * random.normal(size=3) - data.geom_xpos[first])
        axes = data.geom_xmat[first].reshape(3, 3)
        turn = draw_rotation(random)
        if random.uniform() < 0.5:  # almost flat on it, or parallel to it
            # On the rim of a cylinder the place of a contact is no more exact than the tilt.
            least = -3 if model.geom_type[second] == mujoco.mjtGeom.mjGEOM_CYLINDER else -5
            tilt = Rotation.from_rotvec(random.normal(size=3) * 10.0 ** random.uniform(least, -1)).as_matrix()
            spin = Rotation.from_rotvec([0, 0, random.choice([0, 1, 1]) * random.uniform(0, 2 * np.pi)]).as_matrix()
            turn = tilt @ axes @ spin @ data.geom_xmat[second].reshape(3, 3).T
        way = random.normal(size=3)
        if random.uniform() < 0.5:
            way = axes[:, random.integers(3)] * random.choice([-1, 1]) + 0.2 * way
        if model.geom_type[first] == mujoco.mjtGeom.mjGEOM_PLANE:
            way = axes[:, 2]
        start = data.geom_xpos[first] + 0.2 * way / np.linalg.norm(way)
        self._move(second, turn, start - data.geom_xpos[second])
        ends = np.zeros(6)
        distance = mujoco.mj_geomDistance(model, data, first, second, 1.0, ends)
        near = (ends[:3] - ends[3:]) / np.linalg.norm(ends[:3] - ends[3:])
        self._move(second, np.eye(3), (distance - random.uniform(-0.004, 0.001)) * near)

    def _move(self, geom: int, turn: np.ndarray, shift: np.ndarray) -> None:
        """Turn a geom about its middle, and shift it, with the link or the object that has it."""
        centre = self.data.geom_xpos[geom].copy()
        link = in_links(self.scene.slots)[0][geom]
        at = self.object if link == len(self.links) else self.links[link]
        at[9:] = centre + shift + turn @ (at[9:] - centre)
        at[:9] = (turn @ at[:9].reshape(3, 3)).ravel()
        self.data.geom_xpos[geom] = centre + shift
        self.data.geom_xmat[geom] = (turn @ self.data.geom_xmat[geom].reshape(3, 3)).ravel()


def draw_size(kind: str, random: np.random.Generator) -> np.ndarray:
    used = {"sphere": 1, "capsule": 2, "cylinder": 2}.get(kind, 3)
    return np.where(np.arange(3) < used, random.uniform(0.01, 0.04, 3), 0.0)


def draw_rotation(random: np.random.Generator) -> np.ndarray:
    return Rotation.from_quat(random.normal(size=4)).as_matrix()


def pose(rotation: np.ndarray, place) -> np.ndarray:
    return np.concatenate([rotation.ravel(), np.broadcast_to(place, 3)])


def rounded(values: np.ndarray) -> np.ndarray:
    return values.astype(np.float32).astype(float)


def close_to(expected: np.ndarray, contacts: np.ndarray) -> bool:
    """Whether contacts are the same within 10 um and 1e-3 of the normal; those of less than 2 um may be missing."""
    for some, others in ((expected, contacts), (contacts, expected)):
        for one in some[some["gap"] < -2e-6]:
            apart = np.linalg.norm(others["point"] - one["point"], axis=1)
            close = (apart < 1e-5) & (np.abs(others["gap"] - one["gap"]) < 1e-5)
            if not (close & (np.linalg.norm(others["normal"] - one["normal"], axis=1) < 1e-3)).any():
                return False
    clear = [np.sum(some["gap"] < -2e-6) for some in (expected, contacts)]
    return clear[0] <= len(contacts) and clear[1] <= len(expected)


@pytest.mark.parametrize(("slots", "first", "second"), CASES, ids=lambda part: part if isinstance(part, str) else "on")
def test_contacts_are_those_of_c_mujoco(slots, first, second):
    scene, random = scene_of(slots), np.random.default_rng(len(first) + 10 * len(second))
    model = scene.model
    other = model.geom(second if second in HAND else f"object_{slots.index(second)}").id
    (pair,) = np.flatnonzero((model.pair_geom1 == model.geom(first).id) & (model.pair_geom2 == other))
    worlds = [World(scene, pair, random) for _ in range(WORLDS)]
    expected = [world.contacts() for world in worlds]
    contacts, count = finder(slots)(worlds)
    contacts = [row[:number][row[:number]["pair"] == pair] for row, number in zip(contacts, count, strict=True)]
    assert np.mean([len(contacts) > 0 for contacts in expected]) > 0.6
    close = [close_to(*both) for both in zip(expected, contacts, strict=True)]
    assert np.sum(~np.array(close)) <= 1


def crowd(slots: tuple[str, ...], seed: int) -> World:
    """All geoms almost in one place."""
    random = np.random.default_rng(seed)
    world = World(scene_of(slots), 0, random)
    world.links[:-1, 9:] = 0.005 * random.normal(size=(len(world.links) - 1, 3))
    world.object[9:], world.place = 0, rounded(0.005 * random.normal(size=world.place.shape))
    return world


def test_deepest_contacts_of_a_mesh_are_kept():
    worlds = [crowd(MESH, seed) for seed in range(20)]
    contacts, count = finder(MESH)(worlds)
    crowded = 0
    for world, rows, number in zip(worlds, contacts, count, strict=True):
        world.contacts()
        deepest = np.sort(world.data.contact.dist)[:MAX_CONTACTS]
        np.testing.assert_allclose(np.sort(rows["gap"][:number]), deepest, atol=1e-5)
        crowded += world.data.ncon > MAX_CONTACTS
    assert crowded > 3
