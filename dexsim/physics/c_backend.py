"""C MuJoCo on the CPU's cores (`mujoco.batch`): the fastest engine there, without gradients.

A control tick is one call from the compiled program, also for a batch. Motors are evaluated in it at every sub-step,
from JAX's own trace of them (`dexsim.physics.law`).

What goes in decides what comes out: all that differs between worlds, and their whole state, is written at every tick.
What stays from call to call is memory and threads.

The call is one of XLA's FFI (`dexsim.physics.ffi`). `jax.pure_callback` hands over its arguments as JAX arrays. Reading
one waits for a copy on the CPU client's own threads, and with asynchronous dispatch on two cores these may all be
waiting for the callback: a deadlock. It also keeps programs out of JAX's compilation cache, since they hold an address
of the process. An FFI call does neither, and gets XLA's buffers as NumPy arrays without a copy.
"""

import contextlib
import dataclasses
import functools
import hashlib
import math
import os
import threading
from collections.abc import Iterator
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco.batch import Batch

from dexsim.core.compilation import available_cores
from dexsim.errors import AssetError
from dexsim.physics import ffi
from dexsim.physics.interface import Fields, ImplicitLaw, PhysicsScene, PhysicsState, StepResult, places
from dexsim.physics.law import evaluator, record

TARGET = "dexsim_host"
_WARNINGS = mujoco.mjtWarning
_FULL = [_WARNINGS.mjWARN_CONTACTFULL.value, _WARNINGS.mjWARN_CNSTRFULL.value]
# MuJoCo resets a world that is not a number, or out of bounds.
_DIVERGED = [w.value for w in (_WARNINGS.mjWARN_BADQPOS, _WARNINGS.mjWARN_BADQVEL, _WARNINGS.mjWARN_BADQACC)]
_lock = threading.Lock()  # one tick at a time has all cores


class CBackend:
    """`dexsim.physics.interface.Backend` in C MuJoCo."""

    def __init__(self, scene: PhysicsScene):
        """Worlds are made at the first tick of a batch."""
        model = scene.model
        # The compiler lets C MuJoCo skip offsets that are zero in the template. Objects bring others.
        model.geom_sameframe[scene.object_geoms] = mujoco.mjtSameFrame.mjSAMEFRAME_NONE
        model.body_sameframe[scene.object_body] = mujoco.mjtSameFrame.mjSAMEFRAME_NONE
        if model.body_simple[scene.object_body]:
            raise AssetError(f"{scene.hand.model_path}: backend c: the object's inertia was compiled as diagonal")
        self.scene, self._key, self._fields = scene, _digest(scene), tuple(places(scene))
        _scenes[self._key] = scene
        ffi.register(TARGET, "cpu", _serve)

    def advance(self, fields: Fields, state: PhysicsState, law: ImplicitLaw, push: jax.Array) -> StepResult:
        """One control tick in one call."""
        # Under `vmap` a batch is one call. Batch axes come first in every array, of length one in those that the whole
        # batch shares.
        recorded = record(law, jnp.zeros(len(self.scene.joint_dof), state.qpos.dtype))
        moving = [state.qpos, state.qvel, state.warmstart]
        arguments = [*(fields[name] for name in self._fields), *moving, push, *recorded.constants]
        results = [jax.ShapeDtypeStruct(x.shape, x.dtype) for x in moving]
        results.append(jax.ShapeDtypeStruct((self.scene.hand.num_fingers, 3), state.qpos.dtype))
        call = jax.ffi.ffi_call(TARGET, results, vmap_method="expand_dims")
        *after, force = call(*map(jnp.asarray, arguments), scene=self._key, law=recorded.text)
        return StepResult(PhysicsState(*after), force)


