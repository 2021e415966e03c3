"""A union of boxes that follows a mesh: what the solver collides with where the object is a mesh.

Physics engines take a mesh for its convex hull, at one size for all environments, and at a cost that grows with its
faces. Boxes may be sized anew in every episode, follow hollows, and are the same everywhere. They are grown one after
another inside the voxels of the mesh, each where it covers most that is not covered yet, and then moved, turned and
sized together so that the distance to their union is the distance to the mesh near its surface.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from dexsim.core.assets import cached_arrays
from dexsim.core.errors import AssetError
from dexsim.geometry import mesh as meshes
from dexsim.geometry import rotations, sdf

_VERSION = 2  # of the files in the cache
_VOXELS = 28  # along the longest side
_SEEDS = 120  # boxes grown for every one that is kept
_STEPS = 400  # of the refinement
_ALIKE = 0.002  # fits whose mean deviations differ by less, as a share of the mesh's size, are as good
_WORST = (0.025, 0.1)  # largest deviation, mean and 99th percentile, as a share of the mesh's size


@dataclasses.dataclass(frozen=True, eq=False)
class Boxes:
    """K boxes in the mesh's frame, and how far they are from it."""

    size: np.ndarray  # [K, 3] m, half-extents
    position: np.ndarray  # [K, 3] m
    quat: np.ndarray  # [K, 4]
    deviation: tuple[float, ...]  # m, between the two surfaces: mean and 99th percentile

    def shape(self) -> sdf.Shape:
        """The union, for distances."""
        count = len(self.size)
        return sdf.Shape(
            ("box",) * count,
            jnp.asarray(self.size),
            jnp.asarray(self.position),
            rotations.quat_to_matrix(jnp.asarray(self.quat)),
            jnp.ones(count, bool),
        )


def fit_boxes(mesh: meshes.Trimesh, parts: int, *, frames: Sequence[np.ndarray] = ()) -> Boxes:
    """At most `parts` boxes for a mesh; what was fitted once is kept in the cache.

    Args:
      frames: rotations [3, 3] whose columns boxes may start along, in addition to the mesh's own axes;
        the best start is used.

    Raises:
      AssetError: so many boxes do not follow it (2.5 % of its size off on average, or 10 % at the 99th
        percentile), or its inside cannot be determined.
    """
    frames = (np.eye(3), *frames)
    key = f"{meshes.fingerprint(mesh)} {parts} {np.round(frames, 5).tolist()} {_VERSION}"
    arrays = cached_arrays("boxes", key, lambda: vars(_fit(mesh, parts, frames)))
    boxes = Boxes(arrays["size"], arrays["position"], arrays["quat"], tuple(map(float, arrays["deviation"])))
    extent = float(np.ptp(mesh.vertices, axis=0).max())
    if any(off > share * extent for off, share in zip(boxes.deviation, _WORST, strict=True)):
        mean, worst = (1e3 * off for off in boxes.deviation)
        raise AssetError(
            f"{mesh.metadata['name']}: {len(boxes.size)} boxes do not follow its surface, {mean:.2g} mm off on "
            f"average, {worst:.2g} mm at worst, of {1e3 * extent:.3g} mm; allow more "
            "(ObjectConfig.mesh_parts)"
        )
    return boxes


def _fit(mesh: meshes.Trimesh, parts: int, frames: Sequence[np.ndarray]) -> Boxes:
    meshes.check_sign(mesh)
    rng = np.random.default_rng(0)
    extent = float(np.ptp(mesh.vertices, axis=0).max())
    skin, normal = meshes.sample_surface(mesh, 3000, rng)
    low, high = mesh.bounds + [[-0.03 * extent], [0.03 * extent]]
    near = skin + rng.normal(0, 0.03 * extent, (3000, 1)) * normal
    points = np.concatenate([near, rng.uniform(low, high, (1500, 3))])
    distance, _ = meshes.signed_distance(mesh, points)
    candidates = []
    for frame in frames:
        start = _start(mesh, frame, parts, rng)
        refined = _refine(start, jnp.asarray(points, jnp.float32), jnp.asarray(distance, jnp.float32), extent)
        candidates += [_boxes(mesh, fit, rng) for fit in (start, refined)]
    # Among fits that are as good, the one with fewer boxes.
    return min(
        candidates,
        key=lambda boxes: (round(boxes.deviation[0] / (_ALIKE * extent)), len(boxes.size), boxes.deviation[0]),
    )


