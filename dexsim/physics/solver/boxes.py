"""Contacts of boxes with boxes and with capsules, in closed form, for the JAX backend."""

import functools

import jax
import jax.numpy as jnp
import numpy as np

from dexsim.geometry import sdf

POINTS = 13  # of one pair at most
_RING = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]], np.float32)
# Faces are taken where edges overlap hardly less, as where boxes lie almost flat: more points, and steady ones.
_BETTER, _LESS = 0.8, 1e-4
_EDGES = np.array([(i, j) for i in range(3) for j in range(3)])  # an axis of the one box, one of the other
# The twelve edges of a box: the axis that each runs along, and the side of the others that it is on (0 along itself).
_RUNS = np.repeat(np.eye(3, dtype=np.float32), 4, 0)
_SIDE = np.array([np.insert(ring, axis, 0) for axis in range(3) for ring in _RING], np.float32)
_TINY = 1e-12  # m^2, of gaps that count as equal


def box_box(
    position: jax.Array, rotation: jax.Array, size: jax.Array, centre: jax.Array, turn: jax.Array, other: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Gaps [13] m, points [13, 3] m midway and normals [13, 3] from the first box to the second; `sdf.FAR` where there
    is no contact.

    A face of one, the reference, meets the opposite face of the other: of all twelve it is the one along whose normal
    the boxes are farthest apart, or overlap least. Two edges meet where no faces do, or where they overlap far less.

    Args:
      position, rotation, size: [3] m, [3, 3] and half lengths [3] m of the first box.
      centre, turn, other: those of the second.
    """
    edges = _cross(position, rotation, size, centre, turn, other)
    mine = _apart(position, rotation, size, centre, turn, other)
    theirs = _apart(centre, turn, other, position, rotation, size)
    first = mine.max() >= theirs.max() - 1e-6
    pick = lambda a, b: jax.tree.map(functools.partial(jnp.where, first), a, b)  # noqa: E731
    (position, rotation, size), (centre, turn, other) = (
        pick(a, b)
        for a, b in (
            ((position, rotation, size), (centre, turn, other)),
            ((centre, turn, other), (position, rotation, size)),
        )
    )
    gap, point, normal = _clip(position, rotation, size, centre, turn, other, pick(mine, theirs).argmax())
    normal = jnp.broadcast_to(jnp.where(first, normal, -normal), point.shape)
    overlap = jnp.maximum(mine.max(), theirs.max())
    alone = (overlap < 0) & ((gap.min() >= 0) | (edges[0] > _BETTER * overlap + _LESS))
    gap = jnp.append(jnp.where(alone, sdf.FAR, gap), jnp.where(alone, edges[0], sdf.FAR))
    return gap, jnp.concatenate([point, edges[1][None]]), jnp.concatenate([normal, edges[2][None]])


def _cross(
    position: jax.Array, rotation: jax.Array, size: jax.Array, centre: jax.Array, turn: jax.Array, other: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Gap [], point [3] and normal [3] of the two edges along whose common normal the boxes are farthest apart."""
    away = centre - position
    one, two = rotation.T[_EDGES[:, 0]], turn.T[_EDGES[:, 1]]
    normal = jnp.cross(one, two)
    length = jnp.sqrt(jnp.sum(normal**2, -1) + 1e-12)
    normal = normal / length[:, None]
    normal = normal * jnp.where(normal @ away < 0, -1.0, 1.0)[:, None]
    reach = jnp.abs(normal @ rotation) @ size + jnp.abs(normal @ turn) @ other
    # Edges that are parallel have no common normal of their own.
    gaps = jnp.where(length > 1e-3, normal @ away - reach, -sdf.FAR)
    best = gaps.argmax()
    way = normal[best]
    # The middles of the edges that reach farthest toward the other box, and where they pass each other.
    mine = jnp.sign(way @ rotation) * size * (np.arange(3) != jnp.asarray(_EDGES)[best, 0]).astype(jnp.float32)
    theirs = -jnp.sign(way @ turn) * other * (np.arange(3) != jnp.asarray(_EDGES)[best, 1]).astype(jnp.float32)
    start, end = position + rotation @ mine, centre + turn @ theirs
    share = one[best] @ two[best]
    along = ((end - start) @ (one[best] - share * two[best])) / jnp.maximum(1 - share**2, 1e-6)
    return gaps[best], start + along * one[best] + 0.5 * gaps[best] * way, way


def _apart(
    position: jax.Array, rotation: jax.Array, size: jax.Array, centre: jax.Array, turn: jax.Array, other: jax.Array
) -> jax.Array:
    """Gap [6] along each of a box's face normals (+x, +y, +z, -x, -y, -z) to another box."""
    place = jnp.sum(rotation * (centre - position)[:, None], 0)
    reach = size + jnp.sum(jnp.abs(jnp.sum(rotation[:, :, None] * turn[:, None, :], 0)) * other[None], -1)
    return jnp.concatenate([place - reach, -place - reach])


def _clip(
    position: jax.Array,
    rotation: jax.Array,
    size: jax.Array,
    centre: jax.Array,
    turn: jax.Array,
    other: jax.Array,
    face: jax.Array,
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Gaps [12], points [12, 3] and the normal [3] of that part of the incident face which lies over a box's `face`.

    Its corners are ends of the incident face's edges, where those are cut off at the rim, and corners of the
    reference face.
    """
    # The face in its own frame: x and y along it, z outward.
    order = (face + jnp.array([1, 2, 0])) % 3
    along = rotation[:, order].T * jnp.stack([1.0, 1.0, jnp.where(face < 3, 1.0, -1.0)])[:, None]
    half = size[order]
    local = jnp.sum(along * (centre - position)[None], 1) - half * jnp.array([0.0, 0.0, 1.0])
    axes = jnp.sum(along[:, :, None] * turn[None], 1)  # columns: the other box's axes there

    # The face of the other box that is most opposed to the normal, as a ring of corners.
    down = jnp.argmax(jnp.abs(axes[2]))
    against = jnp.where(axes[2, down] > 0, -1.0, 1.0)
    pick = (down + jnp.array([1, 2, 0])) % 3  # two edges' directions, then the normal's
    edges, wide = axes[:, pick], other[pick]
    middle = local + against * wide[2] * edges[:, 2]
    corner = middle[None] + (_RING[:, :1] * wide[0]) * edges[:, 0][None] + (_RING[:, 1:] * wide[1]) * edges[:, 1][None]
    way = jnp.roll(corner, -1, 0) - corner

    # Which stretch of each edge lies over the reference face.
    flat = jnp.where(jnp.abs(way[:, :2]) < 1e-9, 1e-9, way[:, :2])
    flank = half[:2][None]
    one, two = (-flank - corner[:, :2]) / flat, (flank - corner[:, :2]) / flat
    begin = jnp.clip(jnp.minimum(one, two).max(1), 0.0, None)
    end = jnp.clip(jnp.maximum(one, two).min(1), None, 1.0)
    over = begin <= end
    started, ended = (corner + t[:, None] * way for t in (begin, end))
    # The reference face's own corners, where they lie under the incident face.
    rim = _RING * flank
    normal = edges[:, 2]
    steep = jnp.where(jnp.abs(normal[2]) < 1e-6, 1e-6, normal[2])
    height = middle[2] - jnp.sum((rim - middle[:2][None]) * normal[:2][None], -1) / steep
    inner = jnp.concatenate([rim, height[:, None]], -1)
    place = (inner - middle[None]) @ edges[:, :2]
    under = jnp.all(jnp.abs(place) < wide[:2][None] - 1e-7, -1)

    points = jnp.concatenate([started, ended, inner])
    # An edge that ends over the face ends where the next begins.
    gap = jnp.where(jnp.concatenate([over, over & (end < 1.0), under]), points[:, 2], sdf.FAR)
    halfway = points - 0.5 * points[:, 2:] * jnp.array([[0.0, 0.0, 1.0]])
    world = position[None] + sum(halfway[:, k, None] * along[k][None] for k in range(3)) + (half[2] * along[2])[None]
    return gap, world, along[2]


def capsule_box(centre: jax.Array, half_axis: jax.Array, size: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Where [2] on a capsule's axis, from -1 to 1, it meets a box, and whether [] there is a second place.

    The same two places as C MuJoCo's: the axis' nearest point to the box, and the end of that part of it which lies
    over the same face, on the side to which the axis leads there. A capsule that leans a little rests on both.

    Args:
      centre, half_axis: [3] m, of the capsule in the box's frame.
      size: [3] m, half lengths of the box.
    """
    ratio = size / jnp.maximum(jnp.abs(half_axis), 1e-9)  # how often half the axis goes into half the box
    up = half_axis > 0
    tip_gap, tip, face = _nearest_tip(centre, half_axis, size)
    edge_gap, place, along, end, run, side = _nearest_edge(centre, half_axis, size)
    # The ends of an edge are corners; `differ` says along which axes the capsule leads away from this one.
    at_corner = end != 0
    differ = up != (jnp.where(run > 0, end, side) > 0)
    by_tip = tip_gap <= edge_gap + _TINY
    from_tip = -tip * _exit(centre + tip * half_axis, -tip * half_axis, size, face)
    from_corner, corner_has = _beyond_corner(place, half_axis, ratio, differ)
    from_edge, edge_has = _beyond_edge(place, along, half_axis, ratio, differ, up, run)
    first = jnp.where(by_tip, tip, place)
    step = jnp.where(by_tip, from_tip, jnp.where(at_corner, from_corner, from_edge))
    second = jnp.where(by_tip, jnp.any(face), jnp.where(at_corner, corner_has, edge_has))
    return jnp.stack([first, first + step]), second


def _nearest_tip(centre: jax.Array, half_axis: jax.Array, size: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Squared distance [] m^2 of the end of a capsule's axis that is nearer to a face, which end [] it is (-1, 1), and
    the axis across that face [3] bool; none where the end is inside the box. An end over no face is `sdf.FAR` away."""
    sign = jnp.array([-1.0, 1.0])
    tips = centre[None] + sign[:, None] * half_axis[None]
    beyond = jnp.maximum(jnp.abs(tips) - size[None], 0.0)
    gap = jnp.where(jnp.sum(beyond > 0, -1) > 1, sdf.FAR, jnp.sum(beyond**2, -1))
    best = gap.argmin()
    return gap[best], sign[best], beyond[best] > 0


def _exit(start: jax.Array, way: jax.Array, size: jax.Array, face: jax.Array) -> jax.Array:
    """How many times [] `way` [3] leads from `start` [3] to the rim of a face, whose axis is `face` [3]; 2 at most."""
    room = (size - jnp.sign(way) * start) / jnp.maximum(jnp.abs(way), 1e-9)
    return jnp.minimum(jnp.where(face, 2.0, room).min(), 2.0)


def _nearest_edge(
    centre: jax.Array, half_axis: jax.Array, size: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array, jax.Array, jax.Array]:
    """The edge that a capsule's axis comes nearest to: squared distance [] m^2, places on axis and edge [] from -1 to
    1, the edge's end [] (-1, 1; 0 for none) that bounds it, the axis along which the edge runs [3], and its sides
    [3]."""
    away = _SIDE * size[None] - centre[None]
    reach, short = jnp.sum(_RUNS * size[None], -1), jnp.sum(_RUNS * half_axis[None], -1)
    u, v = -reach * jnp.sum(_RUNS * away, -1), jnp.sum(away * half_axis[None], -1)
    a, b, c = reach**2, -reach * short, jnp.sum(half_axis**2)
    det = a * c - b**2
    crosses = det > 1e-6 * a * c  # the two are not parallel
    det = jnp.where(crosses, det, 1.0)
    along, place = (c * u - b * v) / det, (a * v - b * u) / det
    # Beyond an end of the edge, what is nearest to that end; beyond the axis' end, what is nearest to it.
    # The end of the edge counts as in C MuJoCo: also where the end of the axis then leads away from it again.
    end = jnp.where(jnp.abs(along) > 1, jnp.sign(along), 0.0)
    place = jnp.where(end != 0, (v - end * b) / c, place)
    over = jnp.abs(place) > 1
    along = jnp.where(over, (u - jnp.sign(place) * b) / a, along)
    end = jnp.where(over & (jnp.abs(along) > 1), jnp.sign(along), end)
    along, place = jnp.clip(along, -1.0, 1.0), jnp.clip(place, -1.0, 1.0)
    apart = away - place[:, None] * half_axis[None] + (reach * along)[:, None] * _RUNS
    gap = jnp.where(crosses, jnp.sum(apart**2, -1), sdf.FAR)
    best = gap.argmin()
    return gap[best], place[best], along[best], end[best], jnp.asarray(_RUNS)[best], jnp.asarray(_SIDE)[best]


def _beyond_corner(
    place: jax.Array, half_axis: jax.Array, ratio: jax.Array, differ: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """The step [] along the axis from its nearest point, at a corner, to the second place, and whether there is one."""
    count = jnp.sum(differ)
    way = jnp.where(count == 1, 1.0, -1.0)
    alone = jnp.where(count == 1, differ, ~differ)  # the axis along which it leads otherwise than along both others
    steep = jnp.sum(jnp.where(alone, half_axis, 0.0)) ** 2 > 0.5 * jnp.sum(half_axis**2)
    by_edge = jnp.minimum(1 - way * place, 2 * jnp.sum(jnp.where(alone, ratio, 0.0)))
    over_face = -jnp.minimum(1 + way * place, 2 * jnp.where(alone, sdf.FAR, ratio).min())
    return way * jnp.where(steep, by_edge, over_face), (count == 1) | (count == 2)


def _beyond_edge(
    place: jax.Array,
    along: jax.Array,
    half_axis: jax.Array,
    ratio: jax.Array,
    differ: jax.Array,
    up: jax.Array,
    run: jax.Array,
) -> tuple[jax.Array, jax.Array]:
    """`_beyond_corner` from the middle of an edge: over the face to which the capsule leans less."""
    across = differ & (run == 0)
    flat = jnp.arange(3) == jnp.where(run > 0, -1.0, jnp.abs(half_axis)).argmax()
    hit = jnp.any(across & flat)
    way = jnp.where(hit, 1.0, -1.0)
    step = jnp.minimum(1 - way * place, 2 * jnp.sum(jnp.where(flat, ratio, 0.0)))
    left = jnp.where(jnp.any(up & (run > 0)) == hit, 1 - along, 1 + along)
    return way * jnp.minimum(step, left * jnp.sum(ratio * run)), jnp.sum(across) == 1
