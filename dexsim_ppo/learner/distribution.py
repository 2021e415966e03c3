"""Diagonal Gaussian over actions [..., A], optionally squashed by tanh.

A squashed policy stores the Gaussian sample from before the tanh. The Jacobian of tanh then cancels in
the probability ratio of old and new policy and in their KL divergence, so both are exactly those of
the Gaussian; only the entropy needs `tanh_log_det`.
"""

import math

import jax
import jax.numpy as jnp

from dexsim.core.pytree import align, pytree_dataclass


@pytree_dataclass
class Decision:
    """A drawn action and the distribution that it is from; arrays [B, ...]."""

    action: jax.Array  # [B, A] Gaussian sample before any squashing
    mean: jax.Array  # [B, A]
    log_prob: jax.Array  # [B]


def sample(noise: jax.Array, mean: jax.Array, log_std: jax.Array) -> jax.Array:
    """A random action [..., A], from standard normal noise of its shape."""
    return mean + align(jnp.exp(log_std), mean) * noise


def squash(x: jax.Array, kind: str) -> jax.Array:
    """A sample or mean [..., A] as an action in [-1, 1]; `kind` is `PPOConfig.distribution`."""
    return jnp.tanh(x) if kind == "tanh" else jnp.clip(x, -1.0, 1.0)


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


def tanh_log_det(x: jax.Array) -> jax.Array:
    """Log determinant of tanh's Jacobian at `x`, summed over the last axis; safe for large |x|."""
    return jnp.sum(2.0 * (math.log(2.0) - x - jax.nn.softplus(-2.0 * x)), axis=-1)
