"""What taxels feel by the method of choice: the paper's surface points against closed forms, in a real environment."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh

from dexsim.core.errors import ConfigError
from dexsim.geometry import surface_points
from dexsim.objects.config import ObjectConfig
from dexsim.objects.params import sample_object
from dexsim.objects.touch_geometry import touch_geometry
from dexsim.touch.skin import Skin

WORLDS, SKIN = 8, Skin(total="solver")
# Means over touching fingers: share of the force that is on other taxels, and distance of the contact centres, m. At
# sharp edges the method itself is coarse: the offset from a face's plane falls short of the distance from its edge.


@pytest.fixture(scope="module")
def cuboid(tmp_path_factory):
    path = tmp_path_factory.mktemp("meshes") / "cuboid.stl"
    trimesh.creation.box((0.05, 0.044, 0.06)).export(path)
    return str(path)


def test_a_grid_needs_a_mesh():
    with pytest.raises(ConfigError, match="needs a mesh"):
        touch_geometry(ObjectConfig(), "grid")


@pytest.mark.slow
def test_sizes_are_the_episodes_own_under_jit_and_vmap(cuboid):
    """A point of the surface is at no distance from it, at every drawn size."""
    config = ObjectConfig(mesh=cuboid, mesh_size=(0.8, 1.2))
    geometry = touch_geometry(config, "surface_points")
    factors = jnp.array([0.8, 1.0, 1.2])
    whole = geometry(_sized(config, 1.0))
    on_surface = factors[:, None, None] * whole.position
    distance = jax.jit(
        jax.vmap(lambda points, factor: surface_points.signed_distance(points, geometry(_sized(config, factor))))
    )(on_surface, factors)
    np.testing.assert_allclose(distance, 0.0, atol=1e-6)


def _sized(config, factor):
    target = sample_object(jax.random.key(0), config)
    return dataclasses.replace(target, size=factor * jnp.asarray(config.largest) / config.mesh_size[1])
