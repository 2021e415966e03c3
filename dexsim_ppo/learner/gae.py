"""Generalised advantage estimation (Schulman et al. 2016), for episodes that terminate or are truncated."""

import jax
import jax.numpy as jnp


def compute_gae(
    reward: jax.Array,
    value: jax.Array,
    next_value: jax.Array,
    terminated: jax.Array,
    truncated: jax.Array,
    discount: float,
    gae_lambda: float,
) -> tuple[jax.Array, jax.Array]:
    """Advantages and value targets; all arrays are [T, B]. `target = advantage + value`.

    `value` is that of the observation that a step acted on, `next_value` that of the one it led to, before any restart.
    Either ending cuts the sum over later steps. A terminated step has no value after it; a truncated one
    bootstraps from the value of its true final observation.
    """
    # `where`, not a product: the value of a diverged final state may be NaN.
    bootstrap = jnp.where(terminated, 0.0, next_value)
    delta = reward + discount * bootstrap - value
    decay = discount * gae_lambda * (1.0 - (terminated | truncated).astype(reward.dtype))

    def backward(advantage, step):
        delta_t, decay_t = step
        advantage = delta_t + decay_t * advantage
        return advantage, advantage

    _, advantage = jax.lax.scan(backward, jnp.zeros_like(delta[0]), (delta, decay), reverse=True, unroll=8)
    return advantage, advantage + value
