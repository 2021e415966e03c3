"""The one kinematics in pure JAX that simulation and hardware share; shapes as in `dexsim.hand.description`."""

import jax
import jax.numpy as jnp
import numpy as np

from dexsim.core.pytree import Array, leaf, pytree_dataclass
from dexsim.geometry import rotations
from dexsim.hand.description import Hand


@pytree_dataclass
class HandPose:
    """Poses of all links and finger tips in the palm frame."""

    body_position: jax.Array = leaf("[B, 3] m")
    body_rotation: jax.Array = leaf("[B, 3, 3]")
    tip_position: jax.Array = leaf("[F, 3] m")
    tip_rotation: jax.Array = leaf("[F, 3, 3]")


def forward_kinematics(hand: Hand, joint_position: Array) -> HandPose:
    """Poses of every link from joint angles [J] rad; bodies of equal depth in the tree together, in a few wide
    operations."""
    moving = hand.body_joint >= 0
    angle = jnp.where(moving, joint_position[np.maximum(hand.body_joint, 0)], 0.0)
    if hand.num_hinges > hand.num_joints:
        angle = angle * hand.body_ratio + hand.body_offset
    angle = angle - hand.joint_reference
    turn = rotations.axis_angle_to_matrix(jnp.asarray(hand.joint_axis), angle)
    local_rotation = rotations.compose(jnp.asarray(hand.body_rotation), turn)
    lever = jnp.asarray(hand.joint_anchor) - rotations.rotate(turn, jnp.asarray(hand.joint_anchor))
    local_position = jnp.asarray(hand.body_position) + rotations.rotate(jnp.asarray(hand.body_rotation), lever)

    depth = np.zeros(len(hand.body_parent), int)
    for body, above in enumerate(hand.body_parent):  # which comes before it
        depth[body] = 0 if above < 0 else depth[above] + 1
    roots, *deeper = [np.flatnonzero(depth == level).astype(np.int32) for level in range(depth.max() + 1)]
    order, position, rotation = list(roots), local_position[roots], local_rotation[roots]
    for level in deeper:
        rows = np.array([order.index(p) for p in hand.body_parent[level]], np.int32)
        new_position = position[rows] + rotations.rotate(rotation[rows], local_position[level])
        new_rotation = rotations.compose(rotation[rows], local_rotation[level])
        position = jnp.concatenate([position, new_position])
        rotation = jnp.concatenate([rotation, new_rotation])
        order += list(level)
    back = np.argsort(order).astype(np.int32)
    position, rotation = position[back], rotation[back]
    tip_rotation = rotation[hand.tip_body]
    tip_position = position[hand.tip_body] + rotations.rotate(tip_rotation, jnp.asarray(hand.tip_offset))
    return HandPose(position, rotation, tip_position, tip_rotation)


def hinge_angles(hand: Hand, joint_position: Array) -> jax.Array:
    """Angles [H] rad of all hinges, in the order of the MJCF, from joint angles [J] rad."""
    moving = np.flatnonzero(hand.body_joint >= 0)
    return joint_position[hand.body_joint[moving]] * hand.body_ratio[moving] + hand.body_offset[moving]


def taxel_positions(hand: Hand, pose: HandPose) -> jax.Array:
    """Taxel positions [F, N, 3] m in the palm frame."""
    rotation, origin = pose.tip_rotation[:, None], pose.body_position[hand.tip_body][:, None]
    return origin + rotations.rotate(rotation, jnp.asarray(hand.taxel_position))


def taxel_normals(hand: Hand, pose: HandPose) -> jax.Array:
    """Outward taxel normals [F, N, 3] in the palm frame."""
    return rotations.rotate(pose.tip_rotation[:, None], jnp.asarray(hand.taxel_normal))


def open_hand(hand: Hand) -> np.ndarray:
    """Joint angles [J] rad nearest to 0 that the ranges allow."""
    return np.asarray(np.clip(np.float32(0.0), hand.joint_lower, hand.joint_upper))


def finger_bodies(hand: Hand, finger: int) -> list[int]:
    """Bodies from a fingertip's to the palm's."""
    bodies = [int(hand.tip_body[finger])]
    while (above := int(hand.body_parent[bodies[-1]])) >= 0:
        bodies.append(above)
    return bodies


def flexion_joints(hand: Hand, fingers: range) -> np.ndarray:
    """Joint indices of these fingers from their root joint to the tip, but those that swing the finger sideways: hinges
    whose axes are not parallel to the root joint's."""
    frames, joints = np.array(hand.body_rotation), set[int]()
    for body, above in enumerate(hand.body_parent):  # in the palm's frame, with every hinge as drawn
        if above >= 0:
            frames[body] = frames[above] @ frames[body]
    for finger in fingers:
        chain = finger_bodies(hand, finger)
        root = [place for place, body in enumerate(chain) if hand.body_joint[body] == hand.root_joint[finger]]
        axes = np.stack([frames[body] @ hand.joint_axis[body] for body in chain])
        for body, cosine in zip(chain[: root[-1] + 1], np.abs(axes @ axes[root[-1]]), strict=False):
            if hand.body_joint[body] >= 0 and cosine > 0.7:
                joints.add(int(hand.body_joint[body]))
    return np.array(sorted(joints), int)


def tip_twist(hand: Hand, joint_position: jax.Array, joint_velocity: jax.Array) -> jax.Array:
    """Linear and angular velocity [F, 6] of the finger tips, m/s and rad/s in the palm frame."""

    def tips(joints: jax.Array) -> tuple[jax.Array, jax.Array]:
        pose = forward_kinematics(hand, joints)
        return pose.tip_position, pose.tip_rotation

    (_, rotation), (linear, change) = jax.jvp(tips, (joint_position,), (joint_velocity,))
    skew = rotations.compose(change, jnp.swapaxes(rotation, -1, -2))
    angular = jnp.stack([skew[..., 2, 1], skew[..., 0, 2], skew[..., 1, 0]], -1)
    return jnp.concatenate([linear, angular], -1)
