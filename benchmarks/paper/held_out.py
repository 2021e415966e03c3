"""Objects that no training has seen, and the grasp task with them: 12 compositions and 12 meshes in one batch.

Every object is a union of at most eight boxes, three capsules and two cylinders, so that one compiled environment holds
them all. A mesh is the boxes that follow it, as with `ObjectConfig.mesh`. The task is the grasp in all else.
"""

import dataclasses
import json
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from dexsim.core.assets import asset_path
from dexsim.core.ranges import uniform
from dexsim.hand.description import Hand
from dexsim.objects.config import INACTIVE_SIZE, PROPERTY_RANGES, SHAPES
from dexsim.objects.params import ObjectParams, sample_object
from dexsim.tasks.grasp.config import GraspConfig
from dexsim.tasks.grasp.task import Grasp

CATALOGUE: dict[str, Any] = json.loads(asset_path("objects/held_out.json").read_text())
"""By name: parts in the principal frame, sizes and places in m, and the inertia [3] m^2 of a uniform solid of 1 kg."""
NAMES = tuple(CATALOGUE)
SLOTS = ("box",) * 8 + ("capsule",) * 3 + ("cylinder",) * 2
HEAVY = {"ingot": (0.25, 0.35), "spool": (0.25, 0.35), "anvil": (0.25, 0.35), "mace": (0.20, 0.30)}
"""kg, mass of the heavy objects; training ends at 0.20 kg. All others have training's range."""


def shape_of(name: str) -> dict[str, np.ndarray]:
    """An object in our slots: size [K, 3], position [K, 3], quat [K, 4], active [K], inertia [3]."""
    shape = {
        "size": np.full((len(SLOTS), 3), INACTIVE_SIZE, np.float32),
        "position": np.zeros((len(SLOTS), 3), np.float32),
        "quat": np.tile(np.float32([1, 0, 0, 0]), (len(SLOTS), 1)),
        "active": np.zeros(len(SLOTS), bool),
        "inertia": np.float32(CATALOGUE[name]["inertia"]),
    }
    for part in CATALOGUE[name]["parts"]:
        slot = next(k for k, kind in enumerate(SLOTS) if kind == part["kind"] and not shape["active"][k])
        shape["active"][slot] = True
        for field in ("size", "position", "quat"):
            shape[field][slot] = part[field]
    return shape


class HeldOutGrasp(Grasp):
    """The grasp with the named objects of the catalogue; shapes and sizes of the configuration are not used."""

    def __init__(self, config: GraspConfig, hand: Hand, names: tuple[str, ...] = NAMES):
        super().__init__(config, hand)
        shapes = [shape_of(name) for name in names]
        self.shape_names = self.drawn_shapes = names
        self.slots = SLOTS
        self._table: Any = {field: np.stack([shape[field] for shape in shapes]) for field in shapes[0]}
        self.largest = self._table["size"].max(0)
        self._mass = np.array([HEAVY.get(name, config.objects.mass) for name in names], np.float32)
        # Mass stays as the pool has it, since heavy objects have a range of their own.
        self.object_ranges = tuple(f"objects.{name}" for name in PROPERTY_RANGES if name != "mass")

    def sample_object(self, key: jax.Array, config: GraspConfig, shape_index: jax.Array | None = None) -> ObjectParams:
        """One object, of a random or the given index of the catalogue."""
        if shape_index is None:
            shape_index = jax.random.randint(jax.random.fold_in(key, 3), (), 0, len(self.shape_names))
        base = sample_object(jax.random.fold_in(key, 1), config.objects, jnp.int32(SHAPES.index("box")))
        rows = {name: jnp.asarray(table)[shape_index] for name, table in self._table.items()}
        low, high = jnp.asarray(self._mass)[shape_index]
        mass = low + (high - low) * jax.random.uniform(jax.random.fold_in(key, 2))
        scale = uniform(jax.random.fold_in(key, 4), config.objects.inertia_scale, base.extreme)
        return dataclasses.replace(
            base,
            shape_index=jnp.asarray(shape_index, jnp.int32),
            inertia=mass * scale * rows.pop("inertia"),
            mass=mass,
            kinds=SLOTS,
            **rows,
        )

    def unit_inertia(self, object: ObjectParams) -> jax.Array:
        """Inertia [3] m^2 of the object as a uniform solid of 1 kg."""
        return jnp.asarray(self._table["inertia"])[object.shape_index]
