"""Signed distances to closed-form primitives and their unions.

Sizes are MuJoCo's: box half-extents; capsule and cylinder (radius, half-length, -) along z; sphere (radius, -, -).
Distances are negative inside, and exact but for points inside an overlap of several primitives, where a union gives the
depth below the nearest of their surfaces, not below the outer one.
"""

import functools

import jax
import jax.numpy as jnp

from dexsim.core.pytree import Array, pytree_dataclass, static

FAR = 1e3  # m, the distance to a primitive that is switched off
_TINY = 1e-20  # keeps the gradient of a norm finite at zero


@pytree_dataclass
class Shape:
    """A union of K primitives in the object's frame; `kinds` is fixed, all else may be traced."""

    kinds: tuple[str, ...] = static()
    size: Array  # [K, 3] m
    position: Array  # [K, 3] m
    rotation: Array  # [K, 3, 3]
    active: Array  # [K] bool


def sphere(point: Array, size: Array) -> jax.Array:
    x, y, z = _split(point)
    return _length(x, y, z) - size[0]


def box(point: Array, size: Array) -> jax.Array:
    x, y, z = (jnp.abs(p) - size[axis] for axis, p in enumerate(_split(point)))
    outside = _length(jnp.maximum(x, 0.0), jnp.maximum(y, 0.0), jnp.maximum(z, 0.0))
    return outside + jnp.minimum(jnp.maximum(jnp.maximum(x, y), z), 0.0)


def capsule(point: Array, size: Array) -> jax.Array:
    x, y, z = _split(point)
    return _length(x, y, z - jnp.clip(z, -size[1], size[1])) - size[0]


def cylinder(point: Array, size: Array) -> jax.Array:
    x, y, z = _split(point)
    radial = _length(x, y) - size[0]
    axial = jnp.abs(z) - size[1]
    outside = _length(jnp.maximum(radial, 0.0), jnp.maximum(axial, 0.0))
    return outside + jnp.minimum(jnp.maximum(radial, axial), 0.0)


DISTANCE = {"sphere": sphere, "box": box, "capsule": capsule, "cylinder": cylinder}
"""Distance [...] m from points [..., 3] to one primitive of a size [3] in its own frame, by its kind."""


def signed_distance(points: Array, shape: Shape) -> jax.Array:
    """Distance [...] m from `points` [..., 3] (object frame) to the union."""

    def one(k: int) -> jax.Array:
        local = to_local(points, shape.position[k], shape.rotation[k])
        return jnp.where(shape.active[k], DISTANCE[shape.kinds[k]](local, shape.size[k]), FAR)

    return functools.reduce(jnp.minimum, map(one, range(len(shape.kinds))))


def to_local(points: Array, position: Array, rotation: Array) -> jax.Array:
    """Points [..., 3] in the frame at `position` [3], `rotation` [3, 3]: component by component, so that XLA makes one
    kernel of transform and distance."""
    arm = [p - position[axis] for axis, p in enumerate(_split(points))]
    return jnp.stack([sum(rotation[row, axis] * arm[row] for row in range(3)) for axis in range(3)], -1)


def _split(point: Array) -> tuple[Array, Array, Array]:
    return point[..., 0], point[..., 1], point[..., 2]


def _length(*parts: Array) -> jax.Array:
    return jnp.sqrt(sum(part * part for part in parts) + _TINY)
