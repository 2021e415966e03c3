"""Diagonal Gaussian over actions [..., A]; the environment gets samples clipped to [-1, 1]."""

import math

import jax
import jax.numpy as jnp

from dexsim.core.pytree import align, pytree_dataclass


@pytree_dataclass
class Decision:
    """A drawn action and the distribution that it is from; arrays [B, ...]."""

    action: jax.Array  # [B, A] before clipping
    mean: jax.Array  # [B, A]
    log_prob: jax.Array  # [B]


def sample(noise: jax.Array, mean: jax.Array, log_std: jax.Array) -> jax.Array:
    """A random action [..., A], from standard normal noise of its shape."""
    return mean + align(jnp.exp(log_std), mean) * noise


def log_prob(x: jax.Array, mean: jax.Array, log_std: jax.Array) -> jax.Array:
    """Log density of `x`, summed over the last axis."""
    z = (x - mean) * align(jnp.exp(-log_std), mean)
    return -jnp.sum(0.5 * z**2 + align(log_std, mean) + 0.5 * math.log(2 * math.pi), axis=-1)


def entropy(log_std: jax.Array) -> jax.Array:
    """Differential entropy in nats, summed over the last axis."""
    return jnp.sum(log_std + 0.5 * math.log(2 * math.pi * math.e), axis=-1)


def kl_divergence(mean_p: jax.Array, log_std_p: jax.Array, mean_q: jax.Array, log_std_q: jax.Array) -> jax.Array:
    """KL(p || q) in nats, summed over the last axis."""
    variance_ratio = jnp.exp(2 * (log_std_p - log_std_q))
    distance = ((mean_p - mean_q) * align(jnp.exp(-log_std_q), mean_q)) ** 2
    terms = align(variance_ratio, distance) + distance - 1 - align(jnp.log(variance_ratio), distance)
    return 0.5 * jnp.sum(terms, axis=-1)


def bounds_loss(mean: jax.Array, limit: float = 1.1) -> jax.Array:
    """Squared distance of the mean from [-limit, limit], summed over the last axis.

    Zero inside. Beyond the limit a clipped action no longer changes, so nothing else would bring the mean back.
    """
    return jnp.sum(jnp.maximum(jnp.abs(mean) - limit, 0.0) ** 2, axis=-1)
