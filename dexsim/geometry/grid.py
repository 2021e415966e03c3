"""Signed-distance grids: baked once from any closed mesh (or union of primitives), looked up by interpolation.

Nodes hold the exact distance; where the surface is curved, `linear` by default lowers them by the mean overshoot of
interpolation between the 8 nodes round a point. `quadratic` also keeps the gradient at every node and adds half of each
node's first-order term, which is exact for second-order polynomials (the errors of interpolating values and of
extrapolating from nodes are opposite, one twice the other). The normal is the analytic gradient of the interpolant,
from the same reads.

A grid holds one or several object classes; `index` says which, and may differ between environments under `vmap` while
the values are shared. Beyond the grid the distance is that at the nearest point of its boundary plus the way there.

Shapes: C classes, n nodes along each axis. Units: m.
"""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import io
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from dexsim.core.assets import cache_path
from dexsim.core.config import setting, validate
from dexsim.core.errors import ConfigError
from dexsim.core.files import write_whole
from dexsim.core.pytree import pytree_dataclass, static
from dexsim.geometry import mesh as meshes
from dexsim.geometry import sdf

INTERPOLATIONS = ("linear", "quadratic")
DTYPES = ("float32", "float16")
_VERSION = 1  # of the files in the cache
_MILLI = 1e-3  # values are kept in mm: a float16 then keeps its full precision down to 0.1 um
_TINY = 1e-20


@dataclasses.dataclass(frozen=True, kw_only=True)
class GridConfig:
    """How a grid is baked."""

    nodes: int = setting(64, unit="1", low=8, high=256)
    """Nodes along each axis; the spacing differs per axis, so that thin objects get fine cells."""
    pad: float = setting(0.004, unit="m", low=0.0005, high=0.1)
    """Room round the object; must exceed the skin's margin."""
    dtype: str = setting("float32", choices=DTYPES)
    """Storage. Linear: float32 keeps the 8 corners of each cell side by side, one read of 32 bytes a query; float16 two
    neighbours a word, 4 reads in an eighth of the memory. Quadratic: float16 halves both."""
    interpolation: str = setting("linear", choices=INTERPOLATIONS)
    """linear: 8 values a query; quadratic: 32, for ten times less error on smooth shapes."""
    unbiased: bool = setting(True)
    """linear only: lower the nodes of curved parts by the mean by which interpolation between them
    overshoots, a twelfth of the second differences. False keeps the nodes exact."""

    def __post_init__(self):
        validate(self)


@pytree_dataclass
class Grid:
    """Distances on nodes. `index` and `scale` may differ per environment, the rest is shared."""

    nodes: int = static()
    interpolation: str = static()
    values: jax.Array
    """Linear float32: [C n^3, 8] mm, each row the corners of the cell that begins at this node, side by side: 8 MB a
    class at 64 nodes, 64 MB for 8 classes. Else flat over [C, n, n, n, channel]; channels: distance in mm, then its
    gradient where quadratic; float32, or uint32 words of two float16 (linear: a node and the next along z)."""
    origin: jax.Array  # [C, 3] m, the first node
    spacing: jax.Array  # [C, 3] m
    index: jax.Array  # [] int32, the class of this object
    scale: jax.Array  # [] the object's size relative to the baked one

    @property
    def classes(self) -> int:
        return self.origin.shape[0]


