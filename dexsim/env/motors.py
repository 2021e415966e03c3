"""The motors over one control tick: latency, drive, friction, and gear play where it is chosen.

By default joints move with their motors and the dead-band stands for backlash. With
`Randomization.backlash = "gear_play"` each joint has a rotor of its own before the gap
(`dexsim.actuator.gear_play.drive_beside`): it carries a share of the joint's armature, and the encoder sits on it.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from dexsim.actuator.drive import apply_friction, at_limit, delayed_target, drive
from dexsim.actuator.gear_play import GearPlay, GearState, drive_beside, gear_at
from dexsim.core.errors import ConfigError
from dexsim.core.pytree import choose, pytree_dataclass
from dexsim.env.config import EnvConfig
from dexsim.env.state import Episode
from dexsim.hand.kinematics import Hand
from dexsim.physics.physics import Physics
from dexsim.physics.seam import PhysicsState
from dexsim.randomization import HandParams, Randomization

MotorLaw = Callable[..., tuple[jax.Array, GearState | None]]
"""(sub-step, joint position [J], joint velocity [J], gear) to torque on the links [J] Nm and gear."""


@pytree_dataclass
class JointCommand:
    """What the motors are told for a control tick."""

    action: jax.Array  # [J] in [-1, 1]; zero where the one given was not finite
    target: jax.Array  # [J] rad
    previous: jax.Array  # [J] rad, acts until the latency is over
    valid: jax.Array  # [] bool, whether the action was finite
    reflex: jax.Array | None = None  # [F] rad of the target, with a grip reflex


@pytree_dataclass
class PhysicsTick:
    """The world after a control tick."""

    physics: PhysicsState
    finger_force: jax.Array  # [F, 3] N, of the object on the finger tips
    joint_torque: jax.Array  # [J] Nm, by the motors' currents at the end of the tick
    gear: GearState | None  # with gear play
    limited: jax.Array  # [J] bool, whether the motor is at its torque limit at the end of the tick
    finite: jax.Array  # [] bool; where false the world stays as it was, without forces


class Motors:
    """The motors of one environment, and the physics under them. Pure methods."""

    def __init__(self, config: EnvConfig, hand: Hand, physics: Physics):
        """Raises ConfigError: gear play for joints that have no armature, or are coupled."""
        self.hand, self.physics, self._substeps = hand, physics, config.physics.substeps
        model, dofs = physics.mj_model, physics.joint_dof
        self._timestep = float(model.opt.timestep)
        self._inertia_rate = jnp.asarray(model.dof_M0[dofs] / model.opt.timestep, jnp.float32)
        ranges = config.randomization
        self.gear_play = ranges.backlash == "gear_play"
        if self.gear_play:
            if hand.num_hinges > hand.num_joints:
                raise ConfigError(f"Randomization.backlash = 'gear_play': not with the coupled joints of {hand.name}")
            self._tooth_stiffness = ranges.tooth_stiffness
            self._rotor_inertia, self._steps = _rotors(ranges, model, dofs)
            self._link_inertia = np.asarray(1 / model.dof_invweight0[dofs], np.float32)

    def rest(
        self, qpos: jax.Array, qvel: jax.Array, target: jax.Array | None = None
    ) -> tuple[JointCommand, PhysicsTick]:
        """The start of an episode: no torque, no touch, rotors at rest in the middle of their gaps.

        Args:
          qpos, qvel: of the start state; see `PhysicsState`.
          target: [J] rad; None for the joints' own angles.
        """
        joints, zero = qpos[self.physics.joint_qpos], jnp.zeros(self.hand.num_joints)
        target, valid = joints if target is None else target, jnp.ones((), bool)
        return JointCommand(action=zero, target=target, previous=target, valid=valid), PhysicsTick(
            physics=PhysicsState(qpos, qvel, jnp.zeros(self.physics.mj_model.nv)),
            finger_force=jnp.zeros((self.hand.num_fingers, 3)),
            joint_torque=zero,
            gear=gear_at(joints, jnp.zeros_like(joints)) if self.gear_play else None,
            limited=jnp.zeros(self.hand.num_joints, bool),
            finite=valid,
        )

    def encoder(self, joints: jax.Array, gear: GearState | None) -> jax.Array:
        """What the encoders [J] rad turn with: the joint, or the rotor before the gap."""
        return joints if gear is None else gear.rotor.position

    def tick(
        self, episode: Episode, command: JointCommand, physics: PhysicsState, gear: GearState | None, push: jax.Array
    ) -> PhysicsTick:
        """A control tick of physics under the motors.

        Args:
          episode: the hand and the object.
          command: the joint targets.
          physics, gear: where the tick begins.
          push: [3] N on the object.
        """
        law = self.law(episode.hand, command)
        after, force, turned = self.physics.advance_motors(episode.object, physics, law, gear, push, episode.hand.cover)
        after, turned, force, finite = stay_finite(command.valid, (physics, gear), (after, turned), force)
        torque, limited = self.current_torque(episode.hand, command, after, turned)
        return PhysicsTick(
            physics=after, finger_force=force, joint_torque=torque, gear=turned, limited=limited, finite=finite
        )

    def law(self, hand: HandParams, command: JointCommand) -> MotorLaw:
        """The motors as `Physics.advance_motors` wants them."""
        if self.gear_play:
            return self._geared(hand, command)

        def motors(substep: jax.Array, position: jax.Array, velocity: jax.Array, gear: None) -> tuple[jax.Array, None]:
            wanted = delayed_target(substep, hand.latency, command.previous, command.target)
            torque = drive(hand.actuator, wanted, jnp.zeros_like(wanted), position, velocity)
            return apply_friction(hand.actuator, torque, velocity, self._inertia_rate), None

        return motors

    def _geared(self, hand: HandParams, command: JointCommand) -> MotorLaw:
        assert hand.gear_gap is not None, "hands with gear play have a gap"
        play = GearPlay(hand.gear_gap, self._rotor_inertia, self._tooth_stiffness)

        def motors(
            substep: jax.Array, position: jax.Array, velocity: jax.Array, gear: GearState
        ) -> tuple[jax.Array, GearState]:
            wanted = delayed_target(substep, hand.latency, command.previous, command.target)
            return drive_beside(
                hand.actuator,
                play,
                gear,
                wanted,
                position,
                velocity,
                inertia=self._link_inertia,
                timestep=self._timestep,
                steps=self._steps,
            )

        return motors

    def current_torque(
        self, hand: HandParams, command: JointCommand, physics: PhysicsState, gear: GearState | None
    ) -> tuple[jax.Array, jax.Array]:
        """The torque [J] Nm that the motors' currents tell of at the end of a tick, before friction, and whether it
        [J] is at its limit."""
        position, velocity = (physics.qpos[self.physics.joint_qpos], physics.qvel[self.physics.joint_dof])
        if gear is not None:
            position, velocity = gear.rotor.position, gear.rotor.velocity
        wanted = delayed_target(jnp.asarray(self._substeps), hand.latency, command.previous, command.target)
        state = hand.actuator, wanted, jnp.zeros_like(wanted), position, velocity
        return drive(*state), at_limit(*state)


def stay_finite(valid: jax.Array, before: Any, after: Any, force: jax.Array) -> tuple[Any, Any, jax.Array, jax.Array]:
    """A tick's physics and gears, forces [F, 3] N and whether they are sound [] bool.

    A world that has diverged ends its episode: it stays as it was `before`, and its forces are zero, since NaNs
    must not propagate. `valid` [] bool is false where the action was not finite.
    """
    physics = after[0]
    # A diverging solver passes through speeds that are finite and square to 1e27 in the reward.
    finite = (
        valid
        & jnp.all(jnp.isfinite(physics.qpos))
        & jnp.all(jnp.abs(physics.qvel) < 1e3)
        & jnp.all(jnp.isfinite(force))
    )
    physics, gear = choose(finite, after, before)
    return physics, gear, jnp.where(finite, force, 0.0), finite


def rotor_share(ranges: Randomization) -> float:
    """Share of the joints' armature that `Physics` is to leave out, since rotors carry it."""
    return ranges.rotor_share if ranges.backlash == "gear_play" else 0.0


def _rotors(ranges: Randomization, model: Any, dofs: np.ndarray) -> tuple[np.ndarray, int]:
    """Rotor inertias [J] kg m^2, and how many steps the rotors take in a sub-step.

    The scene was compiled without the rotors' share of the armature. A rotor is stable while
    damping * step / inertia < 2; 1 is asked for.
    """
    rotor = model.dof_armature[dofs] * ranges.rotor_share / (1 - ranges.rotor_share)
    if np.any(rotor <= 0):
        raise ConfigError(
            "Randomization.backlash = 'gear_play': every joint of the hand's MJCF needs an "
            "armature, of which rotor_share is the rotor"
        )
    most = ranges.scale * (1 + ranges.beyond)
    largest = ranges.damping * max(1.0, 1 + most * (ranges.damping_factor[1] - 1))
    return np.asarray(rotor, np.float32), max(int(np.ceil(largest * model.opt.timestep / rotor.min())), 1)
