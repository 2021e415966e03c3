"""Forces on the taxels: depth below the object's surface, and the finger's force spread by it.

Method (paper, section Sim-to-Real Transfer): a taxel touches where it lies below the object's surface; its share of the
finger's force follows the skin's stress at that depth; the finger's total is the contact force of the physics.

Shapes: F fingers, N taxels a finger. Units: m, N, Pa.
"""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp

from dexsim.core.pytree import leaf, pytree_dataclass
from dexsim.geometry import rotations
from dexsim.geometry.distance import signed_distance
from dexsim.hand.description import Hand
from dexsim.hand.kinematics import HandPose
from dexsim.touch.skin import Skin, skin_stress


@pytree_dataclass
class Touch:
    """What the taxels feel, before the sensor's own imperfections."""

    depth: jax.Array = leaf("[F, N] m, compression of the skin (>= 0)")
    skin_force: jax.Array = leaf("[F, N] N, by the skin's law alone")
    force: jax.Array = leaf("[F, N] N, the finger's total from the physics, shared by `skin_force`")


def compute_touch(
    hand: Hand,
    pose: HandPose,
    geometry: Any,
    position: jax.Array,
    rotation: jax.Array,
    finger_force: jax.Array,
    skin: Skin,
    pad_thickness_delta: jax.Array | float = 0.0,
) -> Touch:
    """What the taxels of a posed hand feel.

    A finger with all taxels clear of the object reads zero, whatever its total: it touches with a part of the link
    that has no taxels.

    Args:
      geometry, position [3], rotation [3, 3]: the object, prepared for any method of `dexsim.geometry.distance` (a
        `sdf.Shape` is as it is), and its pose in the palm frame.
      finger_force: [F] N, resultant fingertip-object force of the physics.
      pad_thickness_delta: [] m, by which the rubber is thicker than `skin.margin`.
    """
    # From the links' frames directly to the object's: one transform a finger instead of two a taxel.
    turn = rotations.compose(rotation.T, pose.tip_rotation)
    shift = rotations.rotate_inverse(rotation, pose.body_position[hand.tip_body] - position[None])
    # Without the barrier XLA would compose the rotations anew for every taxel.
    turn, shift = jax.lax.optimization_barrier((turn, shift))
    taxel = [jnp.asarray(hand.taxel_position[..., axis]) for axis in range(3)]
    local = [sum(turn[:, row, axis, None] * taxel[axis] for axis in range(3)) + shift[:, row, None] for row in range(3)]
    margin = jnp.maximum(skin.margin + pad_thickness_delta, 0.0)
    depth = jnp.maximum(margin - signed_distance(jnp.stack(local, -1), geometry), 0.0)
    skin_force = skin_stress(depth / skin.thickness, skin) * jnp.asarray(hand.taxel_area)
    return Touch(depth, skin_force, spread(skin_force, finger_force))


def spread(skin_force: jax.Array, finger_force: jax.Array) -> jax.Array:
    """Share each finger's force [F] among its taxels in proportion to `skin_force` [F, N]."""
    total = jnp.sum(skin_force, 1, keepdims=True)
    return finger_force[:, None] * skin_force / jnp.where(total > 0, total, 1.0)


def project_on_normals(touch: Touch, normals: jax.Array, finger_force: jax.Array) -> Touch:
    """The same touch with only what presses into the skin of the fingers' forces [F, 3] N shared among the taxels.

    Outward taxel `normals` [F, N, 3] are in the same frame, whichever. A finger that touches nothing keeps 0.
    """
    inward = -jnp.sum(touch.skin_force[..., None] * normals, 1)
    square = jnp.sum(inward**2, 1, keepdims=True)
    inward = inward / jnp.sqrt(jnp.where(square > 0, square, 1.0))  # the gradient of a norm is NaN at 0
    pressing = jnp.sum(finger_force * inward, 1)
    return dataclasses.replace(touch, force=spread(touch.skin_force, jnp.maximum(pressing, 0.0)))
