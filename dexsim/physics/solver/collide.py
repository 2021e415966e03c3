"""Closed-form contacts of the hand's spheres, capsules and planes with primitives, and of boxes with boxes, for the
JAX backend.

MJX finds contacts with cylinders by a gradient descent, up to a millimetre too shallow, and those with boxes by
clipping polygons, at other points than C MuJoCo: both take long to compile. Here a sphere meets a primitive where
its distance function says, and a capsule where the balls at one or two places of its axis do (`Balls`).
"""

import dataclasses
import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from dexsim.core.pytree import Array
from dexsim.geometry import sdf
from dexsim.physics.solver.boxes import POINTS, box_box, capsule_box

_BOXES = ("box", "box")
KINDS = {
    int(mujoco.mjtGeom.mjGEOM_SPHERE): "sphere",
    int(mujoco.mjtGeom.mjGEOM_BOX): "box",
    int(mujoco.mjtGeom.mjGEOM_CAPSULE): "capsule",
    int(mujoco.mjtGeom.mjGEOM_CYLINDER): "cylinder",
    int(mujoco.mjtGeom.mjGEOM_ELLIPSOID): "ellipsoid",
    int(mujoco.mjtGeom.mjGEOM_PLANE): "plane",
}
# Bisections for the nearest point of a capsule's axis: a 4,096th of its length.
_HALVINGS = 12
# Distances along an axis that change by less than this share of the way count as equal, and ends of
# a nearest stretch closer than this, m, as one point.
_SLOPE, _SAME = 1e-3, 1e-3


