"""The motor current of the simulated hand: a known truth for calibration and identification.

Torques and speeds are the joint's; the gear ratio is in the torque constant. A gear passes power with losses: motoring,
the motor must give torque / efficiency; driven back, only torque * back_efficiency holds it. On top comes the current
that the motor draws without load, in the direction of motion. Commutation makes the torque constant ripple.

    i = torque / (K (1 + r sin(n q + phase))) * (1 / eta_f motoring, eta_b driven back)
        + i_0 direction + bias
"""

import jax
import jax.numpy as jnp

from dexsim.core.pytree import Array, pytree_dataclass


@pytree_dataclass
class Motor:
    """Parameters of one joint's motor (scalars) or of all of them ([J])."""

    torque_constant: jax.Array | float  # K, Nm/A at the joint
    efficiency: jax.Array | float = 1.0  # eta_f, motoring
    back_efficiency: jax.Array | float = 1.0  # eta_b, driven back
    no_load_current: jax.Array | float = 0.0  # i_0, A
    ripple: jax.Array | float = 0.0  # r, share of the torque constant
    ripple_count: jax.Array | float = 60.0  # n, ripples per radian of the joint
    ripple_phase: jax.Array | float = 0.0  # rad
    bias: jax.Array | float = 0.0  # A, zero error of the current reading
    noise: jax.Array | float = 0.0  # A, standard deviation of the reading
    resolution: jax.Array | float = 0.0  # A, step of the reading; 0 for none
    limit: jax.Array | float = jnp.inf  # A, largest current that the driver gives or reports


def motor_current(motor: Motor, torque: Array, velocity: Array, position: Array | float = 0.0) -> jax.Array:
    """Current, A, of a motor that holds `torque` Nm at the joint.

    Args:
      motor: scalars, or leaves that broadcast with the rest.
      torque: Nm, of the drive on the joint.
      velocity: rad/s; only its sign counts. At rest neither loss has a direction.
      position: rad, for the ripple.
    """
    way = jnp.sign(velocity)
    power = torque * way
    loss = jnp.where(power > 0, 1.0 / motor.efficiency, jnp.where(power < 0, motor.back_efficiency, 1.0))
    ripple = 1.0 + motor.ripple * jnp.sin(motor.ripple_count * position + motor.ripple_phase)
    return jnp.asarray(torque / (motor.torque_constant * ripple) * loss + motor.no_load_current * way)


def read_current(key: jax.Array, motor: Motor, current: jax.Array) -> jax.Array:
    """What the driver reports, A: limit, bias, noise, resolution."""
    current = jnp.clip(current, -motor.limit, motor.limit)
    reading = current + motor.bias + motor.noise * jax.random.normal(key, jnp.shape(current))
    step = jnp.asarray(motor.resolution)
    rounded = jnp.round(reading / jnp.where(step > 0, step, 1.0)) * step
    return jnp.clip(jnp.where(step > 0, rounded, reading), -motor.limit, motor.limit)
