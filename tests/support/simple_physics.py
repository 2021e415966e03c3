"""Physics that compile in a second: `dexsim.env.env.Env` around them is the real one."""

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np

from dexsim.physics.seam import PhysicsState

ARMATURE = 5e-4  # kg m^2, of every joint


class SimplePhysics:
    """Each joint is a mass of its own under torque and damping; the object falls, and fingers that turned feel it."""

    def __init__(self, hand, slots, largest, config, **options):
        self.backend, self.config = "jax", config
        self.joint_qpos, self.joint_dof = np.arange(12), np.arange(12)
        self.object_qpos, self.object_dof = np.arange(12, 19), np.arange(12, 18)
        armature = ARMATURE * (1 - options.get("rotor_share", 0.0))
        self.inertia = 5e-4 + armature
        self.mj_model = SimpleNamespace(
            nv=18,
            dof_M0=np.full(18, self.inertia),
            dof_armature=np.full(18, armature),
            dof_invweight0=np.full(18, 1 / self.inertia),
            opt=SimpleNamespace(timestep=config.timestep),
        )

    def advance(self, object, state, torque, push, cover=0.0):
        motors = lambda index, position, velocity, memory: (torque(index, position, velocity), memory)  # noqa: E731
        return self.advance_motors(object, state, motors, None, push, cover)[:2]

    def advance_motors(self, object, state, motors, memory, push, cover=0.0):
        del cover  # nothing touches anything

        def substep(carry, index):
            qpos, qvel, memory = carry
            tau, memory = motors(index, qpos[:12], qvel[:12], memory)
            speed = qvel[:12] + self.config.timestep / self.inertia * (tau - 0.02 * qvel[:12])
            fall = qvel[12:15] + self.config.timestep * (jnp.array([9.81, 0, 0]) + push / object.mass)
            qvel = jnp.concatenate([speed, fall, qvel[15:]])
            moved = jnp.concatenate(
                [qpos[:12] + self.config.timestep * speed, qpos[12:15] + self.config.timestep * fall, qpos[15:]]
            )
            return (moved, qvel, memory), None

        steps = jnp.arange(self.config.substeps)
        (qpos, qvel, memory), _ = jax.lax.scan(substep, (state.qpos, state.qvel, memory), steps)
        force = jnp.zeros((5, 3)).at[:, 0].set(jnp.maximum(qpos[:10:2] - 0.5, 0))
        return PhysicsState(qpos, qvel, state.warmstart), force, memory
