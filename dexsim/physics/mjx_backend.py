"""What both implementations of MJX share: the model of one environment, and a tick of `mjx.step`."""

from types import ModuleType
from typing import Any

import jax
import jax.numpy as jnp

from dexsim.core.errors import AssetError
from dexsim.objects.params import ObjectParams
from dexsim.physics.interface import ContactParams, PhysicsScene, PhysicsState, StepResult, TorqueLaw
from dexsim.physics.parameters import places, values


class MjxBackend:
    """A scene in MJX; see `dexsim.physics.interface.Backend`. Implementations add data and a force reader."""

    def __init__(self, scene: PhysicsScene, impl: str):
        """Raises AssetError: MJX lacks what the scene uses."""
        from mujoco import mjx

        self.scene = scene
        self.mjx: ModuleType = mjx
        try:
            self.model = mjx.put_model(scene.model, device=jax.local_devices()[0], impl=impl)
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
        where = places(self.scene)
        return self.model.replace(
            **{
                name: getattr(self.model, name).at[where[name]].set(value)
                for name, value in values(self.scene, object, contacts).items()
            }
        )

    def advance(
        self,
        object: ObjectParams,
        contacts: ContactParams,
        state: PhysicsState,
        torque: TorqueLaw,
        push: jax.Array,
    ) -> StepResult:
        """One control tick by `mjx.step`."""
        scene, model = self.scene, self.configure(object, contacts)
        data = self.make_data().replace(qpos=state.qpos, qvel=state.qvel, qacc_warmstart=state.warmstart)
        wrench = jnp.zeros((scene.model.nbody, 6)).at[scene.object_body, :3].set(push)
        data = data.replace(xfrc_applied=wrench)

        def substep(data: Any, index: jax.Array) -> tuple[Any, None]:
            tau = torque(index, data.qpos[scene.joint_qpos], data.qvel[scene.joint_dof])
            applied = jnp.zeros(scene.model.nv).at[scene.joint_dof].set(tau)
            # MJX relies on implicit promotion, which the caller may have made an error.
            with jax.numpy_rank_promotion("allow"), jax.numpy_dtype_promotion("standard"):
                return self.mjx.step(model, data.replace(qfrc_applied=applied)), None

        # Forces are read after the scan: stacking sensordata as a scan output more than doubled
        # the step and returned zeros on the GPU.
        data, _ = jax.lax.scan(substep, data, jnp.arange(scene.config.substeps))
        return StepResult(PhysicsState(data.qpos, data.qvel, data.qacc_warmstart), self.finger_force(data))
