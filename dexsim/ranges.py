"""Corners: episodes whose every value lies at an end of its range.

Drawn independently, values are never all far off at once: the hands and objects that a policy meets in training fill
the middle of the box that the ranges span. A real hand may sit in a corner of it, and one beyond its ranges does.
"""

import jax
import jax.numpy as jnp

_CORNER = 0x0C0E  # stream of the keys that choose corners


def draw_corner(key: jax.Array, share: float) -> jax.Array | None:
    """Whether this episode [] is one of that share; None, which costs nothing, if none is."""
    return None if share == 0 else jax.random.bernoulli(jax.random.fold_in(key, _CORNER), share)


def to_end(value: jax.Array, span: tuple[float, float], nominal: float, corner: jax.Array | None,
           far: jax.Array | float = 1.0) -> jax.Array:
    """`value` [...] of a range (low, high), or at a corner the end of it on the value's side of nominal.

    A range that begins at its nominal value has its far end only. `far` is the distance from nominal in units
    of that end's: beyond 1 the corner lies outside the range.
    """
    if corner is None:
        return value
    end = jnp.where(value >= nominal, span[1], span[0])
    return jnp.where(corner, nominal + far * (end - nominal), value)


def uniform(key: jax.Array, span: tuple[float, float], corner: jax.Array | None,
            shape: tuple[int, ...] = ()) -> jax.Array:
    """A value [*shape] of a range (low, high) whose nominal value is its middle."""
    value = jax.random.uniform(key, shape, minval=span[0], maxval=span[1])
    return to_end(value, span, (span[0] + span[1]) / 2, corner)