def bake(source: meshes.Mesh | sdf.Shape, config: GridConfig | None = None, *, cache: bool = True) -> Grid:
    """A grid of one class.

    Args:
      source: a checked mesh (`mesh.load_mesh`) or a union of primitives with known sizes.
      config: resolution and storage.
      cache: keep what was computed from a mesh on disk (`cache_folder`) and use it again.

    Raises:
      AssetError: the mesh cannot be signed.
    """
    config = config or GridConfig()
    low, high = source.bounds if isinstance(source, meshes.Mesh) else sdf.bounds(source)
    axes = [np.linspace(a - config.pad, b + config.pad, config.nodes) for a, b in zip(low, high, strict=True)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
    if isinstance(source, meshes.Mesh):
        distance, gradient = _measured(source, points, config, cache)
    else:
        distance, gradient = (np.asarray(x) for x in sdf.distance_and_normal(jnp.asarray(points, jnp.float32), source))
    channels = distance[:, None] / _MILLI
    if config.interpolation == "quadratic":
        channels = np.concatenate([channels, gradient], 1)
    elif config.unbiased:
        channels = channels - _overshoot(distance, axes)[:, None] / _MILLI
    return Grid(
        nodes=config.nodes, interpolation=config.interpolation, values=jnp.asarray(_pack(channels, config)),
        origin=jnp.asarray([[a[0] for a in axes]], jnp.float32),
        spacing=jnp.asarray([[a[1] - a[0] for a in axes]], jnp.float32),
        index=jnp.zeros((), jnp.int32), scale=jnp.ones(()),
    )  # fmt: skip


def stack(grids: list[Grid]) -> Grid:
    """One grid of several classes, in order; all must be baked with the same configuration.

    Raises:
      ConfigError: they differ in resolution, interpolation or storage.
    """
    kinds = {(g.nodes, g.interpolation, g.values.dtype) for g in grids}
    if len(kinds) != 1:
        raise ConfigError(f"stack: grids of one configuration expected, found {len(kinds)}")
    return dataclasses.replace(
        grids[0],
        values=jnp.concatenate([g.values for g in grids]),
        origin=jnp.concatenate([g.origin for g in grids]),
        spacing=jnp.concatenate([g.spacing for g in grids]),
    )


def select(grid: Grid, index: jax.Array | int, scale: jax.Array | float = 1.0) -> Grid:
    """The object of class `index` [], `scale` times as large; the values stay shared under `vmap`.

    Raises:
      ConfigError: there is no such class; of an index that is traced this cannot be told.
    """
    if not isinstance(index, jax.core.Tracer) and np.any((np.asarray(index) < 0) | (np.asarray(index) >= grid.classes)):
        # Beyond the end the look-up would read any memory.
        raise ConfigError(f"select: index {index}, the grid has classes 0 to {grid.classes - 1}")
    return dataclasses.replace(grid, index=jnp.asarray(index, jnp.int32), scale=jnp.asarray(scale, jnp.float32))


def signed_distance(points: jax.Array, grid: Grid) -> jax.Array:
    """Distance [...] m at points [..., 3] in the object's frame."""
    return _look_up(points, grid)[0]


def distance_and_normal(points: jax.Array, grid: Grid) -> tuple[jax.Array, jax.Array]:
    """Distance [...] m and unit gradient [..., 3] of the interpolant."""
    distance, gradient = _look_up(points, grid)
    length = jnp.sqrt(sum(g * g for g in gradient) + _TINY)
    return distance, jnp.stack([g / length for g in gradient], -1)


def cache_folder() -> Path:
    """Where baked grids are kept: `sdf` in `$DEXSIM_CACHE`, or in `~/.cache/dexsim`."""
    return cache_path("sdf")


def _look_up(points: jax.Array, grid: Grid) -> tuple[jax.Array, list[jax.Array]]:
    """Distance and its gradient's three components. Component by component, so that XLA makes one kernel of it."""
    n = grid.nodes
    step = grid.spacing[grid.index] * grid.scale
    start = grid.origin[grid.index] * grid.scale
    # Without the barrier XLA would read and divide these few numbers anew for every point.
    step, rate, start, base = jax.lax.optimization_barrier((step, 1.0 / step, start, grid.index * n**3))
    gaps, cells, parts, free = [], [], [], []
    for axis in range(3):
        at = (points[..., axis] - start[axis]) * rate[axis]
        held = jnp.clip(at, 0.0, n - 1.0)
        cell = jnp.minimum(jax.lax.stop_gradient(held).astype(jnp.int32), n - 2)
        gaps.append((at - held) * step[axis])
        cells.append(cell)
        parts.append(held - cell.astype(held.dtype))
        free.append(at == held)
    first = base + (cells[0] * n + cells[1]) * n + cells[2]
    if grid.interpolation == "linear":
        value, slope = _linear(_read_linear(grid, first, cells), parts)
    else:
        spacing = step / (grid.scale * _MILLI)
        value, slope = _quadratic(_read_quadratic(grid, first), parts, [spacing[axis] for axis in range(3)])
    way = jnp.sqrt(sum(g * g for g in gaps) + _TINY)
    unit = _MILLI * grid.scale
    gradient = [
        jnp.where(f, unit * s * rate[axis], 0.0) + gaps[axis] / way
        for axis, (f, s) in enumerate(zip(free, slope, strict=True))
    ]
    return unit * value + way - _TINY**0.5, gradient


def _linear(corners: list[jax.Array], parts: list[jax.Array]) -> tuple[jax.Array, list[jax.Array]]:
    """Trilinear value, and its derivative by each part, from the corners in the order (x, y, z), z fastest."""
    tx, ty, tz = parts
    rise = [corners[k + 1] - corners[k] for k in (0, 2, 4, 6)]
    edge = [corners[k] + tz * r for k, r in zip((0, 2, 4, 6), rise, strict=True)]
    face = [edge[0] + ty * (edge[1] - edge[0]), edge[2] + ty * (edge[3] - edge[2])]
    dx = face[1] - face[0]
    dy = (1 - tx) * (edge[1] - edge[0]) + tx * (edge[3] - edge[2])
    dz = (1 - tx) * (rise[0] + ty * (rise[1] - rise[0])) + tx * (rise[2] + ty * (rise[3] - rise[2]))
    return face[0] + tx * dx, [dx, dy, dz]


def _quadratic(corners: list[list[jax.Array]], parts: list[jax.Array], spacing: list[jax.Array]):
    """sum_i w_i (f_i + g_i . (x - x_i) / 2) and its derivative by each part; corners are lists of f, gx, gy, gz."""
    value, slope = _linear([c[0] for c in corners], parts)
    for axis in range(3):
        half = 0.5 * spacing[axis]
        at = [half * corners[k][1 + axis] * (parts[axis] - ((k >> (2 - axis)) & 1)) for k in range(8)]
        term, by = _linear(at, parts)
        own, _ = _linear([half * c[1 + axis] for c in corners], parts)
        value = value + term
        slope = [s + b for s, b in zip(slope, by, strict=True)]
        slope[axis] = slope[axis] + own
    return value, slope


def _corner_offsets(n: int) -> list[int]:
    return [(x * n + y) * n + z for x in (0, 1) for y in (0, 1) for z in (0, 1)]


def _read(values: jax.Array, *index: jax.Array) -> list[jax.Array]:
    """The number there, or the two float16 of the word there, as float32."""
    # No index is negative: without saying so, each read costs a comparison, an addition and a choice more.
    word = values.at[index].get(mode="promise_in_bounds", wrap_negative_indices=False)
    if values.dtype == jnp.float32:
        return [word]
    halves = (word.astype(jnp.uint16), (word >> 16).astype(jnp.uint16))
    return [jax.lax.bitcast_convert_type(half, jnp.float16).astype(jnp.float32) for half in halves]


def _read_linear(grid: Grid, first: jax.Array, cells: list[jax.Array]) -> list[jax.Array]:
    n, values = grid.nodes, grid.values
    if values.dtype != jnp.float32:
        return [half for k in _corner_offsets(n)[::2] for half in _read(values, first + k)]
    # One aligned sector of 32 bytes, whose slices stay in the kernel that uses them. Read by one index, XLA (JAX 0.10)
    # writes every point's index to memory in a kernel of its own, by two it does not; with several classes vice versa.
    at: tuple[jax.Array, ...] = (first,)
    if grid.classes == 1:
        values, at = values.reshape(-1, n * n, 8), (grid.index * n + cells[0], cells[1] * n + cells[2])
    (row,) = _read(values, *at)
    return [row[..., k] for k in range(8)]


def _read_quadratic(grid: Grid, first: jax.Array) -> list[list[jax.Array]]:
    words = 4 if grid.values.dtype == jnp.float32 else 2
    return [
        [x for word in range(words) for x in _read(grid.values, words * (first + k) + word)]
        for k in _corner_offsets(grid.nodes)
    ]


def _pack(channels: np.ndarray, config: GridConfig) -> np.ndarray:
    """[nodes, 1 or 4] as `Grid.values`. No cell begins at an axis' last node: what is rolled there is never read."""
    kept = channels.astype(config.dtype)
    if config.interpolation == "linear":
        beside = _corner_offsets(config.nodes)[: 8 if config.dtype == "float32" else 2]
        kept = np.concatenate([np.roll(kept, -k, axis=0) for k in beside], 1)
    if config.dtype == "float16":
        kept = np.ascontiguousarray(kept).view(np.uint32)
    return kept if kept.shape[1] == 8 else kept.reshape(-1)


def _overshoot(distance: np.ndarray, axes: list[np.ndarray]) -> np.ndarray:
    """Mean error of linear interpolation round each node [nodes], m; 0 at edges, where there is no second difference.

    Between two nodes a curve lies above its chord by f'' h^2 t (1 - t) / 2, by f'' h^2 / 12 on average.
    """
    n = len(axes[0])
    cube, total = distance.reshape(n, n, n).astype(np.float64), np.zeros((n, n, n))
    smooth = np.ones((n, n, n), bool)
    for k, axis in enumerate(axes):
        line = np.moveaxis(cube, k, 0)
        second = np.pad(line[2:] - 2 * line[1:-1] + line[:-2], ((1, 1), (0, 0), (0, 0)), mode="edge")
        second = np.moveaxis(second, 0, k)
        smooth &= np.abs(second) < 0.2 * (axis[1] - axis[0])
        total += second / 12
    return np.where(smooth, total, 0.0).reshape(-1)


def _measured(mesh: meshes.Mesh, points: np.ndarray, config: GridConfig, cache: bool) -> tuple[np.ndarray, np.ndarray]:
    """Exact distance and gradient at the nodes, from the cache if possible."""
    key = hashlib.sha256(f"{mesh.fingerprint} {config.nodes} {config.pad!r} {_VERSION}".encode()).hexdigest()[:32]
    path = cache_folder() / f"{key}.npz"
    if cache and (found := _load(path, len(points))) is not None:
        return found
    meshes.check_sign(mesh)
    distance, gradient = meshes.signed_distance(mesh, points)
    distance, gradient = distance.astype(np.float32), gradient.astype(np.float32)
    if cache:
        _store(path, distance, gradient)
    return distance, gradient


def _load(path: Path, count: int) -> tuple[np.ndarray, np.ndarray] | None:
    try:
        with np.load(path) as file:
            distance, gradient = file["distance"], file["gradient"]
    except Exception:  # missing, half written, of an older program: bake again
        return None
    whole = distance.shape == (count,) and gradient.shape == (count, 3) and np.all(np.isfinite(distance))
    return (distance, gradient) if whole else None


def _store(path: Path, distance: np.ndarray, gradient: np.ndarray) -> None:
    """Keep the grid; a cache that cannot be written is no error."""
    buffer = io.BytesIO()
    np.savez_compressed(buffer, distance=distance, gradient=gradient)
    with contextlib.suppress(OSError):
        write_whole(path, [buffer.getbuffer()])
