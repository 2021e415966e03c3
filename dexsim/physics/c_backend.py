"""C MuJoCo on the CPU's cores: several times faster there than the JAX backend, without gradients.

A control tick is one call from the compiled program, also for a batch. Motors are evaluated in it at every sub-step,
from JAX's own trace of them (`dexsim.physics.host.law`).
"""

import collections
import dataclasses
import hashlib
import json
import weakref
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from dexsim.core.errors import AssetError, ConfigError
from dexsim.objects.params import ObjectParams
from dexsim.physics.host import call
from dexsim.physics.host.engine import HostEngine
from dexsim.physics.host.law import Recorded, one_by_one, record
from dexsim.physics.interface import ContactParams, PhysicsScene, PhysicsState, StepResult, TorqueLaw
from dexsim.physics.parameters import configured, values

# Programs name their engine by a hash of its scene, so that one that was loaded from a cache finds it.
_engines: weakref.WeakValueDictionary[str, HostEngine] = weakref.WeakValueDictionary()
# A program may still be running, asynchronously, when its environment is gone already.
_newest: collections.deque[HostEngine] = collections.deque(maxlen=4)


class CBackend:
    """`dexsim.physics.interface.Backend` in C MuJoCo."""

    def __init__(self, scene: PhysicsScene, num_envs: int = 1):
        """Worlds are made at the first tick of a batch, so `num_envs` reserves nothing."""
        del num_envs
        model = scene.model
        # The compiler lets C MuJoCo skip offsets that are zero in the template. Objects bring others.
        model.geom_sameframe[scene.object_geoms] = mujoco.mjtSameFrame.mjSAMEFRAME_NONE
        model.body_sameframe[scene.object_body] = mujoco.mjtSameFrame.mjSAMEFRAME_NONE
        if model.body_simple[scene.object_body]:
            raise AssetError(f"{scene.hand.model_path}: backend c: the object's inertia was compiled as diagonal")
        self.scene, self._key = scene, _digest(scene)
        self._engine = _engines.get(self._key) or HostEngine(scene)
        _engines[self._key] = self._engine
        _newest.append(self._engine)
        call.register(_serve)
        self._tick = jax.custom_jvp(self._call, nondiff_argnums=(0, 1, 2))
        self._tick.defjvp(_no_gradient)

    def configure(self, object: ObjectParams, contacts: ContactParams) -> dict[str, jax.Array]:
        """What the models of one environment have in place of the scene's, by the names of `mujoco.MjModel`."""
        return configured(self.scene, object, contacts)

    def advance(
        self,
        object: ObjectParams,
        contacts: ContactParams,
        state: PhysicsState,
        torque: TorqueLaw,
        push: jax.Array,
    ) -> StepResult:
        """One control tick in one call, or one for each sub-step if the host cannot evaluate the law."""
        scene, substeps = self.scene, self.scene.config.substeps
        fields = values(scene, object, contacts)
        law = self._record(torque, state)
        if law is not None:
            return self._advance(fields, state, law, push, substeps)

        def substep(torque: TorqueLaw, state: PhysicsState) -> StepResult:
            law = self._record(torque, state)
            assert law is not None
            return self._advance(fields, state, law, push, 1)

        return one_by_one(scene, substep, torque, state)

    def _record(self, torque: TorqueLaw, state: PhysicsState) -> Recorded | None:
        return record(torque, jnp.zeros(len(self.scene.joint_dof), state.qpos.dtype))

    def _advance(
        self, fields: dict[str, jax.Array], state: PhysicsState, law: Recorded, push: jax.Array, substeps: int
    ) -> StepResult:
        arguments = [*fields.values(), state.qpos, state.qvel, state.warmstart, push, *law.constants]
        *after, force = self._tick(tuple(fields), law.text, substeps, *map(jnp.asarray, arguments))
        return StepResult(PhysicsState(*after), force)

    def _call(self, fields: tuple[str, ...], law: str, substeps: int, *arguments: jax.Array) -> list[jax.Array]:
        state = [jax.ShapeDtypeStruct(x.shape, x.dtype) for x in arguments[len(fields) : len(fields) + 3]]
        force = jax.ShapeDtypeStruct((self.scene.hand.num_fingers, 3), state[0].dtype)
        head = json.dumps({"engine": self._key, "fields": fields, "substeps": substeps})
        return call.call([*state, force], *arguments, head=head, law=law)


def _no_gradient(*_: Any) -> Any:
    raise ConfigError("backend 'c' has no gradient: make the environment with backend='jax'")


def _serve(arguments: list[np.ndarray], results: list[np.ndarray], attributes: dict[str, bytes]) -> None:
    head = json.loads(attributes["head"])
    engine = _engines.get(head["engine"])
    if engine is None:
        raise RuntimeError("backend 'c': the environment of this program no longer exists")
    engine.tick(head["fields"], head["substeps"], attributes["law"], arguments, results)


def _digest(scene: PhysicsScene) -> str:
    """A hash of the compiled scene, and of which of its rows are what: two hands may differ in the order of joints."""
    buffer = np.zeros(mujoco.mj_sizeModel(scene.model), np.uint8)
    mujoco.mj_saveModel(scene.model, None, buffer)
    digest = hashlib.sha256(buffer.tobytes())
    for field in dataclasses.fields(scene):
        if isinstance(rows := getattr(scene, field.name), np.ndarray):
            digest.update(f"{field.name}{rows.tolist()}".encode())
    return digest.hexdigest()[:16]
