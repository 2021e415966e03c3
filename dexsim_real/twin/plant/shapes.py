"""Objects of the emulated hand: unions of primitives, signed distances, sampling; rotations.

Written in NumPy and independent of the code that training uses. The axis of capsules and cylinders is z.
"""

import dataclasses
from collections.abc import Sequence

import numpy as np

from dexsim_real.twin.plant.parameters import TrialParameters

SHAPES = ("sphere", "box", "cylinder", "capsule", "composition")
_Z_TO_X = (0.5**0.5, 0.0, 0.5**0.5, 0.0)
BODY_SHARE = 0.8  # size of a composition's body relative to a single body


@dataclasses.dataclass(frozen=True)
class Primitive:
    """A primitive at its pose in the object's frame."""

    kind: str  # "sphere", "box", "cylinder", "capsule"
    size: tuple[float, ...]  # m: radius; half extents; radius, half length
    place: tuple[float, float, float] = (0.0, 0.0, 0.0)  # m
    quat: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)

    def distance(self, points: np.ndarray) -> np.ndarray:
        """Signed distance [...] m of points [..., 3] in the object's frame, negative inside."""
        local = (points - self.place) @ matrix(self.quat)
        x, y, z = np.moveaxis(local, -1, 0)
        if self.kind in ("sphere", "capsule"):
            half = self.size[1] if self.kind == "capsule" else 0.0
            return np.sqrt(x**2 + y**2 + (z - np.clip(z, -half, half)) ** 2) - self.size[0]
        if self.kind == "cylinder":
            beyond = np.stack([np.hypot(x, y) - self.size[0], np.abs(z) - self.size[1]], -1)
        else:
            beyond = np.abs(local) - self.size
        return np.linalg.norm(np.maximum(beyond, 0.0), axis=-1) + np.minimum(beyond.max(-1), 0.0)

    def reach(self, direction: np.ndarray) -> float:
        """Extent in m from the object's origin along a unit direction [3] of its frame."""
        x, y, z = np.abs(direction @ matrix(self.quat))
        if self.kind == "box":
            extent = np.dot(self.size, (x, y, z))
        elif self.kind == "cylinder":
            extent = self.size[0] * np.hypot(x, y) + self.size[1] * z
        else:
            extent = self.size[0] + (self.size[1] * z if self.kind == "capsule" else 0.0)
        return float(extent) + float(np.dot(self.place, direction))


@dataclasses.dataclass(frozen=True)
class ObjectShape:
    """A union of primitives."""

    name: str
    parts: tuple[Primitive, ...]

    def distance(self, points: np.ndarray) -> np.ndarray:
        """As `Primitive.distance`; inside a union the depth below the nearest surface of a primitive."""
        return np.min([part.distance(points) for part in self.parts], axis=0)

    def reach(self, direction: np.ndarray) -> float:
        """As `Primitive.reach`."""
        return max(part.reach(direction) for part in self.parts)

    def below(self, quat: np.ndarray) -> float:
        """Extent in m from the object's origin toward the palm, at an orientation [4]."""
        return self.reach(matrix(quat).T @ [-1.0, 0.0, 0.0])


def sample_shape(
    parameters: TrialParameters,
    rng: np.random.Generator,
    name: str | None = None,
    axis: Sequence[float] | np.ndarray = (1.0, 0.0, 0.0),
) -> ObjectShape:
    """Sample the object of a trial: a cube to rotate, a face of it across `axis`, or a box or upright cylinder; to
    grasp, one of `SHAPES`, or the named one."""
    which, box_body = rng.choice(SHAPES), rng.random() < 0.5
    if "edge" in parameters.value:
        a, b, c = (parameters.edge / 2 * parameters.value.get("proportions", np.ones(3))).tolist()
        if box_body or "proportions" not in parameters.value:
            # The shortest turn from x to the axis, as in training: the object's frame, whose identity is aligned with
            # the palm, is not that of the faces.
            stand = np.array([1 + axis[0], 0.0, -axis[2], axis[1]])
            w, x, y, z = (stand / np.linalg.norm(stand)).tolist()
            return ObjectShape("box", (Primitive("box", (a, b, c), quat=(w, x, y, z)),))
        return ObjectShape("cylinder", (Primitive("cylinder", (b, a), quat=_Z_TO_X),))
    name = name or str(which)
    half = tuple(float(h) for h in parameters.box_half)
    tube = parameters.cylinder_radius, parameters.cylinder_half
    if name != "composition":
        size = {"sphere": (parameters.sphere_radius,), "box": half, "cylinder": tube, "capsule": tube}[name]
        return ObjectShape(name, (Primitive(name, size),))
    # A smaller box or cylinder with a capsule along z as its neck; the origin is in the middle.
    kind, body = ("box", half) if box_body else ("cylinder", tube)
    body = tuple(BODY_SHARE * s for s in body)
    neck = parameters.neck_radius, parameters.neck_half
    out = body[-1] + neck[1]
    shift = (out + neck[1] + neck[0] - body[-1]) / 2
    parts = Primitive(kind, body, (0.0, 0.0, -shift)), Primitive("capsule", neck, (0.0, 0.0, out - shift))
    return ObjectShape("composition", parts)


def turn(axis: Sequence[float] | np.ndarray, angle: float) -> np.ndarray:
    """Quaternion (w, x, y, z) of a rotation about a unit axis."""
    return np.array([np.cos(angle / 2), *(np.sin(angle / 2) * np.asarray(axis, float))])


def product(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Product of two quaternions: the rotation a after b."""
    w, x, y, z = a
    return np.array([[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]]) @ b


def matrix(quat: Sequence[float] | np.ndarray) -> np.ndarray:
    """Rotation matrix [3, 3] of a unit quaternion."""
    w, x, y, z = quat
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
