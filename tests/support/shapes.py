"""Single primitives as shapes."""

import jax.numpy as jnp

from dexsim.geometry import sdf


def solid(kind, *size):
    """A primitive at the origin; sizes as in MuJoCo, those left out are 0."""
    return sdf.Shape(
        (kind,), jnp.asarray([(*size, 0, 0)[:3]], jnp.float32), jnp.zeros((1, 3)), jnp.eye(3)[None], jnp.array([True])
    )
