"""MJX's JAX implementation, any device and differentiable: our contacts and solver where the scene allows them."""

import warnings
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from dexsim.core.errors import DexsimWarning
from dexsim.objects.params import ObjectParams
from dexsim.physics.interface import ContactParams, PhysicsScene, PhysicsState, StepResult, TorqueLaw
from dexsim.physics.mjx_backend import MjxBackend
from dexsim.physics.solver.substep import find_stepper


class JaxBackend(MjxBackend):
    """`dexsim.physics.interface.Backend` in JAX."""

    def __init__(self, scene: PhysicsScene, num_envs: int = 1):
        """Raises AssetError: MJX lacks what the scene uses. JAX reserves no memory for `num_envs`."""
        del num_envs
        super().__init__(scene, "jax")
        model, tips = scene.model, scene.tip_bodies
        fingers = {int(body): finger for finger, body in enumerate(tips)}
        # Whose tip link a geom belongs to, -1 for none.
        self._finger_of_geom = np.array([fingers.get(int(body), -1) for body in model.geom_bodyid])
        self._is_object_geom = np.isin(np.arange(model.ngeom), scene.object_geoms)
        self._stepper = None
        if scene.config.contacts == "closed":
            self._stepper = find_stepper(self.mjx, model, tips, max_contacts=scene.config.max_contacts)
            if self._stepper is None:
                warnings.warn(
                    f"backend jax: {scene.hand.name} in this scene needs mjx.step, about twice as slow, with "
                    "other contact points on boxes; PhysicsConfig.contacts = 'mjx' asks for it",
                    DexsimWarning,
                    stacklevel=2,
                )

    def make_data(self) -> Any:
        """Empty data for one environment."""
        return self.mjx.make_data(self.model)

    def advance(
        self,
        object: ObjectParams,
        contacts: ContactParams,
        state: PhysicsState,
        torque: TorqueLaw,
        push: jax.Array,
    ) -> StepResult:
        """One control tick, with our contacts and solver (`substep`) or by `mjx.step`."""
        stepper = self._stepper
        if stepper is None:
            return super().advance(object, contacts, state, torque, push)
        scene, model = self.scene, self.configure(object, contacts)
        data = self.make_data()

        def run(carry: tuple[Any, ...], index: jax.Array) -> tuple[tuple[Any, ...], jax.Array]:
            qpos, qvel, warmstart = carry
            tau = torque(index, qpos[scene.joint_qpos], qvel[scene.joint_dof])
            applied = jnp.zeros(scene.model.nv).at[scene.joint_dof].set(tau)
            return stepper.step(model, data.replace(qpos=qpos, qvel=qvel, qacc_warmstart=warmstart), applied, push)

        # The force is not part of the carry: it would begin as zeros, which are the same for all environments, and
        # vmap would trace all of this twice.
        begin = (state.qpos, state.qvel, state.warmstart)
        after, forces = jax.lax.scan(run, begin, jnp.arange(scene.config.substeps))
        return StepResult(PhysicsState(*after), forces[-1])

    def finger_force(self, data: Any) -> jax.Array:
        """Sum the solver's forces [F, 3] N per finger; this implementation has no sensor that matches bodies."""
        fingers = self.scene.hand.num_fingers
        touch = data._impl.contact
        dim, address = np.asarray(touch.dim), np.asarray(touch.efc_address)
        use = np.flatnonzero((dim == 3) & (address >= 0))
        local = data._impl.efc_force[address[use][:, None] + np.arange(3)]
        frame = touch.frame[use]  # rows are the axes; the normal points from geom1 to geom2
        force = jnp.sum(frame * local[..., None], 1)
        touching = (touch.dist[use] < touch.includemargin[use])[:, None]
        force = jnp.where(touching, force, 0.0)
        finger = jnp.asarray(self._finger_of_geom)[touch.geom[use]]
        is_object = jnp.asarray(self._is_object_geom)[touch.geom[use]]
        # MuJoCo's contact force acts on geom2; geom1 feels the opposite.
        on_second = is_object[None, :, 0].astype(jnp.float32) * jax.nn.one_hot(finger[:, 1], fingers).T
        on_first = is_object[None, :, 1].astype(jnp.float32) * jax.nn.one_hot(finger[:, 0], fingers).T
        return jnp.sum((on_second - on_first)[..., None] * force[None], 1)
