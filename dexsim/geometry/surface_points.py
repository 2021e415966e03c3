"""The object as oriented surface points, and the nearest of them to every taxel (the paper's method).

With p_o the surface point nearest to a taxel p and n_o its outward normal, the signed distance is (p - p_o) . n_o: the
taxel touches where that is negative (paper, section Sim-to-Real Transfer).

Two searches for the nearest point give the same answer. The scan holds a block of points in the program's registers
at a time and keeps, per taxel, the best so far: taxels x points never reaches memory, and positions may be traced. The
table lists for every cell of a lattice round the object all points that can be nearest to anything in the cell, so
that a taxel is compared with a dozen points instead of all; it is built beforehand, for points that do not change.

Shapes: N points, n cells along each axis. Units: m.
"""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from dexsim.core.config import setting, validate
from dexsim.core.errors import ConfigError
from dexsim.core.pytree import Array, pytree_dataclass, static
from dexsim.geometry import mesh as meshes
from dexsim.geometry import sdf

_ROUND = 4  # candidates of the table compared at a time
_OUT_OF_THE_WAY = 10.0  # m, where a point that does not count is put


@dataclasses.dataclass(frozen=True, kw_only=True)
class PointsConfig:
    """How an object is turned into points."""

    count: int = setting(1024, unit="1", low=16, high=16384)
    """Points in all; per primitive, where the object is a union."""
    block: int = setting(64, unit="1", low=4, high=256)
    """Points compared at a time."""
    table: bool = setting(True)
    """Build the table of candidates where the points are known beforehand."""
    cells: int = setting(48, unit="1", low=8, high=128)
    """Cells of the table along each axis."""
    reach: float = setting(0.006, unit="m", low=0.001, high=0.05)
    """How far from the surface the table holds all candidates; farther off it may return the
    second nearest point."""

    def __post_init__(self):
        validate(self)


@pytree_dataclass
class SurfacePoints:
    """Oriented points in the object's frame, with or without a table."""

    block: int = static()
    cells: int = static()  # 0: no table
    position: jax.Array  # [N, 3] m
    normal: jax.Array  # [N, 3] unit, outward
    table: jax.Array  # [n^3, K] int16, or int32 where there are more: indices of points
    origin: jax.Array  # [3] m, corner of the table
    spacing: jax.Array  # [3] m, size of its cells


def from_mesh(mesh: meshes.Mesh, config: PointsConfig | None = None) -> SurfacePoints:
    """Evenly spread points of a mesh: of random ones, those farthest from each other, with their faces' normals."""
    config = config or PointsConfig()
    position, normal, _ = meshes.sample_surface(mesh, 12 * config.count, np.random.default_rng(0))
    keep = _spread(position, config.count)
    return _build(jnp.asarray(position[keep], jnp.float32), jnp.asarray(normal[keep], jnp.float32), config)


def from_shape(shape: sdf.Shape, config: PointsConfig | None = None) -> SurfacePoints:
    """`count` points on each primitive of a union, whose sizes and poses may be traced (then without a table).

    Points inside another primitive, and those of inactive ones, are put out of the way.
    """
    config = config or PointsConfig()
    position, normal = [], []
    for k, kind in enumerate(shape.kinds):
        local, out = _TEMPLATES[kind](config.count, shape.size[k])
        turn = shape.rotation[k]
        place = jnp.einsum("ij,nj->ni", turn, local, precision="highest") + shape.position[k][None]
        buried = jnp.zeros(config.count, bool)
        for other, name in enumerate(shape.kinds):
            if other != k:
                seen = sdf.to_local(place, shape.position[other], shape.rotation[other])
                buried |= shape.active[other] & (sdf.primitive_distance(name, seen, shape.size[other]) < 0)
        position.append(jnp.where((buried | ~shape.active[k])[:, None], _OUT_OF_THE_WAY, place))
        normal.append(jnp.einsum("ij,nj->ni", turn, out, precision="highest"))
    return _build(jnp.concatenate(position), jnp.concatenate(normal), config)


def scaled(surface: SurfacePoints, factor: jax.Array | float) -> SurfacePoints:
    """The points of an object that is `factor` [] times as large; their table stays valid."""
    return dataclasses.replace(
        surface,
        position=factor * surface.position,
        origin=factor * surface.origin,
        spacing=factor * surface.spacing,
    )


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
    """Index [...] int32 of the nearest surface point."""
    points = jax.lax.stop_gradient(points)
    surface = jax.lax.stop_gradient(surface)
    return _from_table(points, surface) if surface.cells else _scan(points, surface)


