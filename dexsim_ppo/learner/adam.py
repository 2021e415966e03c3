"""Adam (Kingma and Ba 2015) with the learning rate as a traced scalar, and gradient clipping."""

from typing import TypeVar

import jax
import jax.numpy as jnp

from dexsim.core.pytree import pytree_dataclass

Tree = TypeVar("Tree")


@pytree_dataclass
class AdamState:
    """Running moments of the gradient, shaped like the parameters."""

    count: jax.Array  # int32 []
    mean: object
    variance: object


def init(params: Tree) -> AdamState:
    """Zero moments."""
    return AdamState(
        count=jnp.zeros((), jnp.int32),
        mean=jax.tree.map(jnp.zeros_like, params),
        variance=jax.tree.map(jnp.zeros_like, params),
    )


def update(grads: Tree, state: AdamState, params: Tree, learning_rate: jax.Array | float) -> tuple[Tree, AdamState]:
    """One step down the gradient: new parameters and moments. `learning_rate` is []."""
    b1, b2, epsilon = 0.9, 0.999, 1e-5
    count = state.count + 1
    mean = jax.tree.map(lambda m, g: b1 * m + (1 - b1) * g, state.mean, grads)
    variance = jax.tree.map(lambda v, g: b2 * v + (1 - b2) * g**2, state.variance, grads)
    time = count.astype(jnp.float32)
    mean_scale, variance_scale = 1 / (1 - b1**time), 1 / (1 - b2**time)

    def step(p, m, v):
        return p - learning_rate * (m * mean_scale) / (jnp.sqrt(v * variance_scale) + epsilon)

    return jax.tree.map(step, params, mean, variance), AdamState(count, mean, variance)


def clip_by_global_norm(grads: Tree, max_norm: float) -> tuple[Tree, jax.Array]:
    """Scale gradients longer than `max_norm` down to it; also return the norm [] before clipping."""
    norm = jnp.sqrt(sum(jnp.sum(leaf**2) for leaf in jax.tree.leaves(grads)))
    scale = jnp.minimum(1.0, max_norm / jnp.maximum(norm, 1e-12))
    return jax.tree.map(lambda g: g * scale, grads), norm
