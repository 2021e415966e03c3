"""A mesh as the object of a task: mass properties, and a union of boxes that follows it, for the solver.

The object's frame is at the mesh's centre of mass. Its axes are those of the file where these are principal axes, else
the principal axes that are nearest to them.

Physics engines take a mesh for its convex hull, at one size for all environments, and at a cost that grows with its
faces. Boxes may be sized anew in every episode, follow hollows, and are the same everywhere. They are grown one after
another inside the voxels of the mesh, each where it covers most that is not covered yet, and then moved, turned and
sized together so that the distance to their union is the distance to the mesh near its surface.
"""

import dataclasses
from collections.abc import Sequence
from functools import lru_cache

import jax
import jax.numpy as jnp
import numpy as np
import trimesh
from scipy.optimize import linear_sum_assignment, minimize

from dexsim.core.assets import cached_arrays
from dexsim.errors import AssetError
from dexsim.geometry import mesh as meshes, rotations, sdf
from dexsim.hand.mjcf import quaternion

_ALIGNED = 0.01  # products of inertia below this share of the mean moment are none
_VERSION = 3  # of the files in the cache
_VOXELS = 28  # along the longest side
_SEEDS = 120  # boxes grown for every one that is kept
_STEPS = 400  # of the refinement, at most
_ALIKE = 0.002  # fits whose mean deviations differ by less, as a share of the mesh's size, are as good
_WORST = (0.025, 0.1)  # largest deviation, as a share of the mesh's size


@dataclasses.dataclass(frozen=True, eq=False)
class Boxes:
    """K boxes in the mesh's frame, and how far they are from it."""

    size: np.ndarray  # [K, 3] m, half-extents
    position: np.ndarray  # [K, 3] m
    quat: np.ndarray  # [K, 4]
    deviation: np.ndarray  # [2] m, between the two surfaces: mean and 99th percentile


@dataclasses.dataclass(frozen=True, eq=False)
class MeshObject:
    """A mesh of size 1 in its own frame. Make it with `load`."""

    mesh: meshes.Trimesh
    boxes: Boxes
    inertia: np.ndarray  # [3] m^2, of a uniform solid of 1 kg


@lru_cache(maxsize=8)
def load(path: str, *, unit: float, parts: int, repair: str = "none", changed: int = 0) -> MeshObject:
    """The object of a mesh file, in any format that trimesh reads, with `parts` boxes at most; `unit` is the file's, m,
    and `repair` what to do if it is not closed (`geometry.mesh.load_mesh`). Kept until the time `changed` is another.

    What was fitted once is kept in the cache. Raises AssetError: no such file, not closed, its inside cannot be
    determined, or so many boxes do not follow it (2.5 % of its size off on average, or 10 % at the 99th percentile).
    """
    with jax.ensure_compile_time_eval():  # the first call may be inside of a trace
        mesh = meshes.load_mesh(path, scale=unit, repair=repair)
        properties = mesh.mass_properties
        tensor, origin = np.asarray(properties.inertia) / properties.mass, np.asarray(properties.center_mass)
        axes = principal_axes(tensor)
        own = meshes.make_mesh(mesh.metadata["name"], (mesh.vertices - origin) @ axes, mesh.faces)
        # An L has its bars along the axes of its file.
        frames = [np.eye(3)] if np.array_equal(axes, np.eye(3)) else [np.eye(3), axes.T]
        key = f"{meshes.fingerprint(own)} {parts} {np.round(frames, 5).tolist()} {_VERSION}"
        boxes = Boxes(**cached_arrays("boxes", key, lambda: vars(_fit(own, parts, frames))))
    extent = np.ptp(own.vertices, axis=0).max()
    if np.any(boxes.deviation > np.array(_WORST) * extent):
        mean, worst = 1e3 * boxes.deviation
        off = f"{mean:.2g} mm off on average, {worst:.2g} mm at worst, of {1e3 * extent:.3g} mm"
        what = f"{mesh.metadata['name']}: {len(boxes.size)} boxes do not follow its surface"
        raise AssetError(f"{what}, {off}; allow more (ObjectConfig.mesh_parts)")
    return MeshObject(own, boxes, np.diag(axes.T @ tensor @ axes).astype(np.float32))


