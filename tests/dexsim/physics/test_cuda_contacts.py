"""Contacts of the `cuda` engine, in the emulation of a warp, against C MuJoCo: pairs of every kind near contact."""

import ctypes
import functools

import mujoco
import numpy as np
import pytest
import warp_emulation
from physics_states import scene_of_model
from scipy.spatial.transform import Rotation

from dexsim.physics.cuda import scene as cuda_scene
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
def links_of(slots: tuple[str, ...]) -> cuda_scene.Links:
    return cuda_scene.find_links(scene_of(slots))


@functools.cache
def finder(slots: tuple[str, ...]):
    """`find_contacts` of the scene of these slots."""
    scene = scene_of(slots)
    primitives, tips = len(slots), len(scene.tip_geoms)
    sizes = {"geom_size": 3 * (primitives + tips), "geom_pos": 3 * primitives, "geom_quat": 4 * primitives}
    buffers = [cuda_scene.Buffer(*each) for each in sizes.items()]
    text = cuda_scene.declare_args(buffers) + cuda_scene.kernel_constants(scene)
    library = ctypes.CDLL(str(warp_emulation.build(text, "contacts.cpp")))

    def find(worlds):
        """Contacts [N, MAX_CONTACTS] of worlds and their numbers [N]."""
        arrays = [np.array(parts, np.float32) for parts in zip(*(world.arrays() for world in worlds), strict=True)]
        pointers = [ctypes.c_void_p(array.ctypes.data) for array in arrays]
        contacts, count = np.zeros((len(worlds), cuda_scene.MAX_CONTACTS), CONTACT), np.zeros(len(worlds), np.int32)
        args = cuda_scene.args_type(3)((ctypes.c_void_p * 3)(*pointers[:3]), len(worlds))
        outputs = (part.ctypes.data_as(ctypes.c_void_p) for part in (contacts, count))
        library.find(ctypes.byref(args), *pointers[3:], *outputs)
        return contacts, count

    return find


