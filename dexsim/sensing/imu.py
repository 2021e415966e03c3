"""A low-cost IMU inside the object: what its orientation reading does to the truth.

White noise, a constant misalignment, a slow heading drift (no magnetometer), a sampling rate and a delay. Defaults are
of the order that makers of fused 6-axis parts state.
"""

import dataclasses

import jax
import jax.numpy as jnp

from dexsim.core.config import Config, Range, setting
from dexsim.core.pytree import pytree_dataclass
from dexsim.core.ranges import uniforms
from dexsim.geometry import rotations


@dataclasses.dataclass(frozen=True, kw_only=True)
class ImuConfig(Config):
    """Errors of the object's orientation reading; ranges are drawn at every episode start."""

    noise: float = setting(0.02, unit="rad", low=0.0, high=1.0)
    """Standard deviation of white noise, per axis."""
    bias: float = setting(0.04, unit="rad", low=0.0, high=1.0)
    """Largest constant misalignment, per axis: how far off the pose is that it is aligned to."""
    drift: float = setting(0.0005, unit="rad/s", low=0.0, high=0.1)
    """Largest drift of the heading about the vertical."""
    rate: float = setting(100.0, unit="Hz", low=1.0, high=10000.0)
    """Samples per second; between two samples the last one is read again."""
    delay: Range = setting((0.0, 0.02), unit="s", low=0.0, high=0.2)
    """Age of a sample. At most one control tick is modelled."""


@pytree_dataclass
class ImuParams:
    """One episode's sensor."""

    bias: jax.Array  # [3] rad
    drift: jax.Array  # [] rad/s
    delay: jax.Array  # [] fraction of a control tick
    phase: jax.Array  # [] fraction of a sampling period


def sample_imu(
    key: jax.Array, config: ImuConfig, scale: jax.Array | float, control_period: float, extreme: jax.Array | None = None
) -> ImuParams:
    """Draw one episode's sensor; `scale` 0 gives one without bias, drift and delay.

    Where `extreme` [] is true, all three are at an end of their ranges (`dexsim.core.ranges`).
    """
    keys, sides = jax.random.split(key, 4), (-1.0, 1.0)
    bias, drift, delay = uniforms(keys[:3], (sides, sides, config.delay), extreme, (3,), nominal=(0.0, 0.0, 0.0))
    return ImuParams(
        bias=scale * config.bias * bias,
        drift=scale * config.drift * drift[0],
        delay=jnp.clip(scale * delay[0] / control_period, 0.0, 1.0),
        phase=jax.random.uniform(keys[3]),
    )


def measure_orientation(
    key: jax.Array,
    config: ImuConfig,
    imu: ImuParams,
    tick: jax.Array,
    now: jax.Array,
    before: jax.Array,
    held: jax.Array,
    up: jax.Array,
    control_period: float,
) -> jax.Array:
    """The orientation [4] that the host reads.

    Args:
      tick: [] control ticks since the sensor was switched on.
      now, before, held: [4] true orientation at this tick and the one before, and the last reading.
      up: [3] the vertical in the palm frame, about which the heading drifts.
      control_period: s.
    """
    # Neighbours on the sphere of quaternions may have opposite signs.
    before = jnp.where(jnp.sum(now * before) < 0, -before, before)
    late = (1 - imu.delay) * now + imu.delay * before
    late = late / jnp.linalg.norm(late)
    error = imu.bias + config.noise * jax.random.normal(key, (3,))
    error = error + imu.drift * tick * control_period * up
    angle = jnp.sqrt(jnp.sum(error**2) + 1e-20)
    fresh = rotations.quat_multiply(rotations.axis_angle_to_quat(error / angle, angle), late)
    per_tick = config.rate * control_period
    sampled = jnp.floor(tick * per_tick + imu.phase) > jnp.floor((tick - 1) * per_tick + imu.phase)
    return jnp.where(sampled | (tick == 0), fresh, held)  # At first nothing is held yet but the true pose.
