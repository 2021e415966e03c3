"""Rotations: quaternions (w, x, y, z), matrices, 6-D rotation, angles; and lengths of vectors.

Products are written elementwise: XLA's default float32 matrix product on NVIDIA GPUs is TF32,
which loses a tenth of a millimetre over the length of a finger.
"""

import jax
import jax.numpy as jnp

from dexsim.core.pytree import Array, align


def _sum_of_products(left: Array, right: Array, axis: int) -> jax.Array:
    return jnp.sum(align(left, right) * align(right, left), axis=axis)


def rotate(matrix: Array, vector: Array) -> jax.Array:
    """`matrix` [..., 3, 3] times `vector` [..., 3]."""
    return _sum_of_products(matrix, vector[..., None, :], axis=-1)


def rotate_inverse(matrix: Array, vector: Array) -> jax.Array:
    """The transpose of `matrix` [..., 3, 3] times `vector` [..., 3]."""
    return _sum_of_products(matrix, vector[..., :, None], axis=-2)


def compose(left: Array, right: Array) -> jax.Array:
    """The matrix product of two rotations [..., 3, 3]."""
    return _sum_of_products(left[..., :, :, None], right[..., None, :, :], axis=-2)


def quat_to_matrix(quat: Array) -> jax.Array:
    """A unit quaternion [..., 4] as a rotation matrix [..., 3, 3]."""
    w, x, y, z = (quat[..., i] for i in range(4))
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    return jnp.stack([jnp.stack(row, -1) for row in rows], -2)


def axis_angle_to_matrix(axis: Array, angle: Array) -> jax.Array:
    """Rodrigues' formula: unit `axis` [..., 3], `angle` [...] rad, to [..., 3, 3]."""
    c, s = jnp.cos(angle), jnp.sin(angle)
    x, y, z = (axis[..., i] for i in range(3))
    t = 1 - c
    rows = (
        (t * x * x + c, t * x * y - s * z, t * x * z + s * y),
        (t * x * y + s * z, t * y * y + c, t * y * z - s * x),
        (t * x * z - s * y, t * y * z + s * x, t * z * z + c),
    )
    return jnp.stack([jnp.stack(row, -1) for row in rows], -2)


def axis_angle_to_quat(axis: Array, angle: Array) -> jax.Array:
    """Unit `axis` [..., 3], `angle` [...] rad, to a quaternion [..., 4]."""
    half = jnp.asarray(angle)[..., None] / 2
    return jnp.concatenate([jnp.cos(half), jnp.sin(half) * axis], -1)


def quat_multiply(left: Array, right: Array) -> jax.Array:
    """The Hamilton product of quaternions [..., 4]."""
    a, b, c, d = (left[..., i] for i in range(4))
    e, f, g, h = (right[..., i] for i in range(4))
    return jnp.stack(
        [
            a * e - b * f - c * g - d * h,
            a * f + b * e + c * h - d * g,
            a * g - b * h + c * e + d * f,
            a * h + b * g - c * f + d * e,
        ],
        -1,
    )


def quat_conjugate(quat: Array) -> jax.Array:
    """The inverse of a unit quaternion [..., 4]."""
    return jnp.multiply(quat, align(jnp.array([1.0, -1.0, -1.0, -1.0]), quat))


def quat_angle(left: Array, right: Array) -> jax.Array:
    """The angle between two orientations [..., 4], in [0, pi] rad."""
    relative = quat_multiply(quat_conjugate(left), right)
    # atan2 keeps full precision near zero, where arccos of the scalar part has none.
    vector = jnp.sqrt(jnp.sum(relative[..., 1:] ** 2, -1) + 1e-30)
    return 2 * jnp.arctan2(vector, jnp.abs(relative[..., 0]))


def matrix_to_6d(matrix: Array) -> jax.Array:
    """The first two columns of a rotation [..., 3, 3] as [..., 6] (Zhou et al. 2019)."""
    return jnp.concatenate([matrix[..., :, 0], matrix[..., :, 1]], -1)


def length(vector: jax.Array) -> jax.Array:
    """Euclidean length [...] of vectors [..., N], with gradient zero where a vector is exactly zero.

    `jnp.linalg.norm` has the gradient NaN there, and the force on a finger that touches nothing is exactly zero.
    """
    square = jnp.sum(vector**2, axis=-1)
    nonzero = square > 0
    return jnp.where(nonzero, jnp.sqrt(jnp.where(nonzero, square, 1.0)), 0.0)
