"""Generalised advantage estimation (Schulman et al. 2016), with the two ways an episode can end."""

import jax
import jax.numpy as jnp


def compute_gae(
    reward: jax.Array,
    value: jax.Array,
    next_value: jax.Array,
    terminated: jax.Array,
    truncated: jax.Array,
    *,
    discount: float,
    gae_lambda: float,
) -> tuple[jax.Array, jax.Array]:
    """Advantages and value targets, all arrays `[T, B]`, time first.

    A step that ends its episode for either reason cuts the sum over later steps. Only a terminated one
    has nothing after it: a truncated one still counts the value of its true final observation.

    Args:
      value: V of the observation that step t acted on.
      next_value: V of the observation that step t led to, before any restart.
      terminated: bool; wins where `truncated` is set as well.

    Returns:
      `(advantage, target)`, where `target = advantage + value`.
    """
    # `where`, not a product: the value of a diverged final state may be NaN.
    bootstrap = jnp.where(terminated, 0.0, next_value)
    delta = reward + discount * bootstrap - value
    carry_on = discount * gae_lambda * (1.0 - (terminated | truncated))

    def backward(advantage, step):
        delta_t, carry_t = step
        advantage = delta_t + carry_t * advantage
        return advantage, advantage

    _, advantage = jax.lax.scan(backward, jnp.zeros_like(delta[0]), (delta, carry_on), reverse=True, unroll=8)
    return advantage, advantage + value
