"""Physics that compile in a second: `dexsim.env.env.Env` around them is the real one."""

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np

from dexsim.physics.interface import PhysicsState, StepResult

INERTIA = 1e-3  # kg m^2, of every joint


class SimplePhysics:
    """Each joint is a mass of its own under torque and damping; the object falls, and fingers that turned feel it."""

    def __init__(self, hand, slots, largest, config, **options):
        self.backend, self.config = "mjx", config
        self.joint_qpos, self.joint_dof = np.arange(12), np.arange(12)
        self.object_qpos, self.object_dof = np.arange(12, 19), np.arange(12, 18)
        del options
        self.mj_model = SimpleNamespace(nv=18, dof_M0=np.full(18, INERTIA))

    def tip_stiffness(self, object, pose, position, rotation, skin_force, pad_thickness_delta=0.0):
        return jnp.ones(5)

    def fields(self, object, tip_stiffness, pad_thickness_delta):
        return object  # nothing touches anything

    def advance(self, law, object, state, push, held=None):
        def substep(carry, index):
            qpos, qvel = carry
            tau = law(index, qpos[:12], qvel[:12])
            motors, fall = (tau - 0.02 * qvel[:12]) / INERTIA, jnp.array([9.81, 0, 0]) + push / object.mass
            qvel = qvel.at[:15].add(self.config.timestep * jnp.concatenate([motors, fall]))
            return (qpos.at[:15].add(self.config.timestep * qvel[:15]), qvel), None

        steps = jnp.arange(self.config.substeps)
        (qpos, qvel), _ = jax.lax.scan(substep, (state.qpos, state.qvel), steps)
        if held is not None:
            qpos = jnp.where(held & (np.arange(19) >= 12), state.qpos, qpos)
            qvel = jnp.where(held & (np.arange(18) >= 12), 0.0, qvel)
        force = jnp.zeros((5, 3)).at[:, 0].set(jnp.maximum(qpos[:10:2] - 0.5, 0))
        return StepResult(PhysicsState(qpos, qvel, state.warmstart), force)
