"""What taxels feel by the method of choice: the paper's surface points against closed forms, in a real environment."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from episodes import reset_to

import dexsim
from dexsim.core.compilation import jit
from dexsim.core.errors import ConfigError
from dexsim.geometry import rotations, surface_points
from dexsim.hand.kinematics import forward_kinematics
from dexsim.objects.config import SHAPES, ObjectConfig
from dexsim.objects.params import sample_object
from dexsim.objects.touch_geometry import touch_geometry
from dexsim.tasks.grasp.config import GraspConfig
from dexsim.touch.feel import feel_links
from dexsim.touch.reduce import reduce_touch_links
from dexsim.touch.skin import Skin

WORLDS, SKIN = 8, Skin(total="solver")
# Means over touching fingers: share of the force that is on other taxels, and distance of the contact centres, m. At
# sharp edges the method itself is coarse: the offset from a face's plane falls short of the distance from its edge.
TOLERANCE = {
    "sphere": (0.02, 1e-4),
    "capsule": (0.02, 1e-4),
    "box": (0.12, 1e-3),
    "cylinder": (0.15, 2.5e-3),
    "mesh": (0.25, 3e-3),
}
PRIMITIVES = ("sphere", "box", "cylinder", "capsule")


@pytest.fixture(scope="module")
def cuboid(tmp_path_factory):
    path = tmp_path_factory.mktemp("meshes") / "cuboid.stl"
    trimesh.creation.box((0.05, 0.044, 0.06)).export(path)
    return str(path)


def gripped(objects):
    """An environment that feels by surface points, and batches of its states [WORLDS] while hands close."""
    config = GraspConfig(objects=objects, pool_size=16, skin=SKIN, touch_method="surface_points")
    env = dexsim.make("grasp", config, backend="c")
    reset, step, states = jit(jax.vmap(reset_to(env)), once=True), jit(jax.vmap(env.step), once=True), []
    # Pools hold one shape after the other: two of each at a time. One batch's means scatter by a half of themselves.
    for batch in range(4):
        rows = jnp.arange(WORLDS) * 2 + batch % 2
        state = reset(jax.random.split(jax.random.key(batch // 2), WORLDS), rows)
        for tick in range(20):
            state = step(state, 0.6 * jnp.ones((WORLDS, 12)))
            if tick >= 8:
                states.append(state)
    return env, states


def closed_forms(env):
    """A function of a state alone: taxel forces [WORLDS, F, N] of the primitives, and the hand's pose."""

    def one(state):
        physics, target, cover = state.physics, state.episode.object, state.episode.hand.pad_thickness_delta
        place = physics.qpos[12:]
        pose = forward_kinematics(env.hand, physics.qpos[:12])
        turn = rotations.quat_to_matrix(place[3:] / jnp.linalg.norm(place[3:]))
        touch = feel_links(env.hand, pose, target.shape(), place[:3], turn, state.finger_force, SKIN, cover=cover)
        return touch.force, pose

    return jit(jax.vmap(one), once=True)


def compare(env, states, kinds):
    """Per kind a row for each touching finger: share of the force on other taxels, error of the centre m."""
    centre = jax.jit(jax.vmap(lambda force, pose: reduce_touch_links(force, env.hand, pose)))
    found, felt = {kind: [] for kind in kinds}, closed_forms(env)
    for state in states:
        wanted, pose = felt(state)
        read = state.taxel_force
        (total, at), (_, place) = centre(wanted, pose), centre(read, pose)
        moved = np.abs(np.asarray(read) - wanted).sum(-1) / 2
        apart = np.linalg.norm(np.asarray(at) - place, axis=-1)
        for world, kind in enumerate(np.asarray(state.episode.object.shape_index)):
            on = (np.asarray(total)[world] > 0.2) & (np.asarray(read)[world].sum(-1) > 0)
            name = SHAPES[kind] if kind < len(SHAPES) else "mesh"
            found[name] += list(np.stack([moved[world] / np.maximum(total[world], 1e-9), apart[world]], -1)[on])
    return {kind: np.array(rows) for kind, rows in found.items()}


@pytest.mark.slow
@pytest.mark.parametrize("kinds", [PRIMITIVES, ("mesh",)], ids=["primitives", "mesh"])
def test_surface_points_feel_what_closed_forms_feel(cuboid, kinds):
    objects = ObjectConfig(mesh=cuboid, mesh_size=(0.9, 1.1)) if kinds == ("mesh",) else ObjectConfig(shapes=kinds)
    for kind, rows in compare(*gripped(objects), kinds).items():
        assert len(rows) > 20 and np.all(rows.mean(0) < TOLERANCE[kind]), (kind, len(rows), rows.mean(0))


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
