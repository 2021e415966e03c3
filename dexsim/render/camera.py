"""A pinhole camera in the palm frame."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np


@dataclass(frozen=True, kw_only=True)
class Camera:
    """A pinhole camera that looks at a point of the palm frame."""

    azimuth: float = 0.0
    """Turn about `up` [deg], right-handed; 0 looks from +z (from +x where `up` is along z)."""
    elevation: float = 20.0
    """Height of the camera over the plane across `up` [deg]."""
    distance: float = 0.5
    """From the target to the camera [m]."""
    target: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """The point in the middle of the picture [m], palm frame."""
    up: tuple[float, float, float] = (-1.0, 0.0, 0.0)
    """Against gravity. (-1, 0, 0) is a hand held palm down, (1, 0, 0) palm up."""
    field_of_view: float = 30.0
    """Vertical opening angle [deg]."""


class CameraView(NamedTuple):
    """A camera ready for a picture of one size."""

    origin: np.ndarray  # [3], m
    axes: np.ndarray  # [3, 3], rows right, up, back
    scale: float  # pixels per unit slope
    size: tuple[int, int]  # width, height; the optical axis is in the middle

    def rays(self) -> np.ndarray:
        """Directions [H, W, 3] through the pixels' middles, of length one along the optical axis."""
        width, height = self.size
        x = (np.arange(width) + 0.5 - width / 2) / self.scale
        y = (height / 2 - 0.5 - np.arange(height)) / self.scale
        return x[None, :, None] * self.axes[0] + y[:, None, None] * self.axes[1] - self.axes[2]

    def project(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Pixels [..., 2] and depths [...] of points [..., 3]; pixel (i, j) covers [i, i+1) x [j, j+1), y down."""
        local = (np.asarray(points) - self.origin) @ self.axes.T
        depth = -local[..., 2]
        scale = self.scale / np.maximum(depth, 1e-6)
        width, height = self.size
        return np.stack([width / 2 + local[..., 0] * scale, height / 2 - local[..., 1] * scale], -1), depth


def look(camera: Camera, size: tuple[int, int], supersample: int = 1) -> CameraView:
    """The view of `camera` for a picture of `size` (width, height), with `supersample`² rays a pixel."""
    up = unit(np.asarray(camera.up, np.float64))
    reference = np.array([0.0, 0.0, 1.0]) if abs(up[2]) < 0.9 else np.array([1.0, 0.0, 0.0])
    forward = unit(reference - up * (reference @ up))
    azimuth, elevation = np.deg2rad(camera.azimuth), np.deg2rad(camera.elevation)
    level = np.cos(azimuth) * forward + np.sin(azimuth) * np.cross(up, forward)
    back = np.cos(elevation) * level + np.sin(elevation) * up
    # The camera's own up leans back with the elevation; this form also holds when looking straight down.
    upward = np.cos(elevation) * up - np.sin(elevation) * level
    axes = np.stack([np.cross(upward, back), upward, back])
    width, height = size[0] * supersample, size[1] * supersample
    scale = height / 2 / np.tan(np.deg2rad(camera.field_of_view) / 2)
    origin = np.asarray(camera.target, np.float64) + camera.distance * back
    return CameraView(origin, axes, float(scale), (width, height))


def unit(vector: np.ndarray) -> np.ndarray:
    """Vectors [..., 3] of length one."""
    return vector / np.linalg.norm(vector, axis=-1, keepdims=True)
