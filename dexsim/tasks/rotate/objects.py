"""What is turned: a cube, or another of the rotation task's objects."""

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

KINDS = {"cube": ("box",), "cylinder": ("cylinder",), "octagon": ("box", "box")}
"""Objects that can be turned beside meshes, and the primitives each consists of."""
_SHAPE_INDEX = {"cube": "box", "cylinder": "cylinder", "octagon": "composition"}
_UPRIGHT = (np.sqrt(0.5), 0.0, np.sqrt(0.5), 0.0)  # takes a cylinder's axis to x
_EIGHTH = (np.cos(np.pi / 8), np.sin(np.pi / 8), 0.0, 0.0)  # 45 degrees about x


def slots(config: Any) -> tuple[str, ...]:
    """The primitives that the object consists of."""
    return config.objects.slots if config.object == "mesh" else KINDS[config.object]


def largest_size(config: Any) -> np.ndarray:
    """Upper bound [K, 3] m of each slot's size."""
    if config.object == "mesh":
        return config.objects.largest
    half = config.edge[1] / 2
    return np.full((len(KINDS[config.object]), 3), half)


def sample_turned_object(key: jax.Array, config: Any) -> ObjectParams:
    """Draw one object."""
    if config.object == "mesh":
        return sample_object(key, config.objects)
    edge_key, base_key, scale_key = jax.random.split(key, 3)
    kinds = KINDS[config.object]
    base = sample_object(base_key, config.objects, jnp.int32(SHAPES.index("box")))
    shortest, longest = config.edge
    if config.objects.scale != 1:
        middle, reach = (shortest + longest) / 2, config.objects.scale * (longest - shortest) / 2
        shortest, longest = middle - reach, middle + reach
    extreme = sample_extreme(base_key, config.objects.extremes)  # the one that `sample_object` draws
    half = uniform(edge_key, (shortest, longest), extreme) / 2
    scale = base.mass * uniform(scale_key, config.objects.narrowed().inertia_scale, extreme)
    stand = upright(config.turn.unit_axis)
    turns = {
        "cube": None if stand is None else [stand],
        "cylinder": [_UPRIGHT],
        "octagon": [(1.0, 0.0, 0.0, 0.0), _EIGHTH],
    }[config.object]
    quat = None if turns is None else jnp.array(turns, jnp.float32)
    inertia = unit_inertia(config.object, half)
    size = jnp.full((len(kinds), 3), half)
    return dataclasses.replace(
        base,
        shape_index=jnp.int32(SHAPES.index(_SHAPE_INDEX[config.object])),
        size=size,
        position=jnp.zeros((len(kinds), 3)),
        active=jnp.ones(len(kinds), bool),
        inertia=scale * inertia,
        quat=quat,
        kinds=kinds,
    )


def upright(axis: np.ndarray) -> np.ndarray | None:
    """The shortest turn [4] that takes x to this unit vector, on which a face of a cube stands; None for x."""
    if axis[0] > 1 - 1e-9:
        return None
    if axis[0] < -1 + 1e-9:
        return np.array([0.0, 0.0, 0.0, 1.0], np.float32)
    half = np.array([1 + axis[0], 0.0, -axis[2], axis[1]])  # (1 + x . axis, x cross axis)
    return (half / np.linalg.norm(half)).astype(np.float32)


def unit_inertia(name: str, half: jax.Array) -> jax.Array:
    """Inertia [3] m^2 of a uniform solid of 1 kg, `half` m from its middle to its sides."""
    if name == "cube":
        return jnp.full(3, 2 / 3) * half**2
    # Round about the palm's normal: the octagon as the cylinder between its circles.
    radius = half if name == "cylinder" else 1.05 * half
    across = radius**2 / 4 + half**2 / 3
    return jnp.stack([radius**2 / 2, across, across])


def lowest_point(object: ObjectParams, quat: Array, position: Array) -> jax.Array:
    """Smallest coordinate [] m of the object along the palm's normal (x)."""
    down = rotations.rotate_inverse(rotations.quat_to_matrix(quat), jnp.array([-1.0, 0.0, 0.0]))
    reach = extent(object.size, object.position, object.active, down, object.kinds, object.quat)
    return position[0] - reach
