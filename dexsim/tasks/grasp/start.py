"""Start states of the grasp task: an object below the palm, fingers half closed round it."""

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from dexsim.core import compilation
from dexsim.core.errors import ConfigError
from dexsim.core.ranges import uniforms
from dexsim.geometry import rotations
from dexsim.hand.kinematics import flexion_joints, hinge_angles
from dexsim.objects.params import extent
from dexsim.tasks.placement import clearance, palm_height

_OVERLAP = 0.001  # m, hand and object may start this deep in each other


def make_pool(key: jax.Array, task: Any):
    """Draw candidates and keep those in which the hand is clear of the object.

    Every shape gets an equal share of the pool: large boxes overlap far more often than small
    spheres, and a plain rejection would all but leave them out of training.

    Args:
      key: of the pool.
      task: a `Grasp`: its hand, configuration, reference and objects.

    Raises:
      ConfigError: next to no candidate of a shape is clear, so the ranges do not fit the hand.
    """
    config, shapes = task.config, task.drawn_shapes
    share = -(-config.pool_size // len(shapes))
    chunk = max(min(2 * share, 4096), 64)

    @functools.partial(compilation.jit, once=True)
    def sample(key: jax.Array, shape_index: jax.Array):
        keys = jax.random.split(key, chunk)
        return jax.vmap(lambda k: _candidate(k, shape_index, task))(keys)

    pools = []
    for name in shapes:
        kept, count = [], 0
        for trial in range(40):
            shape_key = jax.random.fold_in(jax.random.fold_in(key, task.shape_names.index(name)), trial)
            starts, clear = sample(shape_key, jnp.int32(task.shape_names.index(name)))
            rows = np.flatnonzero(np.asarray(clear))[: share - count]
            kept.append(jax.tree.map(lambda x, rows=rows: np.asarray(x)[rows], starts))
            count += rows.size
            if count == share:
                break
        if count < share:
            raise ConfigError(
                f"{type(config).__name__}: only {count} of {share} start states of "
                f"shape {name!r} are free of overlap; open the posture or shrink it"
            )
        pools.append(jax.tree.map(lambda *parts: np.concatenate(parts), *kept))
    return jax.tree.map(lambda *parts: np.concatenate(parts)[: config.pool_size], *pools)


def _candidate(key: jax.Array, shape_index: jax.Array, task: Any) -> tuple[Any, jax.Array]:
    from dexsim.env.state import Start

    hand, config, reference = task.hand, task.config, task.reference
    keys = jax.random.split(key, 7)
    object = task.sample_object(keys[0], config, shape_index)
    sides = (-1.0, 1.0)
    drawn = uniforms(
        jnp.concatenate([keys[1:], jax.vmap(jax.random.fold_in, (None, 0))(keys[5], jnp.array([1, 2]))]),
        (sides, sides, config.release_gap, sides, config.release_speed, config.curl, sides, sides),
        None,
        (max(hand.num_joints, 3),),
    )
    noise = config.posture_noise * drawn[0, : hand.num_joints]
    (roll, turn, askew), shift = drawn[1, :3], config.place_noise * drawn[3, :2]
    gap, speed, curl = drawn[2, 0], drawn[4, 0], drawn[5, 0]
    drift, spin = config.release_drift * drawn[6, :2], config.release_spin * drawn[7, :3]
    flexion = np.zeros(hand.num_joints, np.float32)
    flexion[flexion_joints(hand, range(1, hand.num_fingers))] = 1.0
    joints = jnp.asarray(config.posture) + noise + curl * flexion
    joints = jnp.clip(joints, hand.joint_lower, hand.joint_upper)

    # Long objects lie across the fingers (their z along the palm's y, either way), turned about the palm's normal and a
    # little askew; the roll about their own axis is free.
    quat = rotations.axis_angle_to_quat(jnp.array([0.0, 0.0, 1.0]), roll * jnp.pi)
    most = config.turn_noise
    for axis, angle in (
        ((1.0, 0.0, 0.0), jnp.where(drawn[3, 2] < 0.0, -0.5, 0.5) * jnp.pi),
        ((0.0, 0.0, 1.0), most[1] * askew),
        ((1.0, 0.0, 0.0), most[0] * turn),
    ):
        quat = rotations.quat_multiply(rotations.axis_angle_to_quat(jnp.array(axis), jnp.asarray(angle)), quat)
    matrix = rotations.quat_to_matrix(quat)
    # How far the object reaches [3, 2] along the palm's axes, each in both directions. Its middle, not its origin, is
    # put where the fingers meet: that of a composition is in its body, beside which the neck juts out.
    reach = jax.vmap(
        lambda way: extent(
            object.size,
            object.position,
            object.active,
            rotations.rotate_inverse(matrix, way),
            object.kinds,
            object.quat,
        )
    )(jnp.concatenate([jnp.eye(3), -jnp.eye(3)]))
    middle = (reach[1:3] - reach[4:]) / 2
    position = jnp.stack([palm_height(hand) + gap + reach[3], *(jnp.asarray(reference[1:]) + shift - middle)])
    qpos = jnp.concatenate([hinge_angles(hand, joints), position, quat])
    qvel = jnp.concatenate([jnp.zeros(hand.num_hinges), speed[None], drift, spin])
    start = Start(qpos=qpos, qvel=qvel, object=object)
    return start, clearance(hand, joints, object.shape(), position, matrix) > -_OVERLAP
