"""Signed distances against C MuJoCo's, of a small ball from a geom."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dexsim.geometry import sdf
from dexsim.geometry.distance import distance_and_normal as measure

EYE = np.eye(3, dtype=np.float32)
KINDS = tuple(sdf.DISTANCE)
SIZES = {
    "sphere": (0.031, 0, 0),
    "box": (0.02, 0.035, 0.012),
    "capsule": (0.013, 0.022, 0),
    "cylinder": (0.024, 0.017, 0),
}
BALL = 1e-4  # m


def reference(kind, size, points):
    """Distance [P] of points [P, 3], and the way [P, 3] from the nearest surface point, in C MuJoCo."""
    spec = mujoco.MjSpec()
    spec.worldbody.add_geom(type=getattr(mujoco.mjtGeom, f"mjGEOM_{kind.upper()}"), size=size)
    probe = spec.worldbody.add_body(mocap=True)
    probe.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[BALL, 0, 0])
    model = spec.compile()
    data, found, segment = mujoco.MjData(model), [], np.zeros(6)
    for point in points:
        data.mocap_pos[0] = point
        mujoco.mj_kinematics(model, data)
        distance = mujoco.mj_geomDistance(model, data, 0, 1, 1.0, segment) + BALL
        found.append([distance, *(segment[3:] - segment[:3])])
    return np.array(found)[:, 0], np.array(found)[:, 1:]


def probes(size, count=150, seed=0):
    """Points inside, near and outside, on axes and on symmetry planes, and the centre."""
    rng = np.random.default_rng(seed)
    reach = np.where(np.array(size) > 0, size, max(size))
    points = reach * rng.uniform(-2.2, 2.2, (count, 3))
    points[: count // 3] *= 0.3
    points[::5, rng.integers(3)] = 0
    points[1::10, :2] = 0
    points[2::10, 1:] = 0
    points[3::10, 2] *= 1e-6
    points[0] = 0
    return points.astype(np.float32)


def one(kind, size, position=(0, 0, 0), rotation=EYE):
    """A single primitive. All kinds are there and the others switched off, so that all share a compilation."""
    count, at = len(KINDS), KINDS.index(kind)
    sizes = np.full((count, 3), 1e-4, np.float32)
    sizes[at] = size
    return sdf.Shape(
        KINDS,
        sizes,
        np.tile(np.float32(position), (count, 1)),
        np.tile(np.float32(rotation), (count, 1, 1)),
        np.arange(count) == at,
    )


distance = jax.jit(sdf.signed_distance)
distance_and_normal = jax.jit(measure)


@pytest.mark.parametrize(("kind", "size"), SIZES.items())
def test_distance_and_outward_normal(kind, size):
    points = probes(size)
    wanted, way = reference(kind, size, points.astype(float))
    assert (wanted < -1e-3).sum() > 10 and (wanted > 1e-3).sum() > 10
    found, normal = distance_and_normal(points, one(kind, size))
    np.testing.assert_allclose(found, wanted, atol=2e-6)
    np.testing.assert_allclose(distance(points, one(kind, size)), found, atol=1e-7)
    far = wanted > 1e-3
    np.testing.assert_allclose(np.linalg.norm(normal, axis=1)[wanted > 0], 1.0, atol=1e-5)
    np.testing.assert_allclose(np.asarray(normal)[far], (way / np.linalg.norm(way, axis=1)[:, None])[far], atol=2e-3)


@pytest.mark.parametrize("kind", KINDS)
def test_gradients_are_finite_at_the_centre_and_on_the_axes(kind):
    size = np.array(SIZES[kind])
    points = np.concatenate([np.zeros((1, 3)), 0.01 * EYE, -0.05 * EYE, np.diag(size)]).astype(np.float32)
    for gradient in pose_gradients(points, one(kind, size)):
        assert np.all(np.isfinite(gradient))


@jax.jit
def pose_gradients(points, shape):
    """Gradient of the sum of distances in points, sizes, positions and rotations."""

    def total(points, size, position, rotation):
        return jnp.sum(sdf.signed_distance(points, sdf.Shape(shape.kinds, size, position, rotation, shape.active)))

    return jax.grad(total, argnums=(0, 1, 2, 3))(points, shape.size, shape.position, shape.rotation)


def test_a_union_is_the_nearest_of_its_primitives():
    """Three overlapping primitives at random poses, and a fourth far away."""
    rng, kinds = np.random.default_rng(0), ("box", "capsule", "sphere", "cylinder")
    size, position = np.array([SIZES[k] for k in kinds]), rng.uniform(-0.02, 0.02, (4, 3))
    position[3] += 0.2
    rotation = Rotation.random(4, random_state=0).as_matrix()
    shape = sdf.Shape(kinds, *(jnp.asarray(x, jnp.float32) for x in (size, position, rotation)), jnp.ones(4, bool))
    probe = rng.uniform(-0.09, 0.09, (400, 3)).astype(np.float32)
    wanted = np.min(
        [reference(kind, size[k], (probe - position[k]) @ rotation[k])[0] for k, kind in enumerate(kinds)], axis=0
    )
    assert (wanted < 0).sum() > 3
    np.testing.assert_allclose(distance(probe, shape), wanted, atol=1e-5)
