"""The motors' law over one control tick: command latency, joint drive and friction, at every physics sub-step."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from dexsim.actuator.drive import apply_friction, at_limit, delayed_target, joint_torque
from dexsim.core.pytree import pytree_dataclass
from dexsim.errors import ConfigError
from dexsim.hand.description import Hand
from dexsim.hand.kinematics import hinge_angles
from dexsim.hand.mjcf import read_mjcf
from dexsim.physics.config import PhysicsConfig
from dexsim.physics.interface import PhysicsState, TorqueLaw
from dexsim.physics.physics import Physics
from dexsim.randomization import HandParams, Randomization

# s, in which Coulomb friction stops a joint: `apply_friction`'s dt. Were it the sub-step, forces of grips would depend
# on it, since friction creeps at load dt / I under a load of a contact: by .19 N (median) from 1 to 10 ms.
_STOPPING = 0.006


@pytree_dataclass
class JointCommand:
    """What the motors are told for a control tick."""

    action: jax.Array  # [J] in [-1, 1]; zero where the one given was not finite
    target: jax.Array  # [J] rad
    previous: jax.Array  # [J] rad, acts until the latency is over
    valid: jax.Array  # [] bool, whether the action was finite
    earlier: jax.Array | None = None  # [J] rad, the target before `previous`; None: the same


class Motors:
    """The motors of one environment. Pure methods."""

    def __init__(self, physics: Physics):
        self._physics, self._substeps = physics, physics.config.substeps
        model = physics.mj_model
        self._inertia_rate = jnp.asarray(model.dof_M0[physics.joint_dof] / _STOPPING, jnp.float32)

    def law(self, hand: HandParams, command: JointCommand) -> TorqueLaw:
        """The torque [J] Nm on the links, from sub-step to sub-step, for `Physics.advance`."""
        delay = self._delay(hand, command)

        def torque(substep: jax.Array, position: jax.Array, velocity: jax.Array) -> jax.Array:
            target = delayed_target(substep, *delay)
            torque = joint_torque(hand.actuator, target, 0.0, position, velocity)
            return apply_friction(hand.actuator, torque, velocity, self._inertia_rate)

        return torque

    def current_torque(
        self, hand: HandParams, command: JointCommand, state: PhysicsState
    ) -> tuple[jax.Array, jax.Array]:
        """The torque [J] Nm that the motors' currents correspond to at the end of a tick, before friction, and whether
        it [J] is at its limit."""
        position, velocity = state.qpos[self._physics.joint_qpos], state.qvel[self._physics.joint_dof]
        target = delayed_target(jnp.asarray(self._substeps), *self._delay(hand, command))
        arguments = hand.actuator, target, 0.0, position, velocity
        return joint_torque(*arguments), at_limit(*arguments)

    def _delay(self, hand: HandParams, command: JointCommand) -> tuple[jax.Array, jax.Array, jax.Array]:
        """Latency [J] in sub-steps within this tick, and the targets [J] before and after it. A latency of more than a
        tick shifts both targets to the tick before."""
        earlier = command.previous if command.earlier is None else command.earlier
        late = hand.latency > self._substeps
        latency = jnp.where(late, hand.latency - self._substeps, hand.latency)
        return latency, jnp.where(late, earlier, command.previous), jnp.where(late, command.previous, command.target)


def check_timestep(hand: Hand, physics: PhysicsConfig, ranges: Randomization) -> None:
    """Check that the stiffest motors that are drawn are stable at the time step, on every engine.

    Engines step v' = v + h/I (-k_p q - k_d (v + v') / 2 - d v), q' = q + h v', with the joint's own damping d explicit.
    With a = h^2 k_p / I, b = h k_d / I and c = h d / I the step is a matrix of determinant (1 - b/2 - c) / (1 + b/2)
    and trace 1 + determinant - a / (1 + b/2). Both eigenvalues are inside the unit circle if and only if a + 2 c < 4:

        h^2 k_p / I + 2 h d / I < 4,

    whatever the motor's damping k_d. For all joints at once I is the mass matrix, and the left side the largest
    eigenvalue of M^-1 (h^2 K_p + 2 h D). Beyond it a joint chatters from limit to limit of its torque.
    `Randomization.beyond`, for hands that training never has, is not counted; nor are friction and dead-band, which
    damp.

    Raises:
      ConfigError: names the joint and the largest stable time step.
    """
    high = {name: 1 + ranges.scale * (getattr(ranges, name)[1] - 1) for name in ("stiffness_factor", "efficiency")}
    ripple = 1 + ranges.scale * ranges.ripple[1]
    stiffness = high["efficiency"] * ripple * ranges.stiffness * high["stiffness_factor"]  # of the stiffest motor
    damping, mass = _dynamics(hand)

    def largest(step: float) -> tuple[float, int]:
        """The largest eigenvalue, and the joint that moves most in it."""
        load = np.diag(step**2 * stiffness * hand.gain) + 2 * step * damping
        values, vectors = np.linalg.eig(np.linalg.solve(mass, load))
        worst = int(np.argmax(values.real))
        return float(values.real[worst]), int(np.argmax(np.abs(vectors[:, worst])))

    value, joint = largest(physics.timestep)
    if value < 4:
        return
    stable = next(s for s in np.linspace(physics.timestep, 0.0, 200) if largest(s)[0] < 4)
    raise ConfigError(
        f"PhysicsConfig.timestep = {physics.timestep:g} s: the stiffest motors drawn are unstable at joint "
        f"{hand.joint_names[joint]} (h^2 k_p / I + 2 h d / I = {value:.2f}, must be below 4): "
        f"use at most {np.floor(stable * 1e5) / 1e5:g} s, or a lower gain (Randomization.stiffness)"
    )


def _dynamics(hand: Hand) -> tuple[np.ndarray, np.ndarray]:
    """Damping [J, J] Nm s/rad and mass matrix [J, J] kg m^2 of the joints with all that follows them, at the middle of
    their ranges; a finger's posture changes the smallest of them by less than 1 %."""
    model = read_mjcf(hand).compile()
    data, mass = mujoco.MjData(model), np.zeros((model.nv, model.nv))
    data.qpos[:] = np.asarray(hinge_angles(hand, (hand.joint_lower + hand.joint_upper) / 2))
    mujoco.mj_forward(model, data)
    mujoco.mj_fullM(model, data, mass)
    moving = np.flatnonzero(hand.body_joint >= 0)
    follows = np.zeros((model.nv, hand.num_joints))
    follows[np.arange(model.nv), hand.body_joint[moving]] = hand.body_ratio[moving]
    return follows.T @ np.diag(model.dof_damping) @ follows, follows.T @ mass @ follows
