"""What the taxels feel: depth below the object's surface, and the finger's force spread by it.

Method (paper, section Sim-to-Real Transfer): a taxel touches where it lies below the object's
surface; its share of the finger's force follows the skin's stress at that depth; the finger's
total is the contact force of the physics.

Shapes: F fingers, N taxels a finger. Units: m, N, Pa.
"""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp

from dexsim.core.pytree import pytree_dataclass
from dexsim.geometry import rotations, sdf
from dexsim.geometry.distance import signed_distance
from dexsim.hand.kinematics import Hand, HandPose
from dexsim.touch.skin import Skin, skin_stress
from dexsim.touch.surface import Surface, taxels_only


@pytree_dataclass
class Touch:
    """What the taxels feel, before the sensor's own imperfections."""

    depth: jax.Array  # [F, N] m, compression of the skin (>= 0)
    skin_force: jax.Array  # [F, N] N, by the skin's law alone
    force: jax.Array  # [F, N] N, the finger's total from the physics, shared by `skin_force`


def feel(
    taxels: jax.Array,
    area: jax.Array,
    geometry: Any,
    position: jax.Array,
    rotation: jax.Array,
    finger_force: jax.Array,
    skin: Skin,
    pad_thickness_delta: jax.Array | float = 0.0,
) -> Touch:
    """Taxel forces from the geometry of the contact and the finger's total force.

    Args:
      taxels: [F, N, 3] m, taxel positions in the palm frame.
      area: [F, N] m^2.
      geometry, position [3], rotation [3, 3]: the object, prepared for any method of
        `dexsim.geometry.distance` (a `sdf.Shape` is as it is), and its pose in the palm frame.
      finger_force: [F] N, resultant fingertip-object force of the physics.
      skin: the skin's law.
      pad_thickness_delta: [] m, by which the rubber is thicker than `skin.margin`.

    A finger with all taxels clear of the object reads zero, whatever its total: it touches with a part of the link
    that has no taxels.
    """
    return _press(sdf.to_local(taxels, position, rotation), area, geometry, finger_force, skin, pad_thickness_delta)


def feel_links(
    hand: Hand,
    pose: HandPose,
    geometry: Any,
    position: jax.Array,
    rotation: jax.Array,
    finger_force: jax.Array,
    skin: Skin,
    surface: Surface | None = None,
    pad_thickness_delta: jax.Array | float = 0.0,
) -> Touch:
    """`feel` for all taxels of a posed hand, or for other points of its fingertips' skin.

    It transforms points directly from the links' frames to the object's: one transform a finger instead of two a
    taxel, and no taxel positions in memory.
    """
    surface = surface or taxels_only(hand)
    turn = rotations.compose(jnp.swapaxes(rotation, -1, -2), pose.tip_rotation)
    shift = rotations.rotate_inverse(rotation, pose.body_position[hand.tip_body] - position[None])
    # Without the barrier XLA would compose the rotations anew for every taxel.
    turn, shift = jax.lax.optimization_barrier((turn, shift))
    taxel = [jnp.asarray(surface.position[..., axis]) for axis in range(3)]
    local = [sum(turn[:, row, axis, None] * taxel[axis] for axis in range(3)) + shift[:, row, None] for row in range(3)]
    return _press(jnp.stack(local, -1), jnp.asarray(surface.area), geometry, finger_force, skin, pad_thickness_delta)


def _press(
    points: jax.Array,
    area: jax.Array,
    geometry: Any,
    finger_force: jax.Array,
    skin: Skin,
    pad_thickness_delta: jax.Array | float = 0.0,
) -> Touch:
    """`feel` for points [F, N, 3] in the object's frame."""
    margin = jnp.maximum(skin.margin + pad_thickness_delta, 0.0)
    depth = jnp.maximum(margin - signed_distance(points, geometry), 0.0)
    skin_force = skin_stress(depth / skin.thickness, skin) * area
    return Touch(depth, skin_force, spread(skin_force, finger_force))


def spread(skin_force: jax.Array, finger_force: jax.Array) -> jax.Array:
    """Share each finger's force [F] among its taxels in proportion to `skin_force` [F, N]."""
    total = jnp.sum(skin_force, -1, keepdims=True)
    return finger_force[:, None] * skin_force / jnp.where(total > 0, total, 1.0)


def pressing_force(force: jax.Array, normals: jax.Array, finger_force: jax.Array) -> jax.Array:
    """What of each finger's force presses into its skin, [F] N; 0 for a finger that touches nothing.

    Args:
      force: [F, N] N, normal forces on the taxels; they say where the contact is.
      normals: [F, N, 3] outward taxel normals, in any frame.
      finger_force: [F, 3] N, the physics' force vector on the finger, in the same one.
    """
    inward = -jnp.sum(force[..., None] * normals, -2)
    square = jnp.sum(inward**2, -1, keepdims=True)
    touching = square > 0
    inward = inward / jnp.sqrt(jnp.where(touching, square, 1.0))
    return jnp.sum(finger_force * inward, -1)


def keep_normal_part(touch: Touch, normals: jax.Array, finger_force: jax.Array) -> Touch:
    """The same touch with only the pressing part of the fingers' forces shared among the taxels.

    Args:
      normals: [F, N, 3] outward taxel normals, in any frame.
      finger_force: [F, 3] N, the physics' force vector on the finger, in the same one.
    """
    pressed = pressing_force(touch.skin_force, normals, finger_force)
    return dataclasses.replace(touch, force=spread(touch.skin_force, jnp.maximum(pressed, 0.0)))
