"""Signed distances to closed-form primitives and their unions.

Sizes are MuJoCo's: box half-extents; capsule and cylinder (radius, half-length, -) along z;
sphere (radius, -, -); ellipsoid semi-axes. Distances are negative inside. They are exact, but
for points inside an overlap of several primitives, where a union gives the depth below the
nearest of their surfaces, not below the outer one.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp

from dexsim import rotations
from dexsim.pytree import pytree_dataclass, static

KINDS = ("sphere", "box", "capsule", "cylinder", "ellipsoid")
FAR = 1e3  # m, the distance to a primitive that is switched off
_TINY = 1e-20  # keeps the gradient of a norm finite at zero


@pytree_dataclass
class Shape:
    """A union of K primitives in the object's frame; `kinds` is fixed, all else may be traced."""

    kinds: tuple[str, ...] = static()
    size: jax.Array  # [K, 3] m
    position: jax.Array  # [K, 3] m
    rotation: jax.Array  # [K, 3, 3]
    active: jax.Array  # [K] bool


def sphere(point: jax.Array, size: jax.Array) -> jax.Array:
    return _norm(point) - size[0]


def box(point: jax.Array, size: jax.Array) -> jax.Array:
    q = jnp.abs(point) - size
    return _norm(jnp.maximum(q, 0.0)) + jnp.minimum(jnp.max(q, -1), 0.0)


def capsule(point: jax.Array, size: jax.Array) -> jax.Array:
    z = point[..., 2]
    axial = z - jnp.clip(z, -size[1], size[1])
    return _norm(jnp.stack([point[..., 0], point[..., 1], axial], -1)) - size[0]


def cylinder(point: jax.Array, size: jax.Array) -> jax.Array:
    radial = _norm(point[..., :2]) - size[0]
    axial = jnp.abs(point[..., 2]) - size[1]
    outside = _norm(jnp.stack([jnp.maximum(radial, 0.0), jnp.maximum(axial, 0.0)], -1))
    return outside + jnp.minimum(jnp.maximum(radial, axial), 0.0)


def ellipsoid(point: jax.Array, size: jax.Array) -> jax.Array:
    """Exact distance by Newton's method for the nearest surface point.

    The nearest point is q = s^2 p / (t + s^2) with t the largest root of
    g(t) = sum (s p / (t + s^2))^2 - 1. g is convex and falling there, so Newton from the left
    converges monotonically. The unknown is u = t + min(s)^2: deep inside t is all but -min(s)^2
    and the sum would cancel. The distance n.(p - q), with n and the unit vector q / s held
    fixed, has the exact gradient in point and size (envelope theorem).
    """
    p = jax.lax.stop_gradient(jnp.abs(point)) + 1e-9
    s = jax.lax.stop_gradient(size)
    least = jnp.min(s)
    gap = (s - least) * (s + least)
    # Each term alone must not exceed one at the root, so this start lies left of it.
    u = jnp.max(s * p - gap, axis=-1)
    for _ in range(12):
        shift = u[..., None] + gap
        term = s * p / shift
        value = jnp.sum(term**2, -1) - 1.0
        u = u + 0.5 * value / jnp.sum(term**2 / shift, -1)
    unit = s * p / (u[..., None] + gap)
    normal = unit / s
    normal = normal / _norm(normal)[..., None]
    sign = jnp.where(jax.lax.stop_gradient(point) < 0, -1.0, 1.0)
    return jnp.sum(normal * (sign * point - size * unit), -1)


_DISTANCE: dict[str, Callable[[jax.Array, jax.Array], jax.Array]] = {
    "sphere": sphere, "box": box, "capsule": capsule, "cylinder": cylinder,
    "ellipsoid": ellipsoid,
}


def signed_distance(points: jax.Array, shape: Shape) -> jax.Array:
    """Distance [...] m from `points` [..., 3] (object frame) to the union."""
    distance = None
    for k, kind in enumerate(shape.kinds):
        local = rotations.rotate_inverse(shape.rotation[k], points - shape.position[k])
        d = jnp.where(shape.active[k], _DISTANCE[kind](local, shape.size[k]), FAR)
        distance = d if distance is None else jnp.minimum(distance, d)
    return distance


def distance_and_normal(points: jax.Array, shape: Shape) -> tuple[jax.Array, jax.Array]:
    """Distance [...] m and outward unit normal [..., 3] of the nearest surface, object frame."""
    distance, pullback = jax.vjp(lambda p: signed_distance(p, shape), points)
    (normal,) = pullback(jnp.ones_like(distance))
    return distance, normal


def _norm(vector: jax.Array) -> jax.Array:
    return jnp.sqrt(jnp.sum(vector * vector, -1) + _TINY)
