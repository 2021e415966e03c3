"""What is turned: a cube, or a mesh."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from dexsim.core.pytree import Array
from dexsim.core.ranges import sample_extreme, uniform
from dexsim.geometry import rotations
from dexsim.objects.config import SHAPES
from dexsim.objects.params import ObjectParams, extent, sample_object

CLEARANCE = 0.001  # m, smallest gap between palm and object with support "fingers"


def slots(config: Any) -> tuple[str, ...]:
    """The primitives that the object consists of."""
    return config.objects.slots if config.objects.mesh else ("box",)


def largest_size(config: Any) -> np.ndarray:
    """Upper bound [K, 3] m of each slot's size."""
    return config.objects.largest if config.objects.mesh else np.full((1, 3), config.edge[1] / 2)


def sample_turned_object(key: jax.Array, config: Any) -> ObjectParams:
    """Draw one object."""
    if config.objects.mesh:
        return sample_object(key, config.objects)
    edge_key, base_key, scale_key = jax.random.split(key, 3)
    base = sample_object(base_key, config.objects, jnp.int32(SHAPES.index("box")))
    extreme = sample_extreme(base_key, config.objects.extremes)  # the one that `sample_object` draws
    half = uniform(edge_key, config.edge, extreme) / 2
    solid = base.mass * uniform(scale_key, config.objects.inertia_scale, extreme)
    stand = upright(config.turn.unit_axis)
    return dataclasses.replace(
        base,
        size=jnp.full((1, 3), half),
        position=jnp.zeros((1, 3)),
        active=jnp.ones(1, bool),
        inertia=solid * cube_inertia(half),
        quat=None if stand is None else jnp.array([stand], jnp.float32),
        kinds=("box",),
    )


def upright(axis: np.ndarray) -> np.ndarray | None:
    """The shortest turn [4] that takes x to this unit vector, on which a face of a cube stands; None for x."""
    if axis[0] > 1 - 1e-9:
        return None
    if axis[0] < -1 + 1e-9:
        return np.array([0.0, 0.0, 0.0, 1.0], np.float32)
    half = np.array([1 + axis[0], 0.0, -axis[2], axis[1]])  # (1 + x . axis, x cross axis)
    return (half / np.linalg.norm(half)).astype(np.float32)


def cube_inertia(half: jax.Array) -> jax.Array:
    """Inertia [3] m^2 of a uniform cube of 1 kg, `half` m from its middle to its sides."""
    return jnp.full(3, 2 / 3) * half**2


def lowest_point(object: ObjectParams, quat: Array, position: Array) -> jax.Array:
    """Smallest coordinate [] m of the object along the palm's normal (x)."""
    down = rotations.rotate_inverse(rotations.quat_to_matrix(quat), jnp.array([-1.0, 0.0, 0.0]))
    reach = extent(object.size, object.position, object.active, down, object.kinds, object.quat)
    return position[0] - reach
