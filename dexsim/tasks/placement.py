"""Where an object can be put: the palm below it, and how far it is from every link."""

import jax
import jax.numpy as jnp
import numpy as np

from dexsim.core.errors import AssetError
from dexsim.core.pytree import align
from dexsim.geometry import rotations, sdf
from dexsim.hand.kinematics import Hand, forward_kinematics


def palm_height(hand: Hand) -> float:
    """x of the palm's face: of its plane, or else of the box that reaches farthest, however that is turned."""
    palm = [g for g in hand.geoms if g.body == hand.body_names.index(hand.palm) and g.touches]
    faces = [g.position[0] for g in palm if g.kind == "plane"] or [
        g.position[0] + np.abs(g.rotation[0]) @ g.size for g in palm if g.kind == "box"
    ]
    return float(max(faces, default=0.0))


def clearance(hand: Hand, joints: jax.Array, shape: sdf.Shape, position: jax.Array, rotation: jax.Array) -> jax.Array:
    """Smallest distance [] m from the object to the hand's capsules, at seven points of each, and spheres.

    Raises:
      AssetError: the hand has neither.
    """
    pose = forward_kinematics(hand, joints)
    capsules = [g for g in hand.geoms if g.touches and g.kind in ("capsule", "sphere")]
    if not capsules:
        raise AssetError(f"{hand.model_path}: no capsule or sphere touches: from what a start keeps clear is not known")
    lengths = [np.linspace(-1.0, 1.0, 7) * (g.size[1] if g.kind == "capsule" else 0.0) for g in capsules]
    local = np.stack(
        [g.position + np.outer(along, g.rotation[:, 2]) for g, along in zip(capsules, lengths, strict=True)]
    ).astype(np.float32)
    body = np.array([g.body for g in capsules])
    radius = np.array([g.size[0] for g in capsules])[:, None]
    points = pose.body_position[body][:, None] + rotations.rotate(pose.body_rotation[body][:, None], jnp.asarray(local))
    points = rotations.rotate_inverse(rotation, points - align(position, points))
    return jnp.min(sdf.signed_distance(points, shape) - radius)