class World:
    """Sizes and poses of all geoms, far from each other and turned at random; the floor is where the file has it."""

    def __init__(self, scene: PhysicsScene, random: np.random.Generator):
        model = scene.model
        tips = model.geom_size[scene.tip_geoms] * random.uniform(0.8, 1.2)
        self.scene, self.size = scene, np.array([*(draw_size(kind, random) for kind in scene.slots), *tips])
        self.place = 50.0 + 10.0 * np.arange(model.ngeom)[:, None] * [1, -1, 1]
        self.turn = Rotation.random(model.ngeom, random_state=random).as_matrix()
        self.floor = model.geom("floor").id
        self.place[self.floor] = model.geom_pos[self.floor]
        self.turn[self.floor] = cuda_scene.rotation_matrix(model.geom_quat[self.floor])

    def in_mujoco(self) -> mujoco.MjData:
        model, data = self.scene.model, mujoco.MjData(self.scene.model)
        model.geom_size[[*self.scene.object_geoms, *self.scene.tip_geoms]] = self.size
        data.geom_xpos[:], data.geom_xmat[:] = self.place, self.turn.reshape(-1, 9)
        mujoco.mj_collision(model, data)
        return data

    def arrays(self) -> tuple[np.ndarray, ...]:
        """Sizes; places and quaternions of the primitives in the object; poses of the links, the palm's last, and of
        the object, which is near its nearest primitive and as askew as the floor."""
        model, links, geoms = self.scene.model, links_of(self.scene.slots), self.scene.object_geoms
        poses = np.tile(pose(np.eye(3), 0), (links.hinges + 1, 1))
        for geom, body in enumerate(model.geom_bodyid):
            if 0 <= links.link[body] < links.hinges:
                turn = self.turn[geom] @ (links.rotation[body] @ cuda_scene.rotation_matrix(model.geom_quat[geom])).T
                here = links.place[body] + links.rotation[body] @ model.geom_pos[geom]
                poses[links.link[body]] = pose(turn, self.place[geom] - turn @ here)
        nearest = np.linalg.norm(self.place[geoms], axis=1).argmin()
        turn, place = self.turn[self.floor], self.place[geoms[nearest]] + 0.01
        quat = np.roll(Rotation.from_matrix(turn.T @ self.turn[geoms]).as_quat(), 1, axis=1)
        return self.size, (self.place[geoms] - place) @ turn, quat, poses, pose(turn, place)

    def meet(self, first: int, second: int, random: np.random.Generator) -> None:
        """Bring the geom `second` near `first`, with a gap of -4 to 1 mm."""
        if first != self.floor:
            self.place[first] = 0.05 * random.normal(size=3)
        model, axes = self.scene.model, self.turn[first]
        if random.uniform() < 0.5:  # almost flat on it, or parallel to it
            # On the rim of a cylinder the place of a contact is no more exact than the tilt.
            least = -3 if model.geom_type[second] == mujoco.mjtGeom.mjGEOM_CYLINDER else -5
            tilt = Rotation.from_rotvec(random.normal(size=3) * 10.0 ** random.uniform(least, -1)).as_matrix()
            spin = Rotation.from_rotvec([0, 0, random.choice([0, 1, 1]) * random.uniform(0, 2 * np.pi)]).as_matrix()
            self.turn[second] = tilt @ axes @ spin
        way = random.normal(size=3)
        if random.uniform() < 0.5:
            way = axes[:, random.integers(3)] * random.choice([-1, 1]) + 0.2 * way
        if first == self.floor:
            way = axes[:, 2]
        self.place[second] = self.place[first] + 0.2 * way / np.linalg.norm(way)
        ends = np.zeros(6)
        distance = mujoco.mj_geomDistance(model, self.in_mujoco(), first, second, 1.0, ends)
        near = (ends[:3] - ends[3:]) / np.linalg.norm(ends[:3] - ends[3:])
        self.place[second] += (distance - random.uniform(-0.004, 0.001)) * near

    def contacts(self, first: int, second: int) -> np.ndarray:
        """Those of two geoms in C MuJoCo, as `CONTACT`."""
        rows = []
        for contact in self.in_mujoco().contact:
            if {*contact.geom.tolist()} == {first, second} and contact.dist < 0:
                side = 1 if contact.geom1 == first else -1
                rows.append((contact.dist, contact.pos, side * contact.frame[:3], 0))
        return np.array(rows, CONTACT)


def draw_size(kind: str, random: np.random.Generator) -> np.ndarray:
    used = {"sphere": 1, "capsule": 2, "cylinder": 2}.get(kind, 3)
    return np.where(np.arange(3) < used, random.uniform(0.01, 0.04, 3), 0.0)


def pose(rotation: np.ndarray, place) -> np.ndarray:
    return np.concatenate([rotation.ravel(), np.broadcast_to(place, 3)])


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
    worlds = [World(scene, random) for _ in range(WORLDS)]
    for world in worlds:
        world.meet(model.geom(first).id, other, random)
    expected = [world.contacts(model.geom(first).id, other) for world in worlds]
    contacts, count = finder(slots)(worlds)
    contacts = [row[:number][row[:number]["pair"] == pair] for row, number in zip(contacts, count, strict=True)]
    assert np.mean([len(contacts) > 0 for contacts in expected]) > 0.6
    assert all(close_to(*both) for both in zip(expected, contacts, strict=True))


def test_deepest_contacts_of_a_mesh_are_kept():
    """All geoms almost in one place."""
    scene, random, worlds = scene_of(MESH), np.random.default_rng(0), []
    for _ in range(20):
        worlds.append(world := World(scene, random))
        hand = np.arange(scene.model.ngeom) != world.floor
        world.place[hand] = 0.005 * random.normal(size=(hand.sum(), 3))
    contacts, count = finder(MESH)(worlds)
    crowded = 0
    for world, rows, number in zip(worlds, contacts, count, strict=True):
        gaps = np.sort(world.in_mujoco().contact.dist)
        np.testing.assert_allclose(np.sort(rows["gap"][:number]), gaps[: cuda_scene.MAX_CONTACTS], atol=1e-5)
        crowded += len(gaps) > cuda_scene.MAX_CONTACTS
    assert crowded > 3
