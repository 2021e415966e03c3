"""Gear play with its own state: the encoder before the gap, the link after it.

The paper models backlash as a dead-band on the position error, which has no memory. In a real
gear the rotor crosses the gap before the link feels anything, the encoder sits on the rotor, and
what the link does within the gap is unseen. Here rotor and link are two inertias that push each
other at either end of the gap:

    J w' = tau_motor - tau_tooth,    I v' = tau_tooth + tau_link,
    tau_tooth = k (|theta - q| - gap / 2) + d (w - v) at an end of the gap, pushing only.

The tooth torque is that of the end of the sub-step (backward Euler, closed form), so the model is
stable at any stiffness and time step. C MuJoCo's two-joint recipe for backlash gives the same
motion (see the tests).
"""

import jax
import jax.numpy as jnp

from dexsim.actuator.drive import Actuator, apply_friction, joint_torque
from dexsim.core.pytree import Array, pytree_dataclass


@pytree_dataclass
class GearPlay:
    """Parameters of one joint's gear (scalars) or of all of them ([J])."""

    gap: jax.Array | float  # rad, lost motion of the link at a held rotor, end to end
    rotor_inertia: Array | float  # J, kg m^2 at the joint (times the gear ratio squared)
    tooth_stiffness: jax.Array | float = 500.0  # k, Nm/rad
    tooth_damping: jax.Array | float | None = None  # d, Nm s/rad; None: critical, no bounce


@pytree_dataclass
class Rotor:
    """State of the motor side, at the joint."""

    position: jax.Array  # theta, rad: what the encoder reads
    velocity: jax.Array  # w, rad/s


@pytree_dataclass
class GearState:
    """State of a gear that is simulated outside of the physics engine: the rotor, and the last torque on the joint."""

    rotor: Rotor
    velocity: jax.Array  # rad/s, of the link before the last sub-step
    torque: jax.Array  # Nm, on the link during it


def rotor_at(position: jax.Array, velocity: jax.Array) -> Rotor:
    """A rotor in the middle of the gap, moving with the link."""
    return Rotor(position, velocity)


def tooth_torque(
    play: GearPlay,
    rotor: Rotor,
    motor_torque: jax.Array,
    position: jax.Array,
    velocity: jax.Array,
    *,
    inertia: Array,
    timestep: float,
    link_torque: Array | float = 0.0,
) -> jax.Array:
    """Torque through the gear on the link, Nm, at the end of a sub-step.

    Args:
      play: parameters.
      rotor: motor side before the sub-step.
      motor_torque: Nm, on the rotor.
      position, velocity: rad, rad/s, of the link before the sub-step.
      inertia: I, kg m^2 of the link about the joint, without the rotor.
      timestep: s.
      link_torque: Nm, other torques on the link, where known.
    """
    reduced = play.rotor_inertia * inertia / (play.rotor_inertia + inertia)
    damping = 2.0 * jnp.sqrt(play.tooth_stiffness * reduced) if play.tooth_damping is None else play.tooth_damping
    slip = rotor.velocity - velocity + timestep * (motor_torque / play.rotor_inertia - link_torque / inertia)
    offset = rotor.position - position + timestep * slip  # both as without a tooth torque
    depth = jnp.abs(offset) - play.gap / 2
    way = jnp.sign(offset)
    push = play.tooth_stiffness * depth + damping * slip * way
    push = push / (1.0 + (timestep**2 * play.tooth_stiffness + timestep * damping) / reduced)
    return jnp.where(depth > 0, jnp.maximum(push, 0.0), 0.0) * way


def drive_with_play(
    actuator: Actuator,
    play: GearPlay,
    rotor: Rotor,
    target: jax.Array,
    position: jax.Array,
    velocity: jax.Array,
    *,
    inertia: Array,
    timestep: float,
    link_torque: Array | float = 0.0,
) -> tuple[jax.Array, Rotor]:
    """`dexsim.actuator.drive.joint_torque` through a gear with play.

    The PD law, the envelope and the friction act on the rotor, where the encoder and the motor
    are. Elementwise, so scalars or [J].

    Returns:
      The torque on the link, Nm, for this sub-step, and the rotor after it.
    """
    motor = joint_torque(actuator, target, jnp.zeros_like(target), rotor.position, rotor.velocity)
    motor = apply_friction(actuator, motor, rotor.velocity, play.rotor_inertia / timestep)
    tooth = tooth_torque(
        play, rotor, motor, position, velocity, inertia=inertia, timestep=timestep, link_torque=link_torque
    )
    after = rotor.velocity + timestep * (motor - tooth) / play.rotor_inertia
    return tooth, Rotor(rotor.position + timestep * after, after)


def gear_at(position: jax.Array, velocity: jax.Array) -> GearState:
    """A gear without load whose rotor is in the middle of the gap and moves with the link."""
    return GearState(rotor_at(position, velocity), velocity, jnp.zeros_like(position))


def drive_beside(
    actuator: Actuator,
    play: GearPlay,
    gear: GearState,
    target: jax.Array,
    position: jax.Array,
    velocity: jax.Array,
    *,
    inertia: Array,
    timestep: float,
    steps: int,
) -> tuple[jax.Array, GearState]:
    """`drive_with_play` for a link that someone else moves, as a physics engine does.

    What else acts on the link (contacts, weight, other joints) shows in how it moved during the
    sub-step before, and is taken to go on. So in a static grip the tooth carries exactly the motor's
    torque. The rotor is light and goes through the sub-step in several steps.

    Args:
      inertia: kg m^2, of the link about the joint as the engine has it, without the rotor. It holds
        for the least that the joint can weigh: stable while the true one is at least 0.6 of it.
      timestep: s, of the engine.
      steps: of the rotor in one of those; damping * timestep / (steps * rotor_inertia) < 2.

    Returns:
      The mean torque [J] Nm on the link over the sub-step, and the gear after it.
    """
    load = inertia * (velocity - gear.velocity) / timestep - gear.torque
    step, total, rotor, moved, speed = timestep / steps, jnp.zeros_like(position), gear.rotor, position, velocity
    for _ in range(steps):
        torque, rotor = drive_with_play(
            actuator, play, rotor, target, moved, speed, inertia=inertia, timestep=step, link_torque=load
        )
        speed = speed + step * (torque + load) / inertia
        moved, total = moved + step * speed, total + torque
    return total / steps, GearState(rotor, velocity, total / steps)
