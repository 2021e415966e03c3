"""Signed distances against the nearest point of a densely searched surface."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dexsim.geometry import sdf

EYE = np.eye(3, dtype=np.float32)
SIZES = {
    "sphere": (0.031, 0, 0),
    "box": (0.02, 0.035, 0.012),
    "capsule": (0.013, 0.022, 0),
    "cylinder": (0.024, 0.017, 0),
}


# --- an independent reference: the surface in patches, float64 -----------------------------------


def radial(points, radius, height):
    """Points at this distance from the z axis, in the direction in which `points` lie."""
    across = points[:, :2] / np.maximum(np.linalg.norm(points[:, :2], axis=1, keepdims=True), 1e-300)
    across = np.where(np.linalg.norm(across, axis=1, keepdims=True) > 0.5, across, [1.0, 0.0])
    return np.column_stack([across * np.reshape(radius, (-1, 1)), np.broadcast_to(height, len(points))])


def ball(points, centre, radius):
    seen = points - centre
    length = np.linalg.norm(seen, axis=1, keepdims=True)
    out = [0.0, 0.0, -1.0 if centre[2] < 0 else 1.0]
    return centre + radius * np.where(length > 0, seen / np.maximum(length, 1e-300), out)


def nearest_point(kind, size, points):
    """The nearest point [P, 3] of the surface: of the nearest points of each of its patches, the nearest."""
    a, b, _ = (float(s) for s in size)
    across = np.linalg.norm(points[:, :2], axis=1)
    if kind == "sphere":
        patches = [ball(points, np.zeros(3), a)]
    elif kind == "box":
        patches = []
        for axis in range(3):
            for side in (-1, 1):
                face = np.clip(points, -np.asarray(size, float), size)
                face[:, axis] = side * size[axis]
                patches.append(face)
    elif kind == "cylinder":
        patches = [
            radial(points, np.full(len(points), a), np.clip(points[:, 2], -b, b)),
            radial(points, np.minimum(across, a), b),
            radial(points, np.minimum(across, a), -b),
        ]
    else:  # capsule; beyond the tube's ends only the half of a ball that looks outwards is surface
        patches = [radial(points, np.full(len(points), a), np.clip(points[:, 2], -b, b))]
        for side in (-1, 1):
            cap = ball(points, np.array([0, 0, side * b]), a)
            patches.append(np.where(side * cap[:, 2:] >= b, cap, np.inf))
    gap = np.linalg.norm(points - np.array(patches), axis=-1)
    return np.array(patches)[gap.argmin(0), np.arange(len(points))]


def is_inside(kind, size, points):
    a, b, _ = size
    across, z = np.linalg.norm(points[:, :2], axis=1), np.abs(points[:, 2])
    return {
        "sphere": lambda: np.hypot(across, z) < a,
        "box": lambda: np.all(np.abs(points) < size, axis=1),
        "cylinder": lambda: (across < a) & (z < b),
        "capsule": lambda: np.hypot(across, np.maximum(z - b, 0)) < a,
    }[kind]()


def reference(kind, size, points):
    gap = np.linalg.norm(points - nearest_point(kind, size, points), axis=-1)
    return np.where(is_inside(kind, size, points), -gap, gap)


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
    count, at = len(sdf.KINDS), sdf.KINDS.index(kind)
    sizes = np.full((count, 3), 1e-4, np.float32)
    sizes[at] = size
    return sdf.Shape(
        sdf.KINDS,
        sizes,
        np.tile(np.float32(position), (count, 1)),
        np.tile(np.float32(rotation), (count, 1, 1)),
        np.arange(count) == at,
    )


def random_rotation(rng):
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    return turn * np.sign(np.linalg.det(turn))


distance = jax.jit(sdf.signed_distance)
distance_and_normal = jax.jit(sdf.distance_and_normal)


# --- single primitives ---------------------------------------------------------------------------


@pytest.mark.parametrize(("kind", "size"), SIZES.items())
def test_distance_to_the_nearest_surface_point(kind, size):
    points = probes(size)
    wanted = reference(kind, size, points.astype(float))
    assert (wanted < -1e-3).sum() > 10 and (wanted > 1e-3).sum() > 10
    np.testing.assert_allclose(distance(points, one(kind, size)), wanted, atol=2e-6)


@pytest.mark.parametrize("kind", sdf.KINDS)
def test_normals_are_unit_and_point_from_the_nearest_point(kind):
    points = probes(SIZES[kind], seed=2).astype(float)
    nearest = nearest_point(kind, SIZES[kind], points)
    gap = np.linalg.norm(points - nearest, axis=1, keepdims=True)
    _, normal = distance_and_normal(points.astype(np.float32), one(kind, SIZES[kind]))
    outside = ~is_inside(kind, SIZES[kind], points)
    far = outside & (gap[:, 0] > 1e-3)
    assert far.sum() > 50
    np.testing.assert_allclose(np.linalg.norm(normal, axis=1)[outside], 1.0, atol=1e-5)
    np.testing.assert_allclose(np.asarray(normal)[far], ((points - nearest) / gap)[far], atol=2e-3)


@pytest.mark.parametrize("kind", sdf.KINDS)
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


# --- unions ----------------------------------------------------------------------------------------


def posed_union(seed):
    """Three overlapping primitives at random poses, and a fourth far away, as arrays and as a `Shape`."""
    rng = np.random.default_rng(seed)
    kinds = ("box", "capsule", "sphere", "cylinder")
    size = np.array([SIZES[k] for k in kinds])
    position = rng.uniform(-0.02, 0.02, (4, 3))
    position[3] += 0.2
    rotation = np.stack([random_rotation(rng) for _ in kinds])
    shape = sdf.Shape(kinds, *(jnp.asarray(x, jnp.float32) for x in (size, position, rotation)), jnp.ones(4, bool))
    return kinds, size, position, rotation, shape


@pytest.mark.parametrize("seed", range(2))
def test_a_union_is_the_nearest_of_its_primitives(seed):
    kinds, size, position, rotation, shape = posed_union(seed)
    probe = np.random.default_rng(seed + 10).uniform(-0.09, 0.09, (400, 3)).astype(np.float32)
    wanted = np.min(
        [reference(kind, size[k], (probe - position[k]) @ rotation[k]) for k, kind in enumerate(kinds)], axis=0
    )
    assert (wanted < 0).sum() > 3
    np.testing.assert_allclose(distance(probe, shape), wanted, atol=1e-5)
