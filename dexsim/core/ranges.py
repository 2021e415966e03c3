"""Random values of ranges, and extremes: episodes in which every value takes an end of its range.

Independent values are hardly ever all far from nominal at once, so training would only cover the middle of the box
that the ranges span. A real hand may lie at a corner of that box, or outside it.
"""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np

_EXTREME = 0x0C0E  # stream of the keys that select extreme episodes


def sample_extreme(key: jax.Array, share: float) -> jax.Array | None:
    """Whether this episode is one of that share of extremes, bool []; None for a share of 0, which costs nothing."""
    return None if share == 0 else jax.random.bernoulli(jax.random.fold_in(key, _EXTREME), share)


def uniform(
    key: jax.Array,
    span: tuple[float, float],
    extreme: jax.Array | None,
    shape: tuple[int, ...] = (),
    *,
    nominal: float | None = None,
    beyond: float = 0.0,
) -> jax.Array:
    """A random value [*shape] of a range; in an extreme episode, the end of the range on that value's side of nominal.

    Args:
      span: (low, high). A range that begins at its nominal value has only its far end as an extreme.
      extreme: from `sample_extreme`: bool [], or None for no extremes.
      nominal: by default the middle of the range.
      beyond: extremes lie outside the range, by up to this share of the end's distance from nominal.
    """
    value = jax.random.uniform(key, shape, minval=span[0], maxval=span[1])
    if extreme is None:
        return value
    if nominal is None:
        nominal = (span[0] + span[1]) / 2
    end = jnp.where(value >= nominal, span[1], span[0])
    if beyond:
        far = jax.random.uniform(jax.random.fold_in(key, 1), shape, minval=1.0, maxval=1.0 + beyond)
        end = nominal + far * (end - nominal)
    return jnp.where(extreme, end, value)


def uniforms(
    keys: jax.Array,
    spans: Sequence[tuple[float, float]],
    extreme: jax.Array | None,
    shape: tuple[int, ...] = (),
    *,
    nominal: Sequence[float] | None = None,
    beyond: float = 0.0,
) -> jax.Array:
    """Random values [K, *shape] of K ranges, each as `uniform` draws it from its key of `keys` [K], compiled four times
    as fast. A value of a smaller shape is the beginning of its row."""
    low, high = np.asarray(spans, np.float32).T
    middle = (low + high) / 2 if nominal is None else np.asarray(nominal, np.float32)
    return jax.vmap(
        lambda key, low, high, middle: uniform(key, (low, high), extreme, shape, nominal=middle, beyond=beyond)
    )(keys, low, high, middle)