class _Worlds:
    """Worlds that differ in some fields of the model, and the arrays through which they are written and read."""

    def __init__(self, scene: PhysicsScene, size: int):
        self.scene, self.process = scene, os.getpid()
        # One thread for each core that this process may use.
        self.batch = Batch(scene.model, size, available_cores())
        where = places(scene)
        self._fields = {name: [(self.batch.expand(name), place)] for name, place in where.items()}
        # The subtree of the object's body is the object.
        self._fields["body_mass"].append((self.batch.expand("body_subtreemass"), where["body_mass"]))
        self.qpos, self.qvel = self.batch.bind("qpos"), self.batch.bind("qvel")
        self.warmstart = self.batch.bind("qacc_warmstart")
        self.armature = self.batch.expand("dof_armature")
        self.torque, self.wrench = self.batch.bind("qfrc_applied"), self.batch.bind("xfrc_applied")
        self.sensors = self.batch.bind("sensordata").reshape(size, -1, 3)

    def tick(self, law: bytes, inputs: list[np.ndarray]) -> list[np.ndarray]:
        """Positions, velocities, accelerations, and the fingers' forces [B, F, 3] N of the last sub-step. Raises
        RuntimeError: in a forked child, which has none of its parent's threads."""
        if self.process != os.getpid():
            raise RuntimeError(
                "backend 'c' does not work in a forked process, which lacks its threads: "
                "start processes with multiprocessing.get_context('spawn')"
            )
        for targets, value in zip(self._fields.values(), inputs, strict=False):
            for array, where in targets:
                array[(slice(None), *(where if isinstance(where, tuple) else (where,)))] = value
        scene, warning = self.scene, self.batch.warning[..., 1]
        qpos, qvel, warmstart, push, *constants = inputs[len(self._fields) :]
        self.qpos[:], self.qvel[:], self.warmstart[:] = qpos, qvel, warmstart
        self.wrench[:, scene.object_body, :3] = push
        warning[:] = 0
        motors, dofs = evaluator(law)(constants), scene.joint_dof
        armature = scene.model.dof_armature[dofs]
        for substep in range(scene.config.substeps):
            position = self.qpos[:, scene.joint_qpos].astype(qpos.dtype)
            velocity = self.qvel[:, dofs].astype(qvel.dtype)
            self.torque[:, dofs], inertia = motors(substep, position, velocity)
            self.armature[:, dofs] = armature + inertia
            self.batch.step()
        if warning[:, _FULL].any():
            raise MemoryError("C MuJoCo has no room for all contacts: raise <size memory> in the hand's MJCF")
        force = -self.sensors
        force[warning[:, _DIVERGED].any(1)] = np.nan
        return [self.qpos, self.qvel, self.warmstart, force]


# Programs name their scene by a hash, so that one that was loaded from a cache finds it. Scenes stay: a program may
# still be running, asynchronously, when its environment is gone already.
_scenes: dict[str, PhysicsScene] = {}
_worlds = functools.lru_cache(maxsize=8)(lambda key, size: _Worlds(_scenes[key], size))


def _serve(frame: Any) -> None:
    """A control tick of a batch; see `CBackend.advance` for what crosses."""
    attributes, out = ffi.attributes(frame), ffi.arrays(frame.results)
    shape = out[0].shape[:-1]
    inputs = [_flatten(x, shape) for x in ffi.arrays(frame.arguments)]
    with _lock, _no_warnings():
        worlds = _worlds(attributes["scene"].decode(), math.prod(shape))
        for target, value in zip(out, worlds.tick(attributes["law"], inputs), strict=True):
            target[...] = value.reshape(target.shape)


def _digest(scene: PhysicsScene) -> str:
    """A hash of the compiled scene, and of which of its rows are what: two hands may differ in the order of joints."""
    buffer = np.zeros(mujoco.mj_sizeModel(scene.model), np.uint8)
    mujoco.mj_saveModel(scene.model, None, buffer)
    digest = hashlib.sha256(buffer.tobytes())
    digest.update(f"{scene.config.substeps}".encode())
    for field in dataclasses.fields(scene):
        if isinstance(rows := getattr(scene, field.name), np.ndarray):
            digest.update(f"{field.name}{rows.tolist()}".encode())
    return digest.hexdigest()[:16]


@contextlib.contextmanager
def _no_warnings() -> Iterator[None]:
    """MuJoCo writes warnings to the terminal and to a file in the working directory. Here they are counted."""
    before = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(lambda message: None)
    try:
        with np.errstate(all="ignore"):
            yield
    finally:
        mujoco.set_mju_user_warning(before)


def _flatten(value: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """`value` [*shape, ...] with one batch axis, of length one if the whole batch shares it."""
    lead, own = value.shape[: len(shape)], value.shape[len(shape) :]
    if math.prod(lead) == 1:
        return value.reshape(1, *own)
    return np.broadcast_to(value, shape + own).reshape(-1, *own)
