"""The motors' law over one control tick: command latency, joint drive and friction, at every physics sub-step."""

import jax
import jax.numpy as jnp

from dexsim.actuator.drive import apply_friction, at_limit, delayed_target, drive
from dexsim.core.pytree import pytree_dataclass
from dexsim.physics.interface import PhysicsState, TorqueLaw
from dexsim.physics.physics import Physics
from dexsim.randomization import HandParams


@pytree_dataclass
class JointCommand:
    """What the motors are told for a control tick."""

    action: jax.Array  # [J] in [-1, 1]; zero where the one given was not finite
    target: jax.Array  # [J] rad
    previous: jax.Array  # [J] rad, acts until the latency is over
    valid: jax.Array  # [] bool, whether the action was finite


class Motors:
    """The motors of one environment. Pure methods."""

    def __init__(self, physics: Physics):
        self._physics, self._substeps = physics, physics.config.substeps
        model = physics.mj_model
        # I / dt: what `apply_friction` needs to stop a joint within a sub-step and not turn it round.
        self._inertia_rate = jnp.asarray(model.dof_M0[physics.joint_dof] / model.opt.timestep, jnp.float32)

    def law(self, hand: HandParams, command: JointCommand) -> TorqueLaw:
        """The torque [J] Nm on the links, from sub-step to sub-step, for `Physics.advance`."""

        def torque(substep: jax.Array, position: jax.Array, velocity: jax.Array) -> jax.Array:
            target = delayed_target(substep, hand.latency, command.previous, command.target)
            torque = drive(hand.actuator, target, jnp.zeros_like(target), position, velocity)
            return apply_friction(hand.actuator, torque, velocity, self._inertia_rate)

        return torque

    def current_torque(
        self, hand: HandParams, command: JointCommand, state: PhysicsState
    ) -> tuple[jax.Array, jax.Array]:
        """The torque [J] Nm that the motors' currents correspond to at the end of a tick, before friction, and whether
        it [J] is at its limit."""
        position, velocity = state.qpos[self._physics.joint_qpos], state.qvel[self._physics.joint_dof]
        target = delayed_target(jnp.asarray(self._substeps), hand.latency, command.previous, command.target)
        arguments = hand.actuator, target, jnp.zeros_like(target), position, velocity
        return drive(*arguments), at_limit(*arguments)
