"""The joint drive: PD law, backlash dead-band, torque-speed envelope, efficiency, latency.

The four equations of the paper (section Actuator Model Randomization), evaluated at every
physics sub-step. Every parameter is a pytree leaf, so it can be drawn per joint and per
episode, differentiated and fitted.
"""

import jax
import jax.numpy as jnp

from dexsim.pytree import pytree_dataclass


@pytree_dataclass
class Actuator:
    """Parameters of one joint's drive (scalars) or of all of them ([J])."""

    stiffness: jax.Array  # k_p, Nm/rad
    damping: jax.Array  # k_d, Nm s/rad
    dead_band: jax.Array  # epsilon, rad
    stall_torque: jax.Array  # tau_0, Nm
    no_load_speed: jax.Array  # qd_max, rad/s
    efficiency: jax.Array  # eta, 1


def pd_torque(actuator: Actuator, target: jax.Array, target_velocity: jax.Array,
              position: jax.Array, velocity: jax.Array) -> jax.Array:
    """tau_c = k_p (q_ref - q) + k_d (qd_ref - qd), Nm."""
    return (actuator.stiffness * (target - position)
            + actuator.damping * (target_velocity - velocity))


def dead_band(actuator: Actuator, torque: jax.Array, target: jax.Array,
              position: jax.Array) -> jax.Array:
    """tau_b = 0 where |q_ref - q| < epsilon, else tau_c."""
    return jnp.where(jnp.abs(target - position) < actuator.dead_band, 0.0, torque)


def torque_limit(actuator: Actuator, velocity: jax.Array) -> jax.Array:
    """tau_sat = tau_0 (1 - |qd| / qd_max), not below zero beyond the no-load speed, Nm."""
    return actuator.stall_torque * jnp.maximum(
        1.0 - jnp.abs(velocity) / actuator.no_load_speed, 0.0)


def joint_torque(actuator: Actuator, target: jax.Array, target_velocity: jax.Array,
                 position: jax.Array, velocity: jax.Array) -> jax.Array:
    """Torque applied to one joint, Nm: eta clip(tau_b, -tau_sat, tau_sat).

    Args: scalars, or arrays that broadcast; `drive` is this, vmapped over the joints.
    """
    torque = pd_torque(actuator, target, target_velocity, position, velocity)
    torque = dead_band(actuator, torque, target, position)
    limit = torque_limit(actuator, velocity)
    return actuator.efficiency * jnp.clip(torque, -limit, limit)


drive = jax.vmap(joint_torque)
"""`joint_torque` over joints: an `Actuator` of [J] leaves and arrays [J] to torques [J] Nm."""


def delayed_target(substep: jax.Array, latency: jax.Array, previous: jax.Array,
                   target: jax.Array) -> jax.Array:
    """The target [J] that acts at a sub-step: the previous one for the first `latency` of them."""
    return jnp.where(substep < latency, previous, target)
