"""A mesh as the object of a task: boxes for the solver and mass properties.

The object's frame is at the mesh's centre of mass. Its axes are those of the file where these are principal axes, else
the principal axes that are nearest to them.
"""

from __future__ import annotations

import dataclasses
from functools import lru_cache
from pathlib import Path

import jax
import numpy as np
from scipy.optimize import linear_sum_assignment

from dexsim.geometry import mesh as meshes
from dexsim.objects.boxes import Boxes, fit_boxes

_ALIGNED = 0.01  # products of inertia below this share of the mean moment are none


@dataclasses.dataclass(frozen=True, eq=False)
class MeshObject:
    """A mesh of size 1 in its own frame. Make it with `load`."""

    mesh: meshes.Trimesh
    boxes: Boxes
    inertia: np.ndarray  # [3] m^2, of a uniform solid of 1 kg
    axes: np.ndarray  # [3, 3], the frame's axes in the file's, in columns
    origin: np.ndarray  # [3] m, the frame's origin in the file's

    @property
    def kinds(self) -> tuple[str, ...]:
        """The primitives that it consists of."""
        return ("box",) * len(self.boxes.size)


def load(path: str, *, unit: float, parts: int, repair: str = "none") -> MeshObject:
    """The object of a mesh file, in any format that trimesh reads, with `parts` boxes at most; `unit` is the file's, m,
    and `repair` what to do if it is not closed (`geometry.mesh.load_mesh`).

    Raises:
      AssetError: no such file, not closed, or not to be followed by so many boxes.
    """
    file = Path(path).expanduser()
    changed = file.stat().st_mtime_ns if file.is_file() else 0
    return _load(str(file), changed, unit, parts, repair)


@lru_cache(maxsize=8)
def _load(path: str, changed: int, unit: float, parts: int, repair: str) -> MeshObject:
    del changed
    with jax.ensure_compile_time_eval():  # the first call may be inside of a trace
        return from_mesh(meshes.load_mesh(path, scale=unit, repair=repair), parts)


def from_mesh(mesh: meshes.Trimesh, parts: int) -> MeshObject:
    """The object of a mesh that has been checked; see `load`."""
    properties = mesh.mass_properties
    tensor, origin = np.asarray(properties.inertia) / properties.mass, np.asarray(properties.center_mass)
    axes = principal_axes(tensor)
    own = meshes.make_mesh(mesh.metadata["name"], (mesh.vertices - origin) @ axes, mesh.faces)
    inertia = np.diag(axes.T @ tensor @ axes).astype(np.float32)
    # An L has its bars along the axes of its file.
    frames = () if np.array_equal(axes, np.eye(3)) else (axes.T,)
    return MeshObject(own, fit_boxes(own, parts, frames=frames), inertia, axes, origin)


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
