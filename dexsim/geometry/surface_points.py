"""The object as oriented surface points, and the nearest of them to every taxel (the paper's method).

With p_o the surface point nearest to a taxel p and n_o its outward normal, the signed distance is (p - p_o) . n_o: the
taxel touches where that is negative (paper, section Sim-to-Real Transfer).

Shapes: N points. Units: m.
"""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from dexsim.core.pytree import Array, pytree_dataclass
from dexsim.geometry import mesh as meshes
from dexsim.geometry import sdf

COUNT = 1024
"""Points of a mesh, or of each primitive of a union."""
_BLOCK = 64  # points compared at a time
_OUT_OF_THE_WAY = 10.0  # m, where a point that does not count is put


@pytree_dataclass
class SurfacePoints:
    """Oriented points in the object's frame."""

    position: jax.Array  # [N, 3] m
    normal: jax.Array  # [N, 3] unit, outward


def from_mesh(mesh: meshes.Mesh, count: int = COUNT) -> SurfacePoints:
    """Evenly spread points of a mesh: of random ones, those farthest from each other, with their faces' normals."""
    position, normal, _ = meshes.sample_surface(mesh, 12 * count, np.random.default_rng(0))
    keep = _spread(position, count)
    return SurfacePoints(jnp.asarray(position[keep], jnp.float32), jnp.asarray(normal[keep], jnp.float32))


def from_shape(shape: sdf.Shape, count: int = COUNT) -> SurfacePoints:
    """`count` points on each primitive of a union, whose sizes and poses may be traced.

    Points inside another primitive, and those of inactive ones, are put out of the way.
    """
    position, normal = [], []
    for k, kind in enumerate(shape.kinds):
        local, out = _TEMPLATES[kind](count, shape.size[k])
        turn = shape.rotation[k]
        place = jnp.einsum("ij,nj->ni", turn, local, precision="highest") + shape.position[k][None]
        buried = jnp.zeros(count, bool)
        for other, name in enumerate(shape.kinds):
            if other != k:
                inside = sdf.to_local(place, shape.position[other], shape.rotation[other])
                buried |= shape.active[other] & (sdf.primitive_distance(name, inside, shape.size[other]) < 0)
        position.append(jnp.where((buried | ~shape.active[k])[:, None], _OUT_OF_THE_WAY, place))
        normal.append(jnp.einsum("ij,nj->ni", turn, out, precision="highest"))
    return SurfacePoints(jnp.concatenate(position), jnp.concatenate(normal))


def scaled(surface: SurfacePoints, factor: jax.Array | float) -> SurfacePoints:
    """The points of an object that is `factor` [] times as large."""
    return dataclasses.replace(surface, position=factor * surface.position)


def signed_distance(points: jax.Array, surface: SurfacePoints) -> jax.Array:
    """Plane offset (p - p_o) . n_o [...] m at points [..., 3]."""
    return distance_and_normal(points, surface)[0]


def distance_and_normal(points: jax.Array, surface: SurfacePoints) -> tuple[jax.Array, jax.Array]:
    """Plane offset [...] m and the nearest point's normal [..., 3]; the choice of point has no gradient."""
    index = nearest(points, surface)
    position, normal = surface.position[index], surface.normal[index]
    parts = [(points[..., k] - position[..., k]) * normal[..., k] for k in range(3)]
    return parts[0] + parts[1] + parts[2], normal


def nearest(points: jax.Array, surface: SurfacePoints) -> jax.Array:
    """Index [...] int32 of the nearest surface point.

    Least |q|^2 / 2 - p . q over all points q, which is least where |p - q| is. The block is unrolled: one step is one
    elementwise kernel that reads and writes one score and one index a taxel.
    """
    points, surface = jax.lax.stop_gradient(points), jax.lax.stop_gradient(surface)
    x, y, z = (points[..., k] for k in range(3))
    count = surface.position.shape[0]
    spare = -count % _BLOCK
    table = jnp.concatenate([surface.position, 0.5 * jnp.sum(surface.position**2, -1, keepdims=True)], -1)
    filler = jnp.array([[0.0, 0.0, 0.0, jnp.inf]], table.dtype)
    blocks = jnp.concatenate([table, jnp.repeat(filler, spare, 0)]).reshape(-1, _BLOCK, 4)

    def step(carry, block):
        best, index, start = carry
        for k in range(_BLOCK):
            score = block[k, 3] - (x * block[k, 0] + y * block[k, 1] + z * block[k, 2])
            better = score < best
            best, index = jnp.where(better, score, best), jnp.where(better, start + k, index)
        return (best, index, start + _BLOCK), None

    start = (jnp.full(x.shape, jnp.inf, jnp.result_type(x, table)), jnp.zeros(x.shape, jnp.int32), jnp.int32(0))
    return jax.lax.scan(step, start, blocks)[0][1]