def _start(mesh: meshes.Trimesh, frame: np.ndarray, parts: int, rng: np.random.Generator) -> dict[str, jax.Array]:
    """Boxes along the columns of `frame`: "position" [K, 3], "size" [K, 3] (logarithms), "quat" [K, 4]."""
    low, high = _grow(meshes.make_mesh("", mesh.vertices @ frame, mesh.faces), parts, rng)
    quat = np.empty(4)
    mujoco.mju_mat2Quat(quat, np.ascontiguousarray(frame, np.float64).ravel())
    values = {
        "position": (low + high) / 2 @ frame.T,
        "size": np.log((high - low) / 2),
        "quat": np.tile(quat, (len(low), 1)),
    }
    return {name: jnp.asarray(value, jnp.float32) for name, value in values.items()}


def _grow(mesh: meshes.Trimesh, parts: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Corners [K, 3] of boxes along the mesh's axes that fill it, the most useful first."""
    low, high = mesh.bounds
    pitch = float((high - low).max()) / _VOXELS
    shape = np.maximum(np.ceil((high - low) / pitch).astype(int), 1)
    # Voxels that end with the mesh on every side, so that a cuboid is found exactly.
    cell = (high - low) / shape
    centres = [low[k] + cell[k] * (np.arange(shape[k]) + 0.5) for k in range(3)]
    points = np.stack(np.meshgrid(*centres, indexing="ij"), -1).reshape(-1, 3)
    distance = meshes.signed_distance(mesh, points)[0].reshape(shape)
    inside, left = distance < 0, distance < 0
    if not inside.any():
        raise AssetError(
            f"a mesh of {1000 * float((high - low).max()):.0f} mm has no inside at a resolution of {1000 * pitch:.1f} "
            "mm: its walls are too thin for boxes; give it as a solid"
        )
    boxes: list[tuple[np.ndarray, np.ndarray]] = []
    for _ in range(parts):
        if left.sum() < 0.01 * inside.sum():
            break
        seeds, depth = np.argwhere(left), -distance[left]
        chosen = rng.choice(len(seeds), min(_SEEDS, len(seeds)), replace=False, p=depth / depth.sum())
        grown = [_grow_one(inside, seeds[index], rng) for index in chosen]
        gain = [int(np.sum(left[_cut(box)])) - int(np.sum(~inside[_cut(box)])) for box in grown]
        best = grown[int(np.argmax(gain))]
        left[_cut(best)] = False
        boxes.append(best)
    corners = np.array(boxes)
    return low + corners[:, 0] * cell, low + corners[:, 1] * cell


def _cut(box: tuple[np.ndarray, np.ndarray]) -> tuple[slice, ...]:
    return tuple(slice(a, b) for a, b in zip(*box, strict=True))


def _grow_one(inside: np.ndarray, seed: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """A box [first, last) round a voxel, layer by layer while nine tenths of a layer lie inside."""
    first, last = seed.copy(), seed + 1
    sides = list(range(6))
    while sides:
        for side in rng.permutation(sides):
            axis, ahead = side % 3, side >= 3
            edge = last[axis] if ahead else first[axis] - 1
            if not 0 <= edge < inside.shape[axis]:
                sides.remove(side)
                continue
            layer = list(_cut((first, last)))
            layer[axis] = slice(edge, edge + 1)
            if np.mean(inside[tuple(layer)]) < 0.9:
                sides.remove(side)
            elif ahead:
                last[axis] += 1
            else:
                first[axis] -= 1
    return first, last


def _union(params: dict[str, jax.Array], points: jax.Array) -> jax.Array:
    quat = params["quat"] / jnp.linalg.norm(params["quat"], axis=-1, keepdims=True)

    def one(position: jax.Array, size: jax.Array, quat: jax.Array) -> jax.Array:
        return sdf.box(sdf.to_local(points, position, rotations.quat_to_matrix(quat)), jnp.exp(size))

    return jnp.min(jax.vmap(one)(params["position"], params["size"], quat), 0)


@jax.jit
def _refine(
    params: dict[str, jax.Array], points: jax.Array, distance: jax.Array, extent: jax.Array
) -> dict[str, jax.Array]:
    """Adam on the difference of the two distances, which count up to 8 % of the size from the surface."""
    band = 0.08 * extent

    def loss(params: dict[str, jax.Array]) -> jax.Array:
        error = (jnp.clip(_union(params, points), -band, band) - jnp.clip(distance, -band, band)) / band
        return jnp.mean(jnp.sqrt(error**2 + 1e-4))

    pace = {"position": 0.004 * extent, "size": 0.02, "quat": 0.01}

    def step(carry, index):
        params, first, second = carry
        slope = jax.grad(loss)(params)
        first = jax.tree.map(lambda m, g: 0.9 * m + 0.1 * g, first, slope)
        second = jax.tree.map(lambda v, g: 0.99 * v + 0.01 * g * g, second, slope)
        fade, at = 1 - index / _STEPS, index + 1.0
        params = {
            name: params[name]
            - fade * pace[name] * (first[name] / (1 - 0.9**at)) / (jnp.sqrt(second[name] / (1 - 0.99**at)) + 1e-12)
            for name in params
        }
        return (params, first, second), None

    zero = jax.tree.map(jnp.zeros_like, params)
    return jax.lax.scan(step, (params, zero, zero), jnp.arange(_STEPS, dtype=jnp.float32))[0][0]


def _boxes(mesh: meshes.Trimesh, params: dict[str, jax.Array], rng: np.random.Generator) -> Boxes:
    quat = np.asarray(params["quat"], np.float64)
    quat /= np.linalg.norm(quat, axis=1, keepdims=True)
    size, position = np.exp(np.asarray(params["size"], np.float64)), np.asarray(params["position"], np.float64)
    boxes = Boxes(size.astype(np.float32), position.astype(np.float32), quat.astype(np.float32), (0.0, 0.0))
    skin = jnp.asarray(meshes.sample_surface(mesh, 2000, rng)[0], jnp.float32)
    there = np.abs(np.asarray(sdf.signed_distance(skin, boxes.shape())))
    back = np.abs(meshes.signed_distance(mesh, _on_surface(boxes, 2000, rng))[0])
    both = np.concatenate([there, back])
    return dataclasses.replace(boxes, deviation=(float(both.mean()), float(np.percentile(both, 99))))


def _on_surface(boxes: Boxes, count: int, rng: np.random.Generator) -> np.ndarray:
    """Random points on the union's surface, uniform by area."""
    areas = np.stack([boxes.size[:, (k + 1) % 3] * boxes.size[:, (k + 2) % 3] for k in range(3)], 1)
    pick = rng.choice(areas.size, 4 * count, p=(areas / areas.sum()).ravel())
    box, axis = np.divmod(pick, 3)
    unit = rng.uniform(-1, 1, (len(pick), 3))
    unit[np.arange(len(pick)), axis] = rng.choice([-1.0, 1.0], len(pick))
    turn = np.asarray(rotations.quat_to_matrix(jnp.asarray(boxes.quat)))[box]
    points = np.einsum("nij,nj->ni", turn, unit * boxes.size[box]) + boxes.position[box]
    outside = np.asarray(sdf.signed_distance(jnp.asarray(points, jnp.float32), boxes.shape())) > -1e-5
    return points[outside][:count]
