"""Objects that no training has seen, and the grasp task with them: 12 compositions and 12 meshes in one batch.

Every object is a union of at most eight boxes, three capsules and two cylinders, so that one compiled environment holds
them all. A mesh is the boxes that follow it, as with `ObjectConfig.mesh`. The task is the grasp in all else.
"""

import dataclasses
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from dexsim.core.ranges import uniform
from dexsim.geometry import rotations, sdf
from dexsim.hand.kinematics import Hand
from dexsim.objects import mesh as mesh_objects
from dexsim.objects.config import BULK_RANGES, INACTIVE_SIZE, SHAPES
from dexsim.objects.params import ObjectParams, sample_object
from dexsim.tasks.grasp.config import GraspConfig
from dexsim.tasks.grasp.task import Grasp
from paper.meshes import MESHES

FOLDER = Path(__file__).resolve().parents[2] / "assets" / "objects"
SLOTS = ("box",) * 8 + ("capsule",) * 3 + ("cylinder",) * 2
HEAVY = {"ingot": (0.25, 0.35), "spool": (0.25, 0.35), "anvil": (0.25, 0.35), "mace": (0.20, 0.30)}
"""kg, mass of the heavy objects; training ends at 0.20 kg. All others have training's range."""
_AXES = {
    "x": (np.sqrt(0.5), 0.0, np.sqrt(0.5), 0.0),
    "y": (np.sqrt(0.5), -np.sqrt(0.5), 0.0, 0.0),
    "z": (1.0, 0.0, 0.0, 0.0),
}
_PITCH = 0.001  # m, of the lattice that mass properties are summed on

# Kind, axis, size and place of each part, mm: half-extents of boxes, radius and half-length of the others.
COMPOSITIONS: dict[str, tuple[tuple[str, str, tuple[float, ...], tuple[float, float, float]], ...]] = {
    "cross": (("box", "z", (12, 14, 35), (0, 0, 0)), ("box", "z", (30, 14, 12), (0, 0, 0))),
    "tee": (("box", "z", (12, 15, 30), (0, 0, 0)), ("box", "z", (16, 15, 12), (24, 0, 0))),
    "dumbbell": (
        ("cylinder", "z", (11, 25), (0, 0, 0)),
        ("capsule", "z", (22, 0.1), (0, 0, 22)),
        ("capsule", "z", (22, 0.1), (0, 0, -22)),
    ),
    "elbow": (("capsule", "z", (15, 22), (0, 0, 6)), ("capsule", "x", (15, 16), (16, 0, -16))),
    "hammer": (("cylinder", "z", (12, 30), (0, 0, 0)), ("box", "z", (25, 15, 13), (0, 0, 26))),
    "twins": (("capsule", "z", (15, 20), (14, 0, 0)), ("capsule", "z", (15, 20), (-14, 0, 0))),
    "offset_blocks": (("box", "z", (18, 18, 18), (8, 6, 13)), ("box", "z", (18, 18, 18), (-8, -6, -13))),
    "snowman": (
        ("capsule", "z", (24, 0.1), (0, 0, -20)),
        ("capsule", "z", (20, 0.1), (0, 0, 8)),
        ("capsule", "z", (15, 0.1), (0, 0, 28)),
    ),
    "wheels": (
        ("cylinder", "z", (26, 8), (0, 0, 20)),
        ("cylinder", "z", (26, 8), (0, 0, -20)),
        ("capsule", "z", (12, 18), (0, 0, 0)),
    ),
    "jack": (
        ("box", "z", (11, 11, 32), (0, 0, 0)),
        ("box", "z", (11, 30, 11), (0, 0, 0)),
        ("box", "z", (30, 11, 11), (0, 0, 0)),
    ),
    "anvil": (
        ("box", "z", (26, 18, 8), (0, 0, -16)),
        ("box", "z", (12, 16, 16), (0, 0, 0)),
        ("box", "z", (24, 18, 9), (0, 0, 18)),
    ),
    "mace": (("capsule", "z", (25, 0.1), (0, 0, 22)), ("cylinder", "z", (13, 28), (0, 0, -14))),
}
NAMES = (*COMPOSITIONS, *MESHES)


@dataclasses.dataclass(frozen=True)
class Shape:
    """One object of the catalogue in its principal frame; K slots."""

    size: np.ndarray  # [K, 3] m
    position: np.ndarray  # [K, 3] m
    quat: np.ndarray  # [K, 4]
    active: np.ndarray  # [K] bool
    inertia: np.ndarray  # [3] m^2, of a uniform solid of 1 kg


def load_shape(name: str) -> Shape:
    """An object of `NAMES`.

    Raises:
      AssetError: its mesh is missing, or boxes do not follow it.
    """
    if name in COMPOSITIONS:
        return _composition(COMPOSITIONS[name])
    found = mesh_objects.load(str(FOLDER / f"{name}.stl"), unit=1.0, parts=8)
    parts = zip(found.boxes.size, found.boxes.position, found.boxes.quat, strict=True)
    return _in_slots([("box", *part) for part in parts], found.inertia)


