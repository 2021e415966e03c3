"""What is grasped: unions of a few primitives whose sizes are drawn at every episode start.

One compiled model has a fixed slot for each kind of primitive that the shapes asked for need. An object switches slots
on and sizes them, so spheres, boxes, cylinders, capsules and compositions share one batch; collision and touch read the
same sizes. A sphere is the capsule slot with next to no length. The slots of a mesh are the boxes that follow it.
"""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from dexsim.core.pytree import leaf, pytree_dataclass, static
from dexsim.core.ranges import sample_extreme, uniform, uniforms
from dexsim.geometry import rotations, sdf
from dexsim.objects.config import INACTIVE_SIZE, KINDS, PROPERTY_RANGES, SHAPES, SLOTS, ObjectConfig, load_mesh_object

_COMPOSITION_SCALE = 0.8  # size of a composition's box or cylinder, relative to a single one
_SPHERE_HALF_LENGTH = 1e-4  # m, half-length of a capsule that plays a sphere


@pytree_dataclass
class ObjectParams:
    """One drawn object; every leaf may differ between environments."""

    shape_index: jax.Array = leaf("[] int32, into SHAPES")
    size: jax.Array = leaf("[K, 3] m")
    position: jax.Array = leaf("[K, 3] m, slot centres in the object's frame")
    active: jax.Array = leaf("[K] bool")
    mass: jax.Array = leaf("[] kg")
    inertia: jax.Array = leaf("[3] kg m^2 about the centre of mass, along the object's axes")
    com: jax.Array = leaf("[3] m")
    friction: jax.Array = leaf("[] sliding on the fingertips")
    link_friction: jax.Array = leaf("[] sliding on the rest of the hand")
    contact: jax.Array = leaf("[2] stiffness N/m and damping ratio of a contact")
    quat: jax.Array | None = leaf("[K, 4] slot orientations in the object's frame; None: aligned", default=None)
    kinds: tuple[str, ...] = static(default=SLOTS)
    extreme: jax.Array | None = leaf("[] bool, every value is at an end of its range; None: never", default=None)

    def shape(self) -> sdf.Shape:
        """The union of primitives, for the taxels."""
        if self.quat is None:
            rotation = jnp.broadcast_to(jnp.eye(3), (len(self.kinds), 3, 3))
        else:
            rotation = rotations.quat_to_matrix(self.quat)
        return sdf.Shape(self.kinds, self.size, self.position, rotation, self.active)


def bounding_radius(size: jax.Array, kinds: tuple[str, ...]) -> jax.Array:
    """Radius [K] of the sphere round each slot's primitive, for the broad phase."""
    radius = {
        "box": lambda s: jnp.sqrt(jnp.sum(s * s)),
        "capsule": lambda s: s[0] + s[1],
        "cylinder": lambda s: jnp.hypot(s[0], s[1]),
    }
    return jnp.stack([radius[kind](size[k]) for k, kind in enumerate(kinds)])


def extent(object: ObjectParams, direction: jax.Array) -> jax.Array:
    """How far [] m the object reaches along a unit `direction` [3] of its own frame."""
    reaches, local = [], jnp.abs(rotations.rotate_inverse(object.shape().rotation, direction[None]))
    for along, kind, (a, b, c) in zip(local, object.kinds, object.size, strict=True):
        reach_of = {
            "box": along[0] * a + along[1] * b + along[2] * c,
            "capsule": a + b * along[2],
            "cylinder": a * jnp.hypot(along[0], along[1]) + b * along[2],
        }
        reaches.append(reach_of[kind])
    reach = jnp.stack(reaches) + jnp.sum(object.position * direction[None], -1)
    return jnp.max(jnp.where(object.active, reach, -jnp.inf))


def sample_object(key: jax.Array, config: ObjectConfig, shape_index: jax.Array | None = None) -> ObjectParams:
    """Draw one object, of a kind in `config.shapes` or of the given one (index into SHAPES), or the mesh. Raises
    AssetError: the mesh is refused, see `dexsim.objects.mesh.load`."""
    keys, extreme, quat = jax.random.split(key, 8), sample_extreme(key, config.extremes), None
    kinds = config.slots
    if config.mesh:
        mesh_object = load_mesh_object(config)
        boxes, factor = mesh_object.boxes, uniform(keys[1], config.mesh_size, extreme)
        size, position = factor * jnp.asarray(boxes.size), factor * jnp.asarray(boxes.position)
        quat, active = jnp.asarray(boxes.quat), jnp.ones(len(size), bool)
        shape_index = jnp.int32(KINDS.index("mesh"))
        plain = factor**2 * jnp.asarray(mesh_object.inertia)
    else:
        if shape_index is None:
            allowed = jnp.array([SHAPES.index(name) for name in config.shapes])
            shape_index = jax.random.choice(keys[0], allowed)
        shape_index = shape_index.astype(jnp.int32)
        slots = np.array([SLOTS.index(slot) for slot in kinds])
        size, position, active = (part[slots] for part in _sample_slots(keys[1], shape_index, config, extreme))
        mass, com, inertia = _mass_properties(kinds, size, position, active)
        position = position - com[None]  # the origin is the centre of a uniform solid
        plain = inertia / mass
    properties = _fields(_sample_properties(keys, config, extreme), plain)
    return ObjectParams(shape_index, size, position, active, quat=quat, kinds=kinds, extreme=extreme, **properties)


