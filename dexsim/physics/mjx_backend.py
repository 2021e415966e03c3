"""MuJoCo's own MJX: any device, and gradients through contacts (`dexsim.physics.mjx_solver`)."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from dexsim.core.errors import AssetError
from dexsim.objects.params import ObjectParams
from dexsim.physics.interface import ContactParams, ImplicitLaw, PhysicsScene, PhysicsState, StepResult
from dexsim.physics.parameters import configured


class MjxBackend:
    """`dexsim.physics.interface.Backend` in JAX."""

    def __init__(self, scene: PhysicsScene):
        """Raises AssetError: MJX lacks what the scene uses."""
        from mujoco import mjx

        from dexsim.physics import mjx_solver

        self.scene, self.mjx, self.solver = scene, mjx, mjx_solver
        try:
            self.model = mjx.put_model(scene.model, device=jax.local_devices()[0], impl="jax")
        except NotImplementedError as error:
            raise AssetError(f"{scene.hand.model_path}: backend mjx: {error}") from None
        model = scene.model
        fingers = {int(body): finger for finger, body in enumerate(scene.tip_bodies)}
        # Whose tip link a geom belongs to, -1 for none.
        self._finger_of_geom = np.array([fingers.get(int(body), -1) for body in model.geom_bodyid])
        self._is_object_geom = np.isin(np.arange(model.ngeom), scene.object_geoms)

    def advance(
        self,
        object: ObjectParams,
        contacts: ContactParams,
        state: PhysicsState,
        law: ImplicitLaw,
        push: jax.Array,
    ) -> StepResult:
        """One control tick by MJX."""
        scene, model = self.scene, self.model.replace(**configured(self.scene, object, contacts))
        wrench = jnp.zeros((scene.model.nbody, 6)).at[scene.object_body, :3].set(push)
        data = self.mjx.make_data(self.model).replace(
            qpos=state.qpos, qvel=state.qvel, qacc_warmstart=state.warmstart, xfrc_applied=wrench
        )

        def substep(data: Any, index: jax.Array) -> tuple[Any, None]:
            torque, inertia = law(index, data.qpos[scene.joint_qpos], data.qvel[scene.joint_dof])
            applied = jnp.zeros(scene.model.nv).at[scene.joint_dof].set(torque)
            armature = self.model.dof_armature.at[scene.joint_dof].add(inertia)
            return self.step(model.replace(dof_armature=armature), data.replace(qfrc_applied=applied)), None

        # Forces are read after the scan: as an output of it they would double the step's time.
        with self.solver.mjx_arithmetic():
            data, _ = jax.lax.scan(substep, data, jnp.arange(scene.config.substeps))
        return StepResult(PhysicsState(data.qpos, data.qvel, data.qacc_warmstart), self.finger_force(data))

    def step(self, model: Any, data: Any) -> Any:
        """`mjx.step`, with a solver that has derivatives. Our scenes have no sensors."""
        mjx = self.mjx
        for stage in (mjx.fwd_position, mjx.fwd_velocity, mjx.fwd_actuation, mjx.fwd_acceleration):
            data = stage(model, data)
        acceleration, force = self.solver.solve(model, data)
        return mjx.euler(model, data.tree_replace({"qacc": acceleration, "_impl.efc_force": force}))

    def finger_force(self, data: Any) -> jax.Array:
        """Force [F, 3] N of the object on each finger, from data after a step: MJX has no sensor that matches bodies,
        so the solver's forces are added up."""
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
