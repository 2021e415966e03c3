"""What tasks share: where an object can be put, reward terms on the motion of the hand, pushes on the object."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from dexsim.core.pytree import align
from dexsim.errors import AssetError
from dexsim.geometry import rotations, sdf
from dexsim.hand.description import Hand
from dexsim.hand.kinematics import flexion_joints, forward_kinematics


def palm_height(hand: Hand) -> float:
    """x of the palm's face: of its plane, or else of the box that reaches farthest, however that is turned."""
    palm = [g for g in hand.geoms if g.body == hand.body_names.index(hand.palm) and g.touches]
    faces = [g.position[0] for g in palm if g.kind == "plane"] or [
        g.position[0] + np.abs(g.rotation[0]) @ g.size for g in palm if g.kind == "box"
    ]
    return float(max(faces, default=0.0))


def close_fingers(hand: Hand, fingers: range) -> np.ndarray:
    """1 for the joints [J] that close these fingers, 0 for the others."""
    closes = np.zeros(hand.num_joints, np.float32)
    closes[flexion_joints(hand, fingers)] = 1.0
    return closes


def clearance(hand: Hand, joints: jax.Array, shape: sdf.Shape, position: jax.Array, rotation: jax.Array) -> jax.Array:
    """Smallest distance [] m from the object to what touches of the hand: its spheres, its capsules at seven points of
    each, and the boxes of all links but the palm at 125 points of each. Raises AssetError: the hand has none of
    them."""
    pose, palm = forward_kinematics(hand, joints), hand.body_names.index(hand.palm)
    round_ = [g for g in hand.geoms if g.touches and g.kind in ("capsule", "sphere")]
    boxes = [g for g in hand.geoms if g.touches and g.kind == "box" and g.body != palm]
    along = np.array([[0.0, 0.0, part] for part in np.linspace(-1.0, 1.0, 7)])
    inside = np.stack(np.meshgrid(*[np.linspace(-1.0, 1.0, 5)] * 3, indexing="ij"), -1).reshape(-1, 3)
    gaps = []
    for geoms, unit in ((round_, along), (boxes, inside)):
        if not geoms:
            continue
        reach = [g.size if g.kind == "box" else np.full(3, g.size[1] if g.kind == "capsule" else 0.0) for g in geoms]
        local = np.stack([g.position + (r * unit) @ g.rotation.T for g, r in zip(geoms, reach, strict=True)])
        body = np.array([g.body for g in geoms])
        radius = np.array([0.0 if g.kind == "box" else g.size[0] for g in geoms])[:, None]
        turned = rotations.rotate(pose.body_rotation[body][:, None], jnp.asarray(local.astype(np.float32)))
        points = pose.body_position[body][:, None] + turned
        points = rotations.rotate_inverse(rotation, points - align(position, points))
        gaps.append(jnp.min(sdf.signed_distance(points, shape) - radius))
    if not gaps:
        raise AssetError(f"{hand.model_path}: no capsule, sphere or box has contype or conaffinity above 0")
    return jnp.min(jnp.stack(gaps))


def action_rate(action: jax.Array, last_action: jax.Array) -> jax.Array:
    """R_action: squared change of the action."""
    return jnp.sum((action - last_action) ** 2)


def joint_speed(velocity: jax.Array) -> jax.Array:
    """R_vel: squared joint velocity."""
    return jnp.sum(velocity**2)


def random_push(key: jax.Array, mass: jax.Array, config: Any) -> jax.Array:
    """Force [3] N that acts for a tick, with `config.push_probability`: it changes the velocity of `mass` kg by up to
    `config.push_speed` m/s in a random direction."""
    when, where, strength = jax.random.split(key, 3)
    direction = jax.random.normal(where, (3,))
    direction = direction / (jnp.linalg.norm(direction) + 1e-9)
    change = config.push_speed * jax.random.uniform(strength)
    hit = jax.random.bernoulli(when, config.push_probability)
    return jnp.where(hit, mass * change / config.physics.control_period, 0.0) * direction