# --- properties: what an object is beside its shape, by the names of `PROPERTY_RANGES` -----------


def resample_properties(
    key: jax.Array, object: ObjectParams, config: ObjectConfig, plain: jax.Array, names: tuple[str, ...]
) -> ObjectParams:
    """The same object with other properties; an extreme one stays one. Its shape stays: the start was chosen for it.

    Args:
      plain: [3] m^2, inertia of its shape as a uniform solid of 1 kg.
      names: the ranges, of `PROPERTY_RANGES`, that are drawn.
    """
    drawn = _sample_properties(jax.random.split(key, 8), config, object.extreme)
    properties = _properties_of(object, plain) | {name: drawn[name] for name in names}
    return dataclasses.replace(object, **_fields(properties, plain))


def toward_nominal(object: ObjectParams, config: ObjectConfig, plain: jax.Array, scale: jax.Array) -> ObjectParams:
    """A drawn object with its properties nearer to nominal: mass, inertia, centre of mass, friction, contact.

    Args:
      plain: [3] m^2, inertia of its shape as a uniform solid of 1 kg.
      scale: [] in [0, 1]; 0 is nominal exactly, 1 leaves the object as it is.
    """
    restitution = damping_ratio(sum(config.restitution) / 2)
    fixed: dict[str, Any] = {"com_offset": 0.0, "inertia_scale": 1.0, "restitution": restitution}
    near = {}
    for name, value in _properties_of(object, plain).items():
        middle = fixed[name] if name in fixed else sum(getattr(config, name)) / 2
        near[name] = middle + scale * (value - middle)
    return dataclasses.replace(object, **_fields(near, plain))


def _sample_properties(keys: jax.Array, config: ObjectConfig, extreme: jax.Array | None) -> dict[str, jax.Array]:
    """One value of each of `PROPERTY_RANGES`; "com_offset" is the centre of mass [3], "restitution" a damping ratio."""
    spans = [(-1.0, 1.0) if name == "com_offset" else getattr(config, name) for name in PROPERTY_RANGES]
    keys = jnp.concatenate([keys[2:], jax.random.fold_in(keys[5], 1)[None]])
    rows = dict(zip(PROPERTY_RANGES, uniforms(keys, spans, extreme, (3,)), strict=True))
    return {name: row[0] for name, row in rows.items()} | {
        "com_offset": config.com_offset * rows["com_offset"],
        "restitution": damping_ratio(rows["restitution"][0]),
    }


def _properties_of(object: ObjectParams, plain: jax.Array) -> dict[str, jax.Array]:
    """The properties of an object whose shape has the unit inertia `plain` [3]."""
    return {
        "mass": object.mass,
        "inertia_scale": object.inertia / (object.mass * plain),
        "com_offset": object.com,
        "friction": object.friction,
        "link_friction": object.link_friction,
        "stiffness": object.contact[0],
        "restitution": object.contact[1],
    }


def _fields(properties: dict[str, jax.Array], plain: jax.Array) -> dict[str, Any]:
    """These properties as fields of `ObjectParams`; see `_properties_of`."""
    return {
        "mass": properties["mass"],
        "inertia": properties["mass"] * plain * properties["inertia_scale"],
        "com": properties["com_offset"],
        "friction": properties["friction"],
        "contact": jnp.stack([properties["stiffness"], properties["restitution"]]),
        "link_friction": properties["link_friction"],
    }


def unit_inertia(object: ObjectParams, config: ObjectConfig | None = None) -> jax.Array:
    """Inertia [3] m^2 of an object of `config` as a uniform solid of 1 kg, about its centre."""
    if config is not None and config.mesh:
        mesh_object = load_mesh_object(config)
        return (object.size[0, 0] / mesh_object.boxes.size[0, 0]) ** 2 * jnp.asarray(mesh_object.inertia)
    mass, _, inertia = _mass_properties(object.kinds, object.size, object.position, object.active)
    return inertia / mass