def _composition(parts: tuple) -> Shape:
    size = np.zeros((len(parts), 3))
    for row, (_, _, given, _) in enumerate(parts):
        size[row, : len(given)] = 1e-3 * np.asarray(given)
    place = 1e-3 * np.array([part[3] for part in parts])
    quat = np.array([_AXES[part[1]] for part in parts])
    union = sdf.Shape(
        tuple(part[0] for part in parts),
        jnp.asarray(size),
        jnp.asarray(place),
        rotations.quat_to_matrix(jnp.asarray(quat)),
        jnp.ones(len(parts), bool),
    )
    centre, tensor = _solid(union)
    axes = mesh_objects.principal_axes(tensor)
    turn = _quat(axes.T)
    turned = [np.asarray(rotations.quat_multiply(turn, jnp.asarray(q, jnp.float32))) for q in quat]
    rows = [(part[0], size[k], (place[k] - centre) @ axes, turned[k]) for k, part in enumerate(parts)]
    return _in_slots(rows, np.diag(axes.T @ tensor @ axes))


def _solid(union: sdf.Shape) -> tuple[np.ndarray, np.ndarray]:
    """Centre [3] m and inertia [3, 3] m^2 about it of a uniform solid of 1 kg; overlaps count once."""
    line = np.arange(-0.07, 0.07, _PITCH) + _PITCH / 2
    points = np.stack(np.meshgrid(line, line, line, indexing="ij"), -1).reshape(-1, 3)
    distance = jax.jit(sdf.signed_distance)(jnp.asarray(points, jnp.float32), union)
    points = points[np.asarray(distance) < 0]
    centre = points.mean(0)
    off = points - centre
    second = off.T @ off / len(off)
    return centre, np.trace(second) * np.eye(3) - second


def _quat(matrix: np.ndarray) -> jax.Array:
    import mujoco

    quat = np.empty(4)
    mujoco.mju_mat2Quat(quat, np.ascontiguousarray(matrix, float).ravel())
    return jnp.asarray(quat, jnp.float32)


def _in_slots(parts: list, inertia: np.ndarray) -> Shape:
    """Each part in a free slot of its kind."""
    free = list(range(len(SLOTS)))
    shape = Shape(
        np.full((len(SLOTS), 3), INACTIVE_SIZE),
        np.zeros((len(SLOTS), 3)),
        np.tile([1.0, 0.0, 0.0, 0.0], (len(SLOTS), 1)),
        np.zeros(len(SLOTS), bool),
        np.asarray(inertia, float),
    )
    for kind, size, position, quat in parts:
        slot = next(slot for slot in free if SLOTS[slot] == kind)
        free.remove(slot)
        shape.size[slot], shape.position[slot], shape.quat[slot], shape.active[slot] = size, position, quat, True
    return shape


class HeldOutGrasp(Grasp):
    """The grasp with objects of the catalogue.

    Args:
      config: of the grasp; its shapes and sizes are not used.
      hand: the hand.
      names: of `NAMES`, the objects; at least one.
    """

    def __init__(self, config: GraspConfig, hand: Hand, names: tuple[str, ...] = NAMES):
        super().__init__(config, hand)
        shapes = [load_shape(name) for name in names]
        self.shape_names = self.names = names
        self.slots = SLOTS
        self._table: Any = {
            field.name: np.stack([getattr(shape, field.name) for shape in shapes]).astype(
                bool if field.name == "active" else np.float32
            )
            for field in dataclasses.fields(Shape)
        }
        self.largest = self._table["size"].max(0)
        self._mass = np.array([HEAVY.get(name, config.objects.mass) for name in names], np.float32)
        # Mass stays as the pool has it, since heavy objects have a range of their own.
        self.object_ranges = tuple(f"objects.{name}" for name in BULK_RANGES if name != "mass")

    @property
    def drawn_shapes(self) -> tuple[str, ...]:
        """All of the catalogue."""
        return self.names

    def sample_object(self, key: jax.Array, config: GraspConfig, shape_index: jax.Array | None = None) -> ObjectParams:
        """One object, of a random or the given index of the catalogue."""
        if shape_index is None:
            shape_index = jax.random.randint(jax.random.fold_in(key, 3), (), 0, len(self.names))
        base = sample_object(jax.random.fold_in(key, 1), config.objects, jnp.int32(SHAPES.index("box")))
        rows = {name: jnp.asarray(table)[shape_index] for name, table in self._table.items()}
        low, high = jnp.asarray(self._mass)[shape_index]
        mass = low + (high - low) * jax.random.uniform(jax.random.fold_in(key, 2))
        scale = uniform(jax.random.fold_in(key, 4), config.objects.inertia_scale, base.extreme)
        return dataclasses.replace(
            base,
            shape_index=jnp.asarray(shape_index, jnp.int32),
            size=rows["size"],
            position=rows["position"],
            quat=rows["quat"],
            active=rows["active"],
            mass=mass,
            inertia=mass * scale * rows["inertia"],
            kinds=SLOTS,
        )

    def unit_inertia(self, object: ObjectParams) -> jax.Array:
        """Inertia [3] m^2 of the object as a uniform solid of 1 kg."""
        return jnp.asarray(self._table["inertia"])[object.shape_index]
