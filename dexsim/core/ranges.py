"""Extremes: episodes whose every value lies at an end of its range.

Drawn independently, values are never all far off at once: the hands and objects that a policy meets in training fill
the middle of the box that the ranges span. A real hand may sit at an extreme of it, and one beyond its ranges does.
"""

import jax
import jax.numpy as jnp

_EXTREME = 0x0C0E  # stream of the keys that choose extremes


def sample_extreme(key: jax.Array, share: float) -> jax.Array | None:
    """Whether this episode [] is one of that share; None, which costs nothing, if none is."""
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
    """A value [*shape] of a range (low, high), or at an extreme the end of it on that value's side of nominal.

    Args:
      key: of this value.
      span: the range. One that begins at its nominal value has its far end only.
      extreme: [] bool, or None for no extremes; see `sample_extreme`.
      nominal: by default the middle of the range.
      beyond: an extreme lies up to this share of the end's distance from nominal outside the range.
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