def _scan(points: jax.Array, surface: SurfacePoints) -> jax.Array:
    """Least |q|^2 / 2 - p . q over all points q, which is least where |p - q| is.

    The block is unrolled, so one step is one elementwise kernel that reads and writes one score and one index a taxel.
    """
    x, y, z = (points[..., k] for k in range(3))
    count = surface.position.shape[0]
    spare = -count % surface.block
    table = jnp.concatenate([surface.position, 0.5 * jnp.sum(surface.position**2, -1, keepdims=True)], -1)
    filler = jnp.array([[0.0, 0.0, 0.0, jnp.inf]], table.dtype)
    blocks = jnp.concatenate([table, jnp.repeat(filler, spare, 0)]).reshape(-1, surface.block, 4)

    def step(carry, block):
        best, index, start = carry
        for k in range(surface.block):
            score = block[k, 3] - (x * block[k, 0] + y * block[k, 1] + z * block[k, 2])
            better = score < best
            best, index = jnp.where(better, score, best), jnp.where(better, start + k, index)
        return (best, index, start + surface.block), None

    start = (jnp.full(x.shape, jnp.inf, jnp.result_type(x, table)), jnp.zeros(x.shape, jnp.int32), jnp.int32(0))
    return jax.lax.scan(step, start, blocks)[0][1]


def _from_table(points: jax.Array, surface: SurfacePoints) -> jax.Array:
    n, cell = surface.cells, []
    for axis in range(3):
        at = (points[..., axis] - surface.origin[axis]) / surface.spacing[axis]
        cell.append(jnp.clip(at, 0, n - 1).astype(jnp.int32))
    row = (cell[0] * n + cell[1]) * n + cell[2]

    def step(start, carry):
        best, index = carry
        for k in range(_ROUND):
            candidate = surface.table.at[row, start * _ROUND + k].get(mode="promise_in_bounds").astype(jnp.int32)
            place = surface.position.at[candidate].get(mode="promise_in_bounds")
            gap = sum((points[..., axis] - place[..., axis]) ** 2 for axis in range(3))
            better = gap < best
            best, index = jnp.where(better, gap, best), jnp.where(better, candidate, index)
        return best, index

    start = (jnp.full(row.shape, jnp.inf, points.dtype), jnp.zeros(row.shape, jnp.int32))
    return jax.lax.fori_loop(0, surface.table.shape[1] // _ROUND, step, start)[1]


def _build(position: jax.Array, normal: jax.Array, config: PointsConfig) -> SurfacePoints:
    known = config.table and not isinstance(position, jax.core.Tracer)
    cells, table, origin, spacing = 0, np.zeros((1, 1)), np.zeros(3), np.ones(3)
    if known:
        cells = config.cells
        table, origin, spacing = _candidates(np.asarray(position, np.float64), config)
    return SurfacePoints(
        config.block,
        cells,
        position,
        normal,
        jnp.asarray(table, jnp.int16 if table.max() < 2**15 else jnp.int32),
        jnp.asarray(origin, jnp.float32),
        jnp.asarray(spacing, jnp.float32),
    )


def _candidates(position: np.ndarray, config: PointsConfig) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """For every cell the points that can be nearest to anything in it, as [n^3, K].

    By the triangle inequality those are the points no farther from the cell's middle than the nearest one and a whole
    diagonal. Outside of the lattice a point is looked up in the nearest cell.
    """
    from scipy.spatial import cKDTree

    real = np.flatnonzero(position[:, 0] < _OUT_OF_THE_WAY / 2)
    if not real.size:
        raise ConfigError("surface points: no active primitive")
    low, high = position[real].min(0) - config.reach, position[real].max(0) + config.reach
    spacing = (high - low) / config.cells
    axes = [a + h * (np.arange(config.cells) + 0.5) for a, h in zip(low, spacing, strict=True)]
    middle = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
    tree = cKDTree(position[real])
    diagonal = float(np.linalg.norm(spacing)) * 1.001
    width = 8
    while True:  # the longest list that a cell near the surface needs
        width = min(width, len(real))
        gap, index = tree.query(middle, k=width, workers=-1)
        gap, index = gap.reshape(len(middle), -1), index.reshape(len(middle), -1)
        close = gap[:, 0] <= config.reach
        if width == len(real) or not np.any(gap[close, -1] <= gap[close, 0] + diagonal):
            break
        width *= 2
    longest = int(np.max(np.sum(gap[close] <= gap[close, :1] + diagonal, 1)))
    longest = min(-(-longest // _ROUND) * _ROUND, width)
    table = real[index[:, :longest]]
    spare = np.repeat(table[:, :1], -longest % _ROUND, axis=1)
    return np.concatenate([table, spare], 1), low, spacing


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


def _ellipsoid_points(count: int, size: Array) -> tuple[jax.Array, jax.Array]:
    unit = jnp.asarray(_fibonacci(count))
    out = unit / size[None]
    return unit * size[None], out / jnp.linalg.norm(out, axis=-1, keepdims=True)


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
    disc = np.sqrt((np.arange(end) + 0.5) / end)[:, None] * np.stack(
        [np.cos(np.arange(end) * golden), np.sin(np.arange(end) * golden)], -1
    )
    disc = jnp.asarray(np.concatenate([disc, np.zeros((end, 1))], 1), jnp.float32)
    up = jnp.array([[0.0, 0.0, 1.0]])
    position = [
        size[0] * round_ + (size[1] * rise)[:, None] * up,
        size[0] * disc + size[1] * up,
        size[0] * disc - size[1] * up,
    ]
    return jnp.concatenate(position), jnp.concatenate([round_, jnp.tile(up, (end, 1)), jnp.tile(-up, (end, 1))])


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
    "ellipsoid": _ellipsoid_points,
}