def _spread(position: np.ndarray, count: int) -> np.ndarray:
    """Indices of `count` points that are far from each other: farthest-point sampling."""
    chosen = np.empty(count, int)
    chosen[0] = 0
    gap = np.full(len(position), np.inf)
    for k in range(1, count):
        np.minimum(gap, np.sum((position - position[chosen[k - 1]]) ** 2, 1), out=gap)
        chosen[k] = gap.argmax()
    return chosen


def _fibonacci(count: int) -> np.ndarray:
    """Directions [count, 3] spread evenly over the sphere."""
    z = 1 - (2 * np.arange(count) + 1) / count
    turn = np.arange(count) * np.pi * (3 - np.sqrt(5))
    return np.stack([np.sqrt(1 - z * z) * np.cos(turn), np.sqrt(1 - z * z) * np.sin(turn), z], -1).astype(np.float32)


def _sphere_points(count: int, size: Array) -> tuple[jax.Array, jax.Array]:
    out = jnp.asarray(_fibonacci(count))
    return size[0] * out, out


def _capsule_points(count: int, size: Array) -> tuple[jax.Array, jax.Array]:
    """Even along the axis with the share of area on tube and caps (both have 2 pi r per unit of height)."""
    radius, half = size[0], size[1]
    height = (half + radius) * jnp.asarray(_fibonacci(count)[:, 2])
    over = jnp.sign(height) * jnp.maximum(jnp.abs(height) - half, 0.0)
    sine = over / radius
    turn = jnp.asarray(np.arange(count) * np.pi * (3 - np.sqrt(5)), jnp.float32)
    cosine = jnp.sqrt(jnp.maximum(1 - sine**2, 0.0))
    out = jnp.stack([cosine * jnp.cos(turn), cosine * jnp.sin(turn), sine], -1)
    return radius * out + jnp.stack([0 * turn, 0 * turn, height - over], -1), out


def _cylinder_points(count: int, size: Array) -> tuple[jax.Array, jax.Array]:
    """Half of them on the side, a quarter on each end (sunflower pattern)."""
    side, end = count - 2 * (count // 4), count // 4
    golden = np.pi * (3 - np.sqrt(5))
    turn = jnp.asarray(np.arange(side) * golden, jnp.float32)
    rise = jnp.asarray((2 * np.arange(side) + 1) / side - 1, jnp.float32)
    round_ = jnp.stack([jnp.cos(turn), jnp.sin(turn), 0 * turn], -1)
    angle = np.arange(end) * golden
    disc = np.sqrt((np.arange(end) + 0.5) / end)[:, None] * np.stack([np.cos(angle), np.sin(angle), 0 * angle], -1)
    disc, up = jnp.asarray(disc, jnp.float32), jnp.array([[0.0, 0.0, 1.0]])
    side_points = size[0] * round_ + (size[1] * rise)[:, None] * up
    position = jnp.concatenate([side_points, size[0] * disc + size[1] * up, size[0] * disc - size[1] * up])
    return position, jnp.concatenate([round_, jnp.tile(up, (end, 1)), jnp.tile(-up, (end, 1))])


def _box_points(count: int, size: Array) -> tuple[jax.Array, jax.Array]:
    """A sixth on each face, in a low-discrepancy pattern (Roberts 2018) in units of the half-extents."""
    face = np.arange(count) % 6
    order = np.arange(count) // 6
    flat = 2 * np.stack([(0.5 + 0.7548776662 * order) % 1, (0.5 + 0.5698402910 * order) % 1], -1) - 1
    axis, side = face // 2, 2.0 * (face % 2) - 1
    unit, out = np.zeros((count, 3)), np.zeros((count, 3))
    rows = np.arange(count)
    unit[rows, axis] = out[rows, axis] = side
    unit[rows, (axis + 1) % 3], unit[rows, (axis + 2) % 3] = flat[:, 0], flat[:, 1]
    return jnp.asarray(unit, jnp.float32) * size[None], jnp.asarray(out, jnp.float32)


_TEMPLATES = {
    "sphere": _sphere_points,
    "box": _box_points,
    "capsule": _capsule_points,
    "cylinder": _cylinder_points,
}