@dataclasses.dataclass(frozen=True, eq=False)
class Balls:
    """Pairs of the hand's spheres and capsules with one kind of primitive.

    A capsule is met as balls at two places of its axis, so all are balls in the end: on a box where C MuJoCo has them
    (`boxes.capsule_box`), on other kinds at the ends of the stretch that is nearest.
    """

    kind: str
    sphere: np.ndarray  # [S, 2] geoms of the hand and primitives
    capsule: np.ndarray  # [P, 2]

    def find(self, position: jax.Array, rotation: jax.Array, size: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
        """Gaps [S + 2 P], points and normals [S + 2 P, 3]; see `Collider.touch`."""
        mine, other = self.sphere.T
        centre, radius = position[mine], size[mine, 0]
        same: Array = np.zeros(len(mine), bool)
        if len(self.capsule):
            mine, theirs = self.capsule.T
            ends, one = jax.vmap(_over_box if self.kind == "box" else functools.partial(_nearest_stretch, self.kind))(
                position[mine], rotation[mine][:, :, 2], size[mine, 1], position[theirs], rotation[theirs], size[theirs]
            )
            centre = jnp.concatenate([centre, ends.reshape(-1, 3)])
            radius = jnp.concatenate([radius, jnp.repeat(size[mine, 0], 2)])
            same = jnp.concatenate([same, jnp.stack([jnp.zeros_like(one), one], -1).reshape(-1)])
            other = np.concatenate([other, np.repeat(theirs, 2)])
        gap, point, normal = jax.vmap(functools.partial(_ball, self.kind))(
            centre, radius, position[other], rotation[other], size[other]
        )
        return jnp.where(same, sdf.FAR, gap), point, normal


@dataclasses.dataclass(frozen=True, eq=False)
class Patches:
    """Pairs of planes of the hand with one kind of primitive, or of boxes with boxes."""

    meet: Callable[..., tuple[jax.Array, jax.Array, jax.Array]]
    pairs: np.ndarray  # [P, 2] planes (or boxes) and primitives

    def find(self, position: jax.Array, rotation: jax.Array, size: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
        """As `Balls.find`."""
        planes, others = ((position[g], rotation[g], size[g]) for g in self.pairs.T)
        gap, point, normal = (part.reshape(-1, *part.shape[2:]) for part in jax.vmap(self.meet)(*planes, *others))
        return gap, point, normal


@dataclasses.dataclass(frozen=True, eq=False)
class Collider:
    """What may touch what: `touch` finds the candidates, of which candidate c belongs to `pair[c]`."""

    groups: tuple[Balls | Patches, ...]
    pair: np.ndarray  # [C] index of the explicit pair

    def touch(
        self, position: jax.Array, rotation: jax.Array, size: jax.Array
    ) -> tuple[jax.Array, jax.Array, jax.Array]:
        """All candidates.

        Args:
          position, rotation, size: of all geoms: [G, 3] m, [G, 3, 3] and [G, 3] m as MuJoCo has them.

        Returns:
          Distances [C] m (negative inside), points [C, 3] m midway between the surfaces, and unit
          normals [C, 3] from the pair's first geom to its second.
        """
        contacts = [group.find(position, rotation, size) for group in self.groups]
        gap, point, normal = (jnp.concatenate(parts) for parts in zip(*contacts, strict=True))
        return gap, point, normal


def find_collider(model: mujoco.MjModel) -> Collider | None:
    """The collider of a model's explicit pairs; None if one of them has no closed form here."""
    rows: dict[tuple[str, str], list[int]] = {}
    for pair in range(model.npair):
        first, second = (
            KINDS.get(int(model.geom_type[geoms[pair]]), "") for geoms in (model.pair_geom1, model.pair_geom2)
        )
        if second not in sdf.KINDS or (first not in ("plane", "sphere", "capsule") and (first, second) != _BOXES):
            return None
        rows.setdefault((first, second), []).append(pair)
    geoms = np.stack([model.pair_geom1, model.pair_geom2], -1)
    groups: list[Balls | Patches] = []
    order: list[np.ndarray] = []
    for second in dict.fromkeys(second for _, second in rows):
        plane, sphere, capsule, box = (
            np.array(rows.get((first, second), []), int) for first in ("plane", "sphere", "capsule", "box")
        )
        for flat, (meet, count) in ((plane, _PLANE[second]), (box, (box_box, POINTS))):
            if flat.size:
                groups.append(Patches(meet, geoms[flat]))
                order.append(np.repeat(flat, count))
        if sphere.size or capsule.size:
            groups.append(Balls(second, geoms[sphere], geoms[capsule]))
            order += [sphere, np.repeat(capsule, 2)]
    return Collider(tuple(groups), np.concatenate(order)) if groups else None


def _ball(
    kind: str, centre: jax.Array, radius: jax.Array, position: jax.Array, rotation: jax.Array, size: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """A ball round `centre` [3] against one primitive."""
    local = sdf.to_local(centre[None], position, rotation)
    gap, pullback = jax.vjp(lambda p: sdf.primitive_distance(kind, p, size), local)
    (outward,) = pullback(jnp.ones_like(gap))
    outward = outward[0] / jnp.sqrt(jnp.sum(outward[0] ** 2) + 1e-12)
    normal = -jnp.stack([sum(rotation[row, k] * outward[k] for k in range(3)) for row in range(3)])
    gap = gap[0] - radius
    return gap, centre + normal * (radius + 0.5 * gap), normal


def _in_primitive(
    centre: jax.Array, axis: jax.Array, position: jax.Array, rotation: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Middle [3] and direction [3] of a segment in a primitive's frame."""
    start = sdf.to_local(centre[None], position, rotation)[0]
    return start, sdf.to_local((centre + axis)[None], position, rotation)[0] - start


def _over_box(
    centre: jax.Array,
    axis: jax.Array,
    half: jax.Array,
    position: jax.Array,
    rotation: jax.Array,
    size: jax.Array,
) -> tuple[jax.Array, jax.Array]:
    """The places [2, 3] of a segment that meet a box, and whether there is one only."""
    start, along = _in_primitive(centre, axis, position, rotation)
    place, second = capsule_box(start, half * along, size)
    return centre[None] + (half * place)[:, None] * axis[None], ~second


def _nearest_stretch(
    kind: str,
    centre: jax.Array,
    axis: jax.Array,
    half: jax.Array,
    position: jax.Array,
    rotation: jax.Array,
    size: jax.Array,
) -> tuple[jax.Array, jax.Array]:
    """The ends [2, 3] of that part of a segment which is nearest to a convex primitive, and whether they are one.

    Along a line the distance to what is convex is convex: bisection on its slope.
    """
    start, along = _in_primitive(centre, axis, position, rotation)
    tilt = jnp.array([_SLOPE, -_SLOPE])

    def halve(_, bracket):
        low, high = bracket
        middle = 0.5 * (low + high)
        points = start[None] + middle[:, None] * along[None]
        _, slope = jax.jvp(
            lambda p: sdf.primitive_distance(kind, p, size), (points,), (jnp.broadcast_to(along, points.shape),)
        )
        rising = slope + tilt > 0
        return jnp.where(rising, low, middle), jnp.where(rising, middle, high)

    low, high = jax.lax.fori_loop(0, _HALVINGS, halve, (jnp.full(2, -half), jnp.full(2, half)))
    # An end of the segment itself, exactly, where the bracket has closed on it.
    step = 2 * half / 2**_HALVINGS
    place = jnp.where(low <= -half + 0.5 * step, -half, jnp.where(high >= half - 0.5 * step, half, 0.5 * (low + high)))
    return centre[None] + place[:, None] * axis[None], jnp.abs(place[1] - place[0]) < _SAME


def _on_plane(position: jax.Array, rotation: jax.Array, points: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Lowest points [N, 3] of a body against a plane."""
    normal = rotation[:, 2]
    gap = jnp.asarray(sum((points[:, k] - position[k]) * normal[k] for k in range(3)))
    return gap, points - 0.5 * gap[:, None] * normal[None], jnp.broadcast_to(normal, points.shape)


def _plane_sphere(position, rotation, _, centre, turn, size):
    return _on_plane(position, rotation, (centre - rotation[:, 2] * size[0])[None])


def _plane_capsule(position, rotation, _, centre, turn, size):
    ends = jnp.array([[size[1]], [-size[1]]]) * turn[:, 2][None]
    return _on_plane(position, rotation, centre[None] + ends - (rotation[:, 2] * size[0])[None])


def _plane_box(position, rotation, _, centre, turn, size):
    signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], np.float32)
    corners = sum((signs[:, k] * size[k])[:, None] * turn[:, k][None] for k in range(3))
    return _on_plane(position, rotation, centre[None] + corners)


def _plane_ellipsoid(position, rotation, _, centre, turn, size):
    local = jnp.sum(turn * rotation[:, 2, None], 0) * size
    local = local / jnp.sqrt(jnp.sum(local**2) + 1e-20)
    return _on_plane(position, rotation, (centre - jnp.sum(turn * (local * size)[None], 1))[None])


def _plane_cylinder(position, rotation, _, centre, turn, size):
    """The lowest point of each disk, and two more of the lower disk, 120 degrees apart."""
    normal, axis = rotation[:, 2], turn[:, 2]
    share = jnp.sum(normal * axis)
    axis = jnp.where(share > 0, -axis, axis)  # downwards
    down = axis * -jnp.abs(share) - normal
    length = jnp.sqrt(jnp.sum(down**2) + 1e-20)
    down = jnp.where(length < 1e-6, turn[:, 0], down / jnp.maximum(length, 1e-6)) * size[0]
    side = jnp.cross(down, axis) * np.sqrt(0.75).astype(np.float32)
    axis = axis * size[1]
    points = jnp.stack([axis + down, down - axis, axis - 0.5 * down + side, axis - 0.5 * down - side])
    return _on_plane(position, rotation, centre[None] + points)


# How a plane meets a primitive, in how many points.
_PLANE = {
    "sphere": (_plane_sphere, 1),
    "capsule": (_plane_capsule, 2),
    "box": (_plane_box, 8),
    "cylinder": (_plane_cylinder, 4),
    "ellipsoid": (_plane_ellipsoid, 1),
}
