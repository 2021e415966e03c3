"""Objects of the emulated hand: unions of primitives, signed distances, sampling.

Written in NumPy and independent of the code that training uses. The axis of capsules and cylinders is z.
"""

import dataclasses
from collections.abc import Sequence

import numpy as np

from dexsim_real.twin.plant.parameters import TrialParameters

SHAPES = ("sphere", "box", "cylinder", "capsule", "composition")
BODY_SHARE = 0.8  # size of a composition's body relative to a single body


@dataclasses.dataclass(frozen=True)
class Primitive:
    """A primitive, aligned with the object's axes."""

    kind: str  # "sphere", "box", "cylinder", "capsule"
    size: tuple[float, ...]  # m: radius; half extents; radius, half length
    place: tuple[float, float, float] = (0.0, 0.0, 0.0)  # m, centre in the object's frame


@dataclasses.dataclass(frozen=True)
class ObjectShape:
    """A union of primitives."""

    name: str
    parts: tuple[Primitive, ...]

    def distance(self, points: np.ndarray) -> np.ndarray:
        """Signed distance [...] m of points [..., 3] in the object's frame, negative inside.

        Inside a union it is a lower bound: the depth below the nearest surface of a primitive.
        """
        return np.min([_DISTANCE[part.kind](points - part.place, part.size) for part in self.parts], axis=0)

    def reach(self, direction: np.ndarray) -> float:
        """Extent in m of the object from its origin along a unit direction [3] of its frame."""
        return max(_reach(part, direction) + float(np.dot(part.place, direction)) for part in self.parts)


def _sphere(points: np.ndarray, size: tuple[float, ...]) -> np.ndarray:
    return np.linalg.norm(points, axis=-1) - size[0]


def _box(points: np.ndarray, size: tuple[float, ...]) -> np.ndarray:
    beyond = np.abs(points) - size
    outside = np.linalg.norm(np.maximum(beyond, 0.0), axis=-1)
    return outside + np.minimum(beyond.max(-1), 0.0)


def _cylinder(points: np.ndarray, size: tuple[float, ...]) -> np.ndarray:
    beyond = np.stack([np.hypot(points[..., 0], points[..., 1]) - size[0], np.abs(points[..., 2]) - size[1]], -1)
    return np.linalg.norm(np.maximum(beyond, 0.0), axis=-1) + np.minimum(beyond.max(-1), 0.0)


def _capsule(points: np.ndarray, size: tuple[float, ...]) -> np.ndarray:
    along = points[..., 2] - np.clip(points[..., 2], -size[1], size[1])
    return np.sqrt(points[..., 0] ** 2 + points[..., 1] ** 2 + along**2) - size[0]


_DISTANCE = {"sphere": _sphere, "box": _box, "cylinder": _cylinder, "capsule": _capsule}


def _reach(part: Primitive, direction: np.ndarray) -> float:
    x, y, z = np.abs(direction)
    if part.kind == "box":
        return float(np.dot(part.size, (x, y, z)))
    if part.kind == "cylinder":
        return float(part.size[0] * np.hypot(x, y) + part.size[1] * z)
    return float(part.size[0] + (part.size[1] * z if part.kind == "capsule" else 0.0))


def sample_shape(parameters: TrialParameters, rng: np.random.Generator, name: str | None = None) -> ObjectShape:
    """Sample the object of a trial: a cube to rotate; to grasp, one of `SHAPES`, or the named one."""
    which, body = rng.choice(SHAPES), rng.random() < 0.5
    if parameters.task == "rotate":
        edge = parameters.edge / 2
        return ObjectShape("box", (Primitive("box", (edge, edge, edge)),))
    name = name or str(which)
    half = tuple(float(h) for h in parameters.box_half)
    tube = parameters.cylinder_radius, parameters.cylinder_half
    if name == "composition":
        return _composition(parameters, "box" if body else "cylinder", half if body else tube)
    size = {"sphere": (parameters.sphere_radius,), "box": half, "cylinder": tube, "capsule": tube}[name]
    return ObjectShape(name, (Primitive(name, size),))


def _composition(parameters: TrialParameters, kind: str, size: tuple[float, ...]) -> ObjectShape:
    """A smaller box or cylinder with a capsule along z; the origin is in the middle."""
    body = tuple(BODY_SHARE * s for s in size)
    neck = parameters.neck_radius, parameters.neck_half
    out = body[-1] + neck[1]
    shift = (out + neck[1] + neck[0] - body[-1]) / 2
    parts = Primitive(kind, body, (0.0, 0.0, -shift)), Primitive("capsule", neck, (0.0, 0.0, out - shift))
    return ObjectShape("composition", parts)


# --- rotations -----------------------------------------------------------------------------------


def turn(axis: Sequence[float] | np.ndarray, angle: float) -> np.ndarray:
    """Quaternion (w, x, y, z) of a rotation about a unit axis."""
    return np.array([np.cos(angle / 2), *(np.sin(angle / 2) * np.asarray(axis, float))])


def product(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Product of two quaternions: the rotation a after b."""
    w, x, y, z = a
    return np.array([[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]]) @ b


def matrix(quat: np.ndarray) -> np.ndarray:
    """Rotation matrix [3, 3] of a unit quaternion."""
    w, x, y, z = quat
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
