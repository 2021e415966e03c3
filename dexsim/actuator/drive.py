"""The joint drive: PD law, backlash dead-band, torque-speed envelope, efficiency, latency.

The four equations of the paper (section Actuator Model Randomization), evaluated at every physics sub-step, and what
the paper's text names and leaves out: torque ripple, an encoder that is off, friction in the gear. Every parameter is a
pytree leaf: drawn per joint and episode, differentiated, fitted.
"""

from typing import Any

import jax
import jax.numpy as jnp

from dexsim.core.pytree import Array, pytree_dataclass


@pytree_dataclass
class Actuator:
    """Parameters of one joint's drive (scalars) or of all of them ([J]).

    Those that may be None are not modelled then; 0 gives the same numbers, bit for bit. Ripple needs its count and
    phase, `apply_friction` both kinds of friction.
    """

    stiffness: jax.Array  # k_p, Nm/rad
    damping: jax.Array  # k_d, Nm s/rad
    dead_band: jax.Array  # epsilon, rad
    stall_torque: jax.Array  # tau_0, Nm
    no_load_speed: jax.Array  # qd_max, rad/s
    efficiency: jax.Array  # eta, 1
    ripple: jax.Array | None = None  # r, share of the torque
    ripple_count: Any = None  # n, ripples per radian of the joint
    ripple_phase: Any = None  # rad
    encoder_bias: jax.Array | None = None  # rad, measured minus true angle, inside the loop too
    coulomb_friction: Any = None  # c, Nm
    viscous_friction: Any = None  # b, Nm s/rad


def pd_torque(
    actuator: Actuator,
    target: jax.Array,
    target_velocity: jax.Array | float,
    position: jax.Array | float,
    velocity: jax.Array,
) -> jax.Array:
    """tau_c = k_p (q_ref - q) + k_d (qd_ref - qd), Nm."""
    return actuator.stiffness * (target - position) + actuator.damping * (target_velocity - velocity)


def torque_limit(actuator: Actuator, velocity: jax.Array) -> jax.Array:
    """tau_sat = tau_0 (1 - |qd| / qd_max), not below zero beyond the no-load speed, Nm."""
    return actuator.stall_torque * jnp.maximum(1.0 - jnp.abs(velocity) / actuator.no_load_speed, 0.0)


def demanded_torque(
    actuator: Actuator, target: jax.Array, target_velocity: jax.Array | float, position: jax.Array, velocity: jax.Array
) -> jax.Array:
    """tau_b at the measured angle, position + encoder bias: what the loop asks for, Nm, whatever the limit.

    tau_b = 0 where |q_ref - q| < epsilon, else tau_c.
    """
    measured = position if actuator.encoder_bias is None else position + actuator.encoder_bias
    torque = pd_torque(actuator, target, target_velocity, measured, velocity)
    return jnp.where(jnp.abs(target - measured) < actuator.dead_band, 0.0, torque)


def joint_torque(
    actuator: Actuator, target: jax.Array, target_velocity: jax.Array | float, position: jax.Array, velocity: jax.Array
) -> jax.Array:
    """Torque of the motors, Nm: eta clip(tau_b, -tau_sat, tau_sat) (1 + r sin(n q + phase)).

    This is the torque that corresponds to the motor's current; `apply_friction` subtracts the gear's friction.
    Arguments are scalars, of one joint, or arrays [J] of all, which broadcast.
    """
    torque = demanded_torque(actuator, target, target_velocity, position, velocity)
    limit = torque_limit(actuator, velocity)
    torque = actuator.efficiency * jnp.clip(torque, -limit, limit)
    if actuator.ripple is None:
        return torque
    angle = actuator.ripple_count * position + actuator.ripple_phase
    return torque * (1.0 + actuator.ripple * jnp.sin(angle))


def at_limit(
    actuator: Actuator, target: jax.Array, target_velocity: jax.Array | float, position: jax.Array, velocity: jax.Array
) -> jax.Array:
    """Whether joints [J] bool are at their torque limit: |tau_b| >= tau_sat. Arguments as of `joint_torque`."""
    torque = demanded_torque(actuator, target, target_velocity, position, velocity)
    return jnp.abs(torque) >= torque_limit(actuator, velocity)


def apply_friction(
    actuator: Actuator, torque: jax.Array, velocity: jax.Array, inertia_rate: Array | float
) -> jax.Array:
    """What Coulomb and viscous friction leave of a torque, Nm: one backward Euler step, stable for any friction.

    The joint alone, without contacts, would end the sub-step at the momentum rate p = I qd / dt + tau. Coulomb friction
    takes up to c of it, so it stops the joint and then holds it, and cannot turn it round; viscous friction shrinks the
    rest by 1 / (1 + b dt / I). A load that is not in `torque` (contact, gravity) is not held but creeps at load dt / I.

    Args:
      torque: Nm, of the drive.
      velocity: rad/s, before the sub-step.
      inertia_rate: Nm s/rad, the joint's inertia over the sub-step, I / dt.
    """
    coulomb, viscous = actuator.coulomb_friction, actuator.viscous_friction
    rate = inertia_rate * velocity + torque
    held = jnp.clip(rate, -coulomb, coulomb)
    return torque - held - (rate - held) * (viscous / (inertia_rate + viscous))


def delayed_target(substep: jax.Array, latency: jax.Array, previous: jax.Array, target: jax.Array) -> jax.Array:
    """The mean over a sub-step of the target [J] that acts: the previous one for the first `latency` sub-steps.

    `latency` [] or [J], sub-steps, need not be whole; one control tick at most is modelled.
    """
    left = jnp.asarray(latency, target.dtype) - jnp.asarray(substep, target.dtype)
    share = jnp.clip(left, 0.0, 1.0)
    return target + share * (previous - target)
