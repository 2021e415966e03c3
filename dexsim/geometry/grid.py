"""Signed-distance grids: baked once from any closed mesh, looked up by interpolation.

Nodes hold the exact distance; where the surface is curved they are lowered by the mean overshoot of linear
interpolation between the 8 nodes round a point. Beyond the grid the distance is that at the nearest point of its
boundary plus the way there.

Shapes: n nodes along each axis. Units: m.
"""

import jax
import jax.numpy as jnp
import numpy as np
from scipy.ndimage import correlate1d

from dexsim.core.assets import cached_arrays
from dexsim.core.pytree import pytree_dataclass
from dexsim.geometry import mesh as meshes

NODES = 64
"""Along each axis; the spacing differs per axis, so that thin objects get fine cells."""
PAD = 0.004
"""m, room round the object; must exceed the skin's margin."""
_VERSION = 1  # of the files in the cache
_MILLI = 1e-3  # values are lowered in mm
_TINY = 1e-20


@pytree_dataclass
class Grid:
    """Distances on nodes. `scale` may differ per environment, the rest is shared."""

    values: jax.Array  # [n, n^2, 8] mm: the corners of the cell that begins at each node; 8 MB at 64 nodes
    origin: jax.Array  # [3] m, the first node
    spacing: jax.Array  # [3] m
    scale: jax.Array  # [] the object's size relative to the baked one


def bake(mesh: meshes.Trimesh, *, nodes: int = NODES) -> Grid:
    """The grid of a checked mesh (`mesh.load_mesh`), which is kept in the cache.

    Raises:
      AssetError: the mesh cannot be signed.
    """
    axes = [np.linspace(low - PAD, high + PAD, nodes) for low, high in mesh.bounds.T]
    key = f"{meshes.fingerprint(mesh)} {nodes} {PAD!r} {_VERSION}"
    return from_distances(axes, cached_arrays("sdf", key, lambda: _measure(mesh, axes))["distance"])


def from_distances(axes: list[np.ndarray], distance: np.ndarray) -> Grid:
    """The grid of distances [n^3] m at the nodes of three axes [n] m, the last one fastest."""
    nodes = len(axes[0])
    lowered = ((distance - _overshoot(distance, axes)) / _MILLI).astype(np.float32)
    # No cell begins at an axis' last node: what is rolled there is never read.
    corners = np.stack([np.roll(lowered, -((x * nodes + y) * nodes + z)) for x, y, z in np.ndindex(2, 2, 2)], -1)
    return Grid(
        values=jnp.asarray(corners.reshape(nodes, nodes * nodes, 8)),
        origin=jnp.asarray([a[0] for a in axes], jnp.float32),
        spacing=jnp.asarray([a[1] - a[0] for a in axes], jnp.float32),
        scale=jnp.ones(()),
    )


def signed_distance(points: jax.Array, grid: Grid) -> jax.Array:
    """Distance [...] m at points [..., 3] in the object's frame: by components, so that XLA makes one kernel of it."""
    n = len(grid.values)
    step, start = grid.spacing * grid.scale, grid.origin * grid.scale
    # Without the barrier XLA would read and divide these few numbers anew for every point.
    step, rate, start = jax.lax.optimization_barrier((step, 1.0 / step, start))
    gaps, cells, parts = [], [], []
    for axis in range(3):
        at = (points[..., axis] - start[axis]) * rate[axis]
        held = jnp.clip(at, 0.0, n - 1.0)
        cell = jnp.minimum(jax.lax.stop_gradient(held).astype(jnp.int32), n - 2)
        gaps.append((at - held) * step[axis])
        cells.append(cell)
        parts.append(held - cell.astype(held.dtype))
    # One aligned sector of 32 bytes, whose slices stay in the kernel that uses them. Read by one index, XLA (JAX 0.10)
    # writes every point's index to memory in a kernel of its own, by two it does not. No index is negative: without
    # saying so, each read costs a comparison, an addition and a choice more.
    at = cells[0], cells[1] * n + cells[2]
    row = grid.values.at[at].get(mode="promise_in_bounds", wrap_negative_indices=False)
    x, y, z = parts
    corner = [row[..., k] for k in range(8)]  # z fastest
    edge = [corner[k] + z * (corner[k + 1] - corner[k]) for k in (0, 2, 4, 6)]
    face = [edge[k] + y * (edge[k + 1] - edge[k]) for k in (0, 2)]
    way = jnp.sqrt(sum(g * g for g in gaps) + _TINY)
    return _MILLI * grid.scale * (face[0] + x * (face[1] - face[0])) + way - _TINY**0.5


def _overshoot(distance: np.ndarray, axes: list[np.ndarray]) -> np.ndarray:
    """Mean error of linear interpolation round each node [nodes], m; 0 where the second difference is large, at edges.

    Between two nodes a curve lies above its chord by f'' h^2 t (1 - t) / 2, by f'' h^2 / 12 on average.
    """
    cube = distance.reshape([len(axis) for axis in axes]).astype(np.float64)
    second = np.stack([correlate1d(cube, [1, -2, 1], axis=k, mode="nearest") for k in range(3)], -1)
    smooth = np.all(np.abs(second) < [0.2 * (axis[1] - axis[0]) for axis in axes], -1)
    return np.where(smooth, second.sum(-1) / 12, 0.0).reshape(-1)


def _measure(mesh: meshes.Trimesh, axes: list[np.ndarray]) -> dict[str, np.ndarray]:
    """Exact distance at the nodes, m."""
    meshes.check_sign(mesh)
    points = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
    return {"distance": meshes.signed_distance(mesh, points).astype(np.float32)}
