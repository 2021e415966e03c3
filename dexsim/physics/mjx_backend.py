"""What both implementations of MJX share: the model of one environment, and a tick of `mjx.step`."""

from types import ModuleType
from typing import Any

import jax
import jax.numpy as jnp

from dexsim.core.errors import AssetError
from dexsim.objects.params import ObjectParams, bounding_radius
from dexsim.physics.seam import ContactParams, PhysicsScene, PhysicsState, TorqueLaw


class MjxBackend:
    """A scene in MJX; see `dexsim.physics.seam.Backend`. Each implementation adds its data and its force reader."""

    def __init__(self, scene: PhysicsScene, impl: str):
        """Raises AssetError: MJX lacks what the scene uses."""
        from mujoco import mjx

        self.scene = scene
        self.mjx: ModuleType = mjx
        try:
            self.model = mjx.put_model(scene.model, impl=impl)
        except NotImplementedError as error:
            raise AssetError(f"{scene.hand.model_path}: backend {impl}: {error}") from None

    def make_data(self) -> Any:
        """Empty data for one environment."""
        raise NotImplementedError

    def finger_force(self, data: Any) -> jax.Array:
        """Force [F, 3] N of the object on each finger, from data after a step."""
        raise NotImplementedError

    def configure(self, object: ObjectParams, contacts: ContactParams) -> Any:
        """The MJX model with one environment's object and contact parameters put in."""
        model, scene = self.model, self.scene
        geoms, body, pair = scene.object_geoms, scene.object_body, scene.object_pairs
        # body_invweight0 keeps its template value on purpose: the contact's parameters are worked
        # out from it, and stiffness must not change with the mass of what is touched.
        return model.replace(
            geom_size=model.geom_size.at[geoms].set(object.size),
            geom_rbound=model.geom_rbound.at[geoms].set(bounding_radius(object.size, scene.slots)),
            geom_pos=model.geom_pos.at[geoms].set(object.position),
            geom_quat=(model.geom_quat if object.quat is None else model.geom_quat.at[geoms].set(object.quat)),
            body_mass=model.body_mass.at[body].set(object.mass),
            body_inertia=model.body_inertia.at[body].set(object.inertia),
            body_ipos=model.body_ipos.at[body].set(object.com),
            pair_friction=model.pair_friction.at[pair, :2].set(contacts.friction[:, None]),
            pair_solref=model.pair_solref.at[pair].set(contacts.solref),
            pair_solimp=model.pair_solimp.at[pair].set(contacts.solimp),
        )

    def advance(
        self,
        object: ObjectParams,
        contacts: ContactParams,
        state: PhysicsState,
        torque: TorqueLaw,
        memory: Any,
        push: jax.Array,
    ) -> tuple[PhysicsState, jax.Array, Any]:
        """One control tick by `mjx.step`."""
        scene, model = self.scene, self.configure(object, contacts)
        data = self.make_data().replace(qpos=state.qpos, qvel=state.qvel, qacc_warmstart=state.warmstart)
        wrench = jnp.zeros((scene.model.nbody, 6)).at[scene.object_body, :3].set(push)
        data = data.replace(xfrc_applied=wrench)

        def substep(carry: tuple[Any, Any], index: jax.Array) -> tuple[tuple[Any, Any], None]:
            data, memory = carry
            tau, memory = torque(index, data.qpos[scene.joint_qpos], data.qvel[scene.joint_dof], memory)
            applied = jnp.zeros(scene.model.nv).at[scene.joint_dof].set(tau)
            return (self.mjx.step(model, data.replace(qfrc_applied=applied)), memory), None

        # Forces are read after the scan: stacking sensordata as a scan output more than doubled
        # the step and returned zeros on the GPU.
        (data, memory), _ = jax.lax.scan(substep, (data, memory), jnp.arange(scene.config.substeps))
        after = PhysicsState(data.qpos, data.qvel, data.qacc_warmstart)
        return after, self.finger_force(data), memory
