"""The object as oriented surface points, and the nearest of them to every taxel (the paper's method).

With p_o the surface point nearest to a taxel p and n_o its outward normal, the signed distance is (p - p_o) . n_o: the
taxel touches where that is negative (paper, section Sim-to-Real Transfer).

Shapes: N points. Units: m.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np

from dexsim.core.pytree import pytree_dataclass
from dexsim.geometry import mesh as meshes, sdf

COUNT = 1024
"""Points of a mesh, or of each primitive of a union."""
_BLOCK = 64  # points compared at a time
_OUT_OF_THE_WAY = 10.0  # m, where a point that does not count is put
_SKIN = 0.1  # depth of the random points in a primitive of size 1 that are moved to its surface


@pytree_dataclass
class SurfacePoints:
    """Oriented points in the object's frame."""

    position: jax.Array  # [N, 3] m
    normal: jax.Array  # [N, 3] unit, outward


def from_mesh(mesh: meshes.Trimesh, count: int = COUNT) -> SurfacePoints:
    """Evenly spread points of a mesh: of random ones, those farthest from each other, with their faces' normals."""
    position, normal = meshes.sample_surface(mesh, 12 * count, np.random.default_rng(0))
    keep = _spread(position, count)
    return SurfacePoints(jnp.asarray(position[keep], jnp.float32), jnp.asarray(normal[keep], jnp.float32))


def from_shape(shape: sdf.Shape, count: int = COUNT) -> SurfacePoints:
    """`count` points on each primitive of a union, whose sizes and poses may be traced.

    Points inside another primitive, and those of inactive ones, are put out of the way.
    """
    position, normal = [], []
    for k, kind in enumerate(shape.kinds):
        unit, out = _template(kind, count)
        local = sum(shape.size[k][axis] * unit[axis] for axis in range(3))
        turn = shape.rotation[k]
        place = jnp.einsum("ij,nj->ni", turn, local, precision="highest") + shape.position[k][None]
        buried = jnp.zeros(count, bool)
        for other, name in enumerate(shape.kinds):
            if other != k:
                inside = sdf.to_local(place, shape.position[other], shape.rotation[other])
                buried |= shape.active[other] & (sdf.DISTANCE[name](inside, shape.size[other]) < 0)
        position.append(jnp.where((buried | ~shape.active[k])[:, None], _OUT_OF_THE_WAY, place))
        normal.append(jnp.einsum("ij,nj->ni", turn, out, precision="highest"))
    return SurfacePoints(jnp.concatenate(position), jnp.concatenate(normal))


def signed_distance(points: jax.Array, surface: SurfacePoints) -> jax.Array:
    """Plane offset (p - p_o) . n_o [...] m at points [..., 3]; the choice of point has no gradient."""
    index = nearest(points, surface)
    position, normal = surface.position[index], surface.normal[index]
    parts = [(points[..., k] - position[..., k]) * normal[..., k] for k in range(3)]
    return parts[0] + parts[1] + parts[2]


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


@functools.cache
def _template(kind: str, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Points spread evenly on a primitive whose sizes are 1: what each of its sizes adds to them [3, count, 3], and
    their normals [count, 3], which are the same at all sizes."""
    rng, one = np.random.default_rng(0), np.ones((1, 3), np.float32)
    shape = sdf.Shape((kind,), one, 0 * one, np.eye(3, dtype=np.float32)[None], np.ones(1, bool))
    with jax.ensure_compile_time_eval():  # the first call may be inside of a trace
        points = rng.uniform(-1, 1, (60 * count, 3)).astype(np.float32) * [1, 1, 2 if kind == "capsule" else 1]
        measure = jax.vmap(jax.value_and_grad(lambda point: sdf.signed_distance(point, shape)))
        distance, normal = map(np.asarray, measure(points.astype(np.float32)))
        below = np.flatnonzero((distance > -_SKIN) & (distance < 0))
    points, normal = (points - distance[:, None] * normal)[below], normal[below]
    keep = _spread(points, count)
    points, normal = points[keep].astype(np.float32), normal[keep]
    if kind == "box":
        return np.eye(3, dtype=np.float32)[:, None] * points, normal
    height = points[:, 2] * (kind == "cylinder") + np.clip(points[:, 2], -1, 1) * (kind == "capsule")
    axial = height[:, None] * np.array([0, 0, 1], np.float32)
    return np.stack([points - axial, axial, 0 * axial]), normal
