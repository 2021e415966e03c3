"""Distance by name: one signature, `(points, object) -> distance, normal`, whatever the object is made of.

geometry = grid.bake(mesh.load_mesh("mug.stl", scale=0.001))
geometry = surface_points.from_shape(shape)
distance, normal = distance_and_normal(points, geometry)
"""

from typing import Any

import jax
import jax.numpy as jnp

from dexsim.core.pytree import Array
from dexsim.geometry import grid, sdf, surface_points

METHODS = ("closed_form", "grid", "surface_points")
_MODULES: dict[type, Any] = {sdf.Shape: sdf, grid.Grid: grid, surface_points.SurfacePoints: surface_points}


def signed_distance(points: Array, geometry: Any) -> jax.Array:
    """Distance [...] m, negative inside, at points [..., 3] in the object's frame."""
    return _MODULES[type(geometry)].signed_distance(points, geometry)


def distance_and_normal(points: Array, geometry: Any) -> tuple[jax.Array, jax.Array]:
    """Distance [...] m and outward unit normal [..., 3], its gradient, at points [..., 3] in the object's frame."""
    distance, pullback = jax.vjp(lambda points: signed_distance(points, geometry), jnp.asarray(points))
    (slope,) = pullback(jnp.ones_like(distance))
    return distance, slope / jnp.sqrt(jnp.sum(slope**2, -1, keepdims=True) + 1e-20)
