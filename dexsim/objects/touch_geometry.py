"""What the taxels feel of an object: its geometry in the form that one of the distance methods works on."""

from collections.abc import Callable
from typing import Any

import jax

from dexsim.core.errors import ConfigError
from dexsim.geometry import grid, surface_points
from dexsim.objects.config import ObjectConfig, load_mesh_object
from dexsim.objects.params import ObjectParams


def touch_geometry(config: ObjectConfig, method: str) -> Callable[[ObjectParams], Any]:
    """A pure function from one episode's object to its geometry, as `dexsim.geometry.distance` takes it.

    The method is closed_form (the solver's primitives), grid (the mesh, baked) or surface_points (points on the mesh,
    or on the primitives at their drawn sizes).

    Raises:
      AssetError: the mesh cannot be baked.
      ConfigError: a grid of primitives, whose sizes are drawn anew in every episode.
    """
    if method == "closed_form":
        return ObjectParams.shape
    if not config.mesh:
        if method == "grid":
            raise ConfigError(
                "touch_method = 'grid': needs a mesh (ObjectConfig.mesh); choose closed_form or surface_points"
            )
        return lambda object: surface_points.from_shape(object.shape())
    mesh_object = load_mesh_object(config)
    edge = mesh_object.boxes.size[0, 0]
    with jax.ensure_compile_time_eval():
        if method == "grid":
            baked = grid.bake(mesh_object.mesh)
            return lambda object: grid.scaled(baked, object.size[0, 0] / edge)
        points = surface_points.from_mesh(mesh_object.mesh)
    return lambda object: surface_points.scaled(points, object.size[0, 0] / edge)
