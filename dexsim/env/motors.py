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

from dexsim.actuator.drive import apply_friction, delayed_target, drive
from dexsim.actuator.gear_play import GearPlay, GearState, drive_beside, gear_at
from dexsim.core.errors import ConfigError
from dexsim.env.config import EnvConfig
from dexsim.env.state import State
from dexsim.hand.kinematics import Hand
from dexsim.physics.physics import Physics
from dexsim.physics.seam import PhysicsState
from dexsim.randomization import Draw, Randomization

Motors = Callable[..., tuple[jax.Array, GearState | None]]
"""(sub-step, joint position [J], joint velocity [J], gear) to torque on the links [J] Nm and gear."""


class Drive:
    """The motors of one environment. Pure methods."""

    def __init__(self, config: EnvConfig, hand: Hand, physics: Physics):
        """Raises ConfigError: gear play for joints without an armature."""
        self.hand, self.physics, self._substeps = hand, physics, config.physics.substeps
        model, dofs = physics.mj_model, physics.joint_dof
        self._timestep = float(model.opt.timestep)
        self._inertia_rate = jnp.asarray(model.dof_M0[dofs] / model.opt.timestep, jnp.float32)
        ranges = config.randomization
        self.gear_play = ranges.backlash == "gear_play"
        if self.gear_play:
            self._tooth_stiffness = ranges.tooth_stiffness
            self._rotor_inertia, self._steps = _rotors(ranges, model, dofs)
            self._link_inertia = np.asarray(1 / model.dof_invweight0[dofs], np.float32)

    def begin(self, joints: jax.Array) -> GearState | None:
        """Gears at the start of an episode: rotors at rest in the middle of their gaps."""
        return gear_at(joints, jnp.zeros_like(joints)) if self.gear_play else None

    def encoder(self, joints: jax.Array, gear: GearState | None) -> jax.Array:
        """What the encoders [J] rad turn with: the joint, or the rotor before the gap."""
        return joints if gear is None else gear.rotor.position

    def tick(
        self, state: State, joint_target: jax.Array, push: jax.Array
    ) -> tuple[PhysicsState, jax.Array, GearState | None]:
        """A tick of physics under the motors: the state after it, forces [F, 3] N, gears."""
        motors = self.motors(state.draw, state.joint_target, joint_target)
        if not self.gear_play:
            after, force = self.physics.advance(
                state.target, state.physics, lambda *inputs: motors(*inputs, None)[0], push
            )
            return after, force, None
        return self.physics.advance_motors(state.target, state.physics, motors, state.gear, push)

    def motors(self, draw: Draw, before: jax.Array, target: jax.Array) -> Motors:
        """The motors as `Physics.advance_motors` wants them; `before` [J] rad acts until the latency is over."""
        if self.gear_play:
            return self._geared(draw, before, target)

        def motors(substep: jax.Array, position: jax.Array, velocity: jax.Array, gear: None) -> tuple[jax.Array, None]:
            wanted = delayed_target(substep, draw.latency, before, target)
            torque = drive(draw.actuator, wanted, jnp.zeros_like(wanted), position, velocity)
            return apply_friction(draw.actuator, torque, velocity, self._inertia_rate), None

        return motors

    def _geared(self, draw: Draw, before: jax.Array, target: jax.Array) -> Motors:
        play = GearPlay(draw.gear_gap, self._rotor_inertia, self._tooth_stiffness)

        def motors(
            substep: jax.Array, position: jax.Array, velocity: jax.Array, gear: GearState
        ) -> tuple[jax.Array, GearState]:
            wanted = delayed_target(substep, draw.latency, before, target)
            return drive_beside(
                draw.actuator,
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

    def reading(
        self, draw: Draw, before: jax.Array, target: jax.Array, physics: PhysicsState, gear: GearState | None
    ) -> jax.Array:
        """The torque [J] Nm that the motors' currents tell of at the end of a tick, before friction."""
        position, velocity = (physics.qpos[self.physics.joint_qpos], physics.qvel[self.physics.joint_dof])
        if gear is not None:
            position, velocity = gear.rotor.position, gear.rotor.velocity
        wanted = delayed_target(jnp.asarray(self._substeps), draw.latency, before, target)
        return drive(draw.actuator, wanted, jnp.zeros_like(wanted), position, velocity)


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
    most = ranges.damping * max(1.0, 1 + ranges.scale * (ranges.damping_factor[1] - 1))
    return np.asarray(rotor, np.float32), max(int(np.ceil(most * model.opt.timestep / rotor.min())), 1)