def restitution(ratio: np.ndarray) -> np.ndarray:
    """Coefficient of restitution of a spring-damper that pushes but does not pull.

    e = exp(-2 z / sqrt(1 - z^2) atan(sqrt(1 - z^2) / z)), with the hyperbolic functions above 1: contact ends when the
    force does, before the spring is back at its length (Schwager and Poeschel, Granular Matter 9 (2007) 465).
    """
    ratio = np.asarray(ratio, float)
    root = np.maximum(np.sqrt(np.abs(1 - ratio**2)), 1e-6)
    angle = np.where(
        ratio < 1, np.arctan2(root, ratio), np.arctanh(np.minimum(root / np.maximum(ratio, 1.0), 1 - 1e-12))
    )
    return np.exp(-2 * ratio / root * angle)


# Closer together at the low end, where the restitution falls fast.
_RATIOS = 3.0 * np.linspace(0.0, 1.0, 200) ** 2
_RESTITUTIONS = restitution(_RATIOS)


def damping_ratio(restitution: jax.Array | float) -> jax.Array:
    """Damping ratio [...], at most 3, of a contact that bounces with this restitution [...]; MuJoCo has no such
    parameter."""
    restitutions, ratios = (jnp.asarray(row[::-1], jnp.float32) for row in (_RESTITUTIONS, _RATIOS))
    return jnp.interp(restitution, restitutions, ratios)


def _sample_slots(
    key: jax.Array, shape_index: jax.Array, config: ObjectConfig, extreme: jax.Array | None
) -> tuple[jax.Array, jax.Array, jax.Array]:
    keys = jax.random.split(key, 7)
    is_sphere, is_box, is_cylinder, is_capsule, is_union = (shape_index == i for i in range(5))
    part = jnp.where(is_union, _COMPOSITION_SCALE, 1.0)
    names = ("box_half", "cylinder_radius", "cylinder_half", "sphere_radius", "neck_radius", "neck_half")
    drawn = uniforms(keys[:6], [getattr(config, name) for name in names], extreme, (3,))
    half, (radius, length, ball, neck, neck_half) = part * drawn[0], drawn[1:, 0]
    radius, length = part * radius, part * length
    box_body = jax.random.bernoulli(keys[6])

    # A composition is a box or a cylinder with a capsule jutting out along its axis.
    body_half = jnp.where(box_body, half[2], length)
    capsule = jnp.where(
        is_sphere,
        jnp.stack([ball, _SPHERE_HALF_LENGTH]),
        jnp.where(is_union, jnp.stack([neck, neck_half]), jnp.stack([radius, length])),
    )
    zero = jnp.zeros(())
    size = jnp.stack([half, jnp.stack([*capsule, zero]), jnp.stack([radius, length, zero])])
    active = jnp.stack(
        [is_box | (is_union & box_body), is_sphere | is_capsule | is_union, is_cylinder | (is_union & ~box_body)]
    )
    jut = jnp.where(is_union, body_half + neck_half, 0.0)
    position = jnp.zeros((3, 3)).at[1, 2].set(jut)
    return jnp.where(active[:, None], size, INACTIVE_SIZE), position, active


def _mass_properties(
    kinds: tuple[str, ...], size: jax.Array, position: jax.Array, active: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Mass, centre and inertia (about the centre) of the union at unit density.

    Overlaps count twice; the drawn mass and inertia scale absorb it.
    """
    masses, inertias = zip(*(_SOLIDS[kind](*size[k]) for k, kind in enumerate(kinds)), strict=True)
    mass = jnp.where(active, jnp.stack(masses), 0.0)
    inertia = jnp.where(active[:, None], jnp.stack(inertias), 0.0)
    z = jnp.where(active, position[:, 2], 0.0)
    total = jnp.sum(mass)
    centre = jnp.sum(mass * z) / total
    shift = jnp.sum(mass * (z - centre) ** 2)
    return (
        total,
        jnp.stack([jnp.zeros(()), jnp.zeros(()), centre]),
        jnp.sum(inertia, 0) + shift * jnp.array([1.0, 1.0, 0.0]),
    )


def _box(a: jax.Array, b: jax.Array, c: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Mass and inertia [3] at unit density, as of the other solids."""
    mass = 8 * a * b * c
    return mass, mass / 3 * jnp.stack([b * b + c * c, a * a + c * c, a * a + b * b])


def _capsule(r: jax.Array, h: jax.Array, _: jax.Array) -> tuple[jax.Array, jax.Array]:
    tube, ball = 2 * jnp.pi * r * r * h, 4 / 3 * jnp.pi * r**3
    side = tube * (r * r / 4 + h * h / 3) + ball * (2 / 5 * r * r + h * h + 3 / 4 * r * h)
    return tube + ball, jnp.stack([side, side, tube * r * r / 2 + ball * 2 / 5 * r * r])


def _cylinder(r: jax.Array, h: jax.Array, _: jax.Array) -> tuple[jax.Array, jax.Array]:
    mass = 2 * jnp.pi * r * r * h
    side = mass * (r * r / 4 + h * h / 3)
    return mass, jnp.stack([side, side, mass * r * r / 2])


_SOLIDS = {"box": _box, "capsule": _capsule, "cylinder": _cylinder}
