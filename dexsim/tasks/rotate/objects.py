"""What is turned: a cube, a box of three edges, an upright cylinder, or a mesh."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from dexsim.core.pytree import Array
from dexsim.core.ranges import sample_extreme, uniform
from dexsim.geometry import rotations
from dexsim.objects.config import INACTIVE_SIZE, SHAPES
from dexsim.objects.params import ObjectParams, extent, sample_object, unit_inertia

_Z_TO_X = (np.sqrt(0.5), 0.0, np.sqrt(0.5), 0.0)
CLEARANCE = 0.001  # m, smallest gap between palm and object with support "fingers"


def slots(config: Any) -> tuple[str, ...]:
    """The primitives that the object consists of."""
    return config.objects.slots


def largest_size(config: Any) -> np.ndarray:
    """Upper bound [K, 3] m of each slot's size."""
    if config.objects.mesh:
        return config.objects.largest
    half = config.edge[1] / 2 * config.proportions[1]
    size = {"box": [half, half, half], "cylinder": [half, half, 0.0]}
    return np.array([size[slot] for slot in slots(config)])


def sample_turned_object(key: jax.Array, config: Any) -> ObjectParams:
    """Draw one object."""
    if config.objects.mesh:
        return sample_object(key, config.objects)
    edge_key, base_key, scale_key = jax.random.split(key, 3)
    shape_key, proportion_key = jax.random.split(jax.random.fold_in(key, 1))
    shapes = jnp.array([SHAPES.index(name) for name in config.objects.shapes], jnp.int32)
    base = sample_object(base_key, config.objects, jax.random.choice(shape_key, shapes))
    extreme = sample_extreme(base_key, config.objects.extremes)  # the one that `sample_object` draws
    half = uniform(edge_key, config.edge, extreme) / 2
    half = half * uniform(proportion_key, config.proportions, extreme, (3,))
    solid = base.mass * uniform(scale_key, config.objects.inertia_scale, extreme)
    stand, kinds = upright(config.turn.unit_axis), slots(config)
    active = jnp.array([SHAPES.index(kind) for kind in kinds]) == base.shape_index
    # Slots lie along the object's axes; the axis of a cylinder, z, is the palm's normal, x.
    sizes = {"box": half, "cylinder": jnp.stack([half[1], half[0], jnp.zeros(())])}
    turned = {"box": (1.0, 0.0, 0.0, 0.0) if stand is None else stand, "cylinder": _Z_TO_X}
    object = dataclasses.replace(
        base,
        size=jnp.where(active[:, None], jnp.stack([sizes[kind] for kind in kinds]), INACTIVE_SIZE),
        position=jnp.zeros((len(kinds), 3)),
        active=active,
        quat=None if kinds == ("box",) and stand is None else jnp.array([turned[kind] for kind in kinds], jnp.float32),
        kinds=kinds,
    )
    return dataclasses.replace(object, inertia=solid * solid_inertia(object))


def upright(axis: np.ndarray) -> np.ndarray | None:
    """The shortest turn [4] that takes x to this unit vector, on which a face of a cube stands; None for x."""
    if axis[0] > 1 - 1e-9:
        return None
    if axis[0] < -1 + 1e-9:
        return np.array([0.0, 0.0, 0.0, 1.0], np.float32)
    half = np.array([1 + axis[0], 0.0, -axis[2], axis[1]])  # (1 + x . axis, x cross axis)
    return (half / np.linalg.norm(half)).astype(np.float32)


def solid_inertia(object: ObjectParams) -> jax.Array:
    """Inertia [3] m^2 about its axes of a uniform box, or cylinder along x, of 1 kg."""
    inertia = unit_inertia(object)  # of a cylinder along z
    if "cylinder" not in object.kinds:
        return inertia
    return jnp.where(object.active[object.kinds.index("cylinder")], inertia[::-1], inertia)


def lowest_point(object: ObjectParams, quat: Array, position: Array) -> jax.Array:
    """Smallest coordinate [] m of the object along the palm's normal (x)."""
    down = rotations.rotate_inverse(rotations.quat_to_matrix(quat), jnp.array([-1.0, 0.0, 0.0]))
    return position[0] - extent(object, down)
