"""Distance by name: one signature, `(points, object) -> distance, normal`, whatever the object is made of.

    geometry = grid.bake(mesh.load_mesh("mug.stl", scale=0.001))
    geometry = surface_points.from_shape(shape)
    distance, normal = distance_and_normal(points, geometry)

| method | object | cost a query | error |
|---|---|---|---|
| `closed_form` | `sdf.Shape` | 20-50 FLOP a primitive | exact |
| `grid` | `grid.Grid` | one read of 32 bytes | 64 nodes: 1.5 to 6 um mean on smooth shapes |
| `surface_points` | `surface_points.SurfacePoints` | all points | 30 um mean with 1024 points |
"""

from typing import Any

import jax

from dexsim.core.pytree import Array
from dexsim.geometry import grid, sdf, surface_points

METHODS = ("closed_form", "grid", "surface_points")
_MODULES: dict[type, Any] = {sdf.Shape: sdf, grid.Grid: grid, surface_points.SurfacePoints: surface_points}


def signed_distance(points: Array, geometry: Any) -> jax.Array:
    """Distance [...] m, negative inside, at points [..., 3] in the object's frame."""
    return _MODULES[type(geometry)].signed_distance(points, geometry)


def distance_and_normal(points: Array, geometry: Any) -> tuple[jax.Array, jax.Array]:
    """Distance [...] m and outward unit normal [..., 3] at points [..., 3] in the object's frame."""
    return _MODULES[type(geometry)].distance_and_normal(points, geometry)
