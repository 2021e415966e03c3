"""An inner loop beneath a policy: each touching finger closes or opens until it gives the force that is asked for.

The policy chooses the posture; the reflex adds an angle to the joint target of each finger's root joint. The thumb has
none: it balances the others. Simulation and bridge run this code.
"""

import dataclasses

import jax
import jax.numpy as jnp

from dexsim.core.config import setting, validate


@dataclasses.dataclass(frozen=True, kw_only=True)
class GripReflex:
    """Settings of the reflex."""

    gain: float = setting(0.0, unit="rad/(N s)", low=0.0, high=1.0)
    """Rate at which a touching finger closes, per newton that it lacks; 0 turns the reflex off."""
    limit: float = setting(0.3, unit="rad", low=0.0, high=1.0)
    """Largest angle that it adds."""
    slew: float = setting(0.5, unit="rad/s", low=0.001, high=10.0)
    """Largest rate of the angle. A finger that touches nothing loses it at this rate."""

    def __post_init__(self) -> None:
        validate(self)


def move_reflex(reflex: GripReflex, period: float, angle: jax.Array, wanted: jax.Array, force: jax.Array) -> jax.Array:
    """The next angles [F] rad that the reflex adds, closing positive; the thumb's is 0.

    Args:
      reflex: settings.
      period: s, control tick.
      angle: [F] rad, so far.
      wanted: [] N of each touching finger.
      force: [F] N estimated, zero where nothing touches.
    """
    largest = reflex.slew * period
    change = jnp.clip(reflex.gain * (wanted - force) * period, -largest, largest)
    change = jnp.where(force > 0, change, -jnp.clip(angle, -largest, largest))
    return jnp.clip(angle + change, -reflex.limit, reflex.limit).at[0].set(0.0)
