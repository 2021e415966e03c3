"""What tasks share: pushes on the object, and reward terms on the motion of the hand."""

import jax
import jax.numpy as jnp


def action_rate(action: jax.Array, last_action: jax.Array) -> jax.Array:
    """R_action: squared change of the action."""
    return jnp.sum((action - last_action) ** 2)


def joint_speed(velocity: jax.Array) -> jax.Array:
    """R_vel: squared joint velocity."""
    return jnp.sum(velocity**2)


def random_push(key: jax.Array, mass: jax.Array, *, probability: float, speed: float, period: float) -> jax.Array:
    """Force [3] N that, with this probability, acts for a tick of `period` s.

    It changes the velocity of `mass` kg by up to `speed` m/s in a random direction.
    """
    when, where, strength = jax.random.split(key, 3)
    direction = jax.random.normal(where, (3,))
    direction = direction / (jnp.linalg.norm(direction) + 1e-9)
    change = speed * jax.random.uniform(strength)
    hit = jax.random.bernoulli(when, probability)
    return jnp.where(hit, mass * change / period, 0.0) * direction