def principal_axes(tensor: np.ndarray) -> np.ndarray:
    """Principal axes [3, 3] of an inertia tensor [3, 3], in columns: the ones nearest to the given axes."""
    products = tensor - np.diag(np.diag(tensor))
    if np.abs(products).max() <= _ALIGNED * np.trace(tensor) / 3:
        return np.eye(3)
    vectors = np.linalg.eigh(tensor)[1]
    _, order = linear_sum_assignment(np.abs(vectors), maximize=True)
    axes = vectors[:, order]
    axes = axes * np.where(np.diag(axes) < 0, -1.0, 1.0)
    if np.linalg.det(axes) < 0:
        axes[:, np.argmin(np.abs(np.diag(axes)))] *= -1
    return axes


def _fit(mesh: meshes.Trimesh, parts: int, frames: Sequence[np.ndarray]) -> Boxes:
    """At most `parts` boxes, which start along the columns of one of the rotations [3, 3]; the best start is used."""
    meshes.check_sign(mesh)
    rng = np.random.default_rng(0)
    extent = float(np.ptp(mesh.vertices, axis=0).max())
    skin, normal = meshes.sample_surface(mesh, 3000, rng)
    low, high = mesh.bounds + [[-0.03 * extent], [0.03 * extent]]
    near = skin + rng.normal(0, 0.03 * extent, (3000, 1)) * normal
    points = np.concatenate([near, rng.uniform(low, high, (1500, 3))])
    distance = meshes.signed_distance(mesh, points)
    candidates = []
    for frame in frames:
        start = _start(mesh, frame, parts, rng)
        refined = _refine(start, points.astype(np.float32), distance.astype(np.float32), extent)
        candidates += [_boxes(mesh, fit, rng) for fit in (start, refined)]
    # Among fits that are as good, the one with fewer boxes.
    return min(
        candidates,
        key=lambda boxes: (round(boxes.deviation[0] / (_ALIKE * extent)), len(boxes.size), boxes.deviation[0]),
    )


def _start(mesh: meshes.Trimesh, frame: np.ndarray, parts: int, rng: np.random.Generator) -> np.ndarray:
    """Boxes along the columns of `frame` [K, 10]: position, logarithms of the half-extents, quaternion."""
    low, high = _grow(meshes.make_mesh("", mesh.vertices @ frame, mesh.faces), parts, rng)
    quats = np.tile(quaternion(frame), (len(low), 1))
    return np.column_stack([(low + high) / 2 @ frame.T, np.log((high - low) / 2), quats])


