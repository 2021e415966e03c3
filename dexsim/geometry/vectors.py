"""Lengths of vectors, differentiable everywhere."""

import jax
import jax.numpy as jnp


def length(vector: jax.Array) -> jax.Array:
    """Euclidean length [...] of vectors [..., N], with gradient zero where a vector is exactly zero.

    `jnp.linalg.norm` has the gradient NaN there, and the force on a finger that touches nothing is exactly zero.
    """
    square = jnp.sum(vector**2, axis=-1)
    nonzero = square > 0
    return jnp.where(nonzero, jnp.sqrt(jnp.where(nonzero, square, 1.0)), 0.0)
