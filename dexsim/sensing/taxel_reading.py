"""What a taxel reports of the force on it."""

import dataclasses

import jax
import jax.numpy as jnp

from dexsim.core.config import setting, validate
from dexsim.touch.feel import taxel_vectors


@dataclasses.dataclass(frozen=True, kw_only=True)
class TaxelSensor:
    """What the sensor does to the force on a taxel before the host reads it."""

    noise: float = setting(0.02, unit="N", low=0.0, high=10.0)
    """Standard deviation of white noise on each taxel, with what is left of its zero after the tare."""
    threshold: float = setting(0.05, unit="N", low=0.0, high=10.0)
    """Readings below this are reported as zero."""
    resolution: float = setting(0.1, unit="N", low=0.0, high=10.0)
    """Force per count; 0 leaves readings unquantised. The hand reports bytes of 0.1 N."""
    saturation: float = setting(25.5, unit="N", low=0.1, high=1000.0)
    """Largest force a taxel can report."""

    def __post_init__(self):
        validate(self)


def measure_taxels(force: jax.Array, gain: jax.Array, sensor: TaxelSensor, key: jax.Array) -> jax.Array:
    """Measured taxel forces [F, N] N from true ones: gain [F, 1], noise, threshold, counts."""
    reading = force * gain + sensor.noise * jax.random.normal(key, force.shape)
    reading = jnp.where(reading < sensor.threshold, 0.0, reading)
    if sensor.resolution > 0:
        reading = jnp.round(reading / sensor.resolution) * sensor.resolution
    return jnp.clip(reading, 0.0, sensor.saturation)


def measure_tangential(
    tangential: jax.Array, force: jax.Array, gain: jax.Array, sensor: TaxelSensor, key: jax.Array
) -> jax.Array:
    """What three-axis taxels report of a finger's tangential force, summed over them.

    Each taxel bears its share with noise and whole counts (a signed byte of them), so a load that
    is spread thinly reads too low.

    Args:
      tangential: [F, 3] N, true.
      force: [F, N] N, normal forces: how it is shared.
      gain: [F, 1] or [F, N].
      sensor: noise and resolution.
      key: of the noise.

    Returns:
      [F, 3] N.
    """
    share = taxel_vectors(force, tangential) * gain[..., None]
    share = share + sensor.noise * jax.random.normal(key, share.shape)
    if sensor.resolution > 0:
        counts = jnp.clip(jnp.round(share / sensor.resolution), -128.0, 127.0)
        share = counts * sensor.resolution
    return jnp.sum(share, -2)