def _grow(mesh: meshes.Trimesh, parts: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Corners [K, 3] of boxes along the mesh's axes that fill it, the most useful first."""
    low, high = mesh.bounds
    pitch = float((high - low).max()) / _VOXELS
    shape = np.maximum(np.ceil((high - low) / pitch).astype(int), 1)
    # Voxels that end with the mesh on every side, so that a cuboid is found exactly.
    cell = (high - low) / shape
    centres = [low[k] + cell[k] * (np.arange(shape[k]) + 0.5) for k in range(3)]
    points = np.stack(np.meshgrid(*centres, indexing="ij"), -1).reshape(-1, 3)
    distance = meshes.signed_distance(mesh, points).reshape(shape)
    inside, left = distance < 0, distance < 0
    if not inside.any():
        size = f"a mesh of {1000 * _VOXELS * pitch:.0f} mm has no inside at a resolution of {1000 * pitch:.1f} mm"
        raise AssetError(f"{size}: its walls are too thin for boxes; give it as a solid")
    boxes: list[np.ndarray] = []
    for _ in range(parts):
        if left.sum() < 0.01 * inside.sum():
            break
        seeds, depth = np.argwhere(left), -distance[left]
        chosen = rng.choice(len(seeds), min(_SEEDS, len(seeds)), replace=False, p=depth / depth.sum())
        grown = [_grow_one(inside, seeds[index], rng) for index in chosen]
        gain = [int(np.sum(left[_cut(box)])) - int(np.sum(~inside[_cut(box)])) for box in grown]
        boxes.append(grown[int(np.argmax(gain))])
        left[_cut(boxes[-1])] = False
    corners = np.array(boxes)
    return low + corners[..., 0] * cell, low + corners[..., 1] * cell


def _cut(box: np.ndarray) -> tuple[slice, ...]:
    return tuple(slice(*span) for span in box)


def _grow_one(inside: np.ndarray, seed: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """A box [3, 2], first and last + 1, round a voxel, layer by layer while nine tenths of a layer lie inside."""
    box, sides = np.stack([seed, seed + 1], 1), [[axis, end] for axis in range(3) for end in (0, 1)]
    while sides:
        for axis, end in rng.permutation(sides).tolist():
            edge = box[axis, end] - 1 + end
            layer = [*_cut(box)]
            layer[axis] = slice(edge, edge + 1)
            if 0 <= edge < inside.shape[axis] and np.mean(inside[tuple(layer)]) >= 0.9:
                box[axis, end] += 2 * end - 1
            else:
                sides.remove([axis, end])
    return box


@jax.jit
@jax.value_and_grad
def _misfit(boxes: jax.Array, points: jax.Array, distance: jax.Array, band: jax.Array) -> jax.Array:
    """How far [] the distance to the union of boxes [K, 10] is from the mesh's at points [P, 3]; distances count up to
    `band` m from the surface."""
    quat = boxes[:, 6:] / jnp.linalg.norm(boxes[:, 6:], axis=-1, keepdims=True)

    def one(position: jax.Array, size: jax.Array, quat: jax.Array) -> jax.Array:
        return sdf.box(sdf.to_local(points, position, rotations.quat_to_matrix(quat)), jnp.exp(size))

    union = jnp.min(jax.vmap(one)(boxes[:, :3], boxes[:, 3:6], quat), 0)
    error = (jnp.clip(union, -band, band) - jnp.clip(distance, -band, band)) / band
    return jnp.mean(jnp.sqrt(error**2 + 1e-4))


def _refine(start: np.ndarray, points: np.ndarray, distance: np.ndarray, extent: float) -> np.ndarray:
    """Boxes [K, 10] of the least misfit near a start."""
    scale = np.repeat([0.004 * extent, 0.02, 0.01], [3, 3, 4])

    def cost(x: np.ndarray) -> tuple[float, np.ndarray]:
        boxes = (start + scale * x.reshape(start.shape)).astype(np.float32)
        value, slope = _misfit(boxes, points, distance, np.float32(0.08 * extent))
        return float(value), np.ravel(np.asarray(slope, float) * scale)

    best = minimize(cost, np.zeros(start.size), jac=True, method="L-BFGS-B", options={"maxiter": _STEPS})
    return start + scale * best.x.reshape(start.shape)


def _boxes(mesh: meshes.Trimesh, fit: np.ndarray, rng: np.random.Generator) -> Boxes:
    """Boxes from [K, 10], with their deviation."""
    position, size, quat = np.split(fit.astype(np.float32), [3, 6], axis=1)
    size, quat = np.exp(size), quat / np.linalg.norm(quat, axis=1, keepdims=True)
    turns, there = rotations.quat_to_matrix(jnp.asarray(quat)), jnp.ones(len(size), bool)
    shape = sdf.Shape(("box",) * len(size), jnp.asarray(size), jnp.asarray(position), turns, there)
    sides = [trimesh.creation.box(2 * half) for half in size]
    for side, place, turn in zip(sides, position, np.asarray(turns), strict=True):
        side.vertices = side.vertices @ turn.T + place
    # Of the boxes' own surfaces what is in no other box.
    points = meshes.sample_surface(trimesh.util.concatenate(sides), 8000, rng)[0]
    outside = np.asarray(sdf.signed_distance(points.astype(np.float32), shape)) > -1e-5
    back = np.abs(meshes.signed_distance(mesh, points[outside][:2000]))
    skin = meshes.sample_surface(mesh, 2000, rng)[0].astype(np.float32)
    both = np.append(np.abs(sdf.signed_distance(skin, shape)), back)
    return Boxes(size, position, quat, np.array([both.mean(), np.percentile(both, 99)]))
