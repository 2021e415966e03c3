"""C MuJoCo on all cores: ticks of a batch of worlds, each with object, contacts and fingertips of its own.

What goes in decides what comes out: all that differs between worlds, and their whole state, is written at every tick.
What stays from call to call, a `mujoco.batch.Batch` for each size, is memory and threads.
"""

import collections
import contextlib
import math
import os
import threading
from collections.abc import Iterator

import mujoco
import numpy as np
from mujoco.batch import Batch

from dexsim.core.compilation import available_cores
from dexsim.physics.host.law import Law, read_law
from dexsim.physics.interface import PhysicsScene
from dexsim.physics.parameters import places

_SIZES_KEPT = 8
_WARNINGS = mujoco.mjtWarning
_FULL = [_WARNINGS.mjWARN_CONTACTFULL.value, _WARNINGS.mjWARN_CNSTRFULL.value]
# MuJoCo resets a world that is not a number, or out of bounds.
_DIVERGED = [w.value for w in (_WARNINGS.mjWARN_BADQPOS, _WARNINGS.mjWARN_BADQVEL, _WARNINGS.mjWARN_BADQACC)]
_lock = threading.Lock()  # one tick at a time has all cores


class _Worlds:
    """Worlds that differ in some fields of the model, and the arrays through which they are written and read."""

    def __init__(self, scene: PhysicsScene, size: int, fields: list[str]):
        self.size, self.process = size, os.getpid()
        # One thread for each core that this process may use.
        self.batch = Batch(scene.model, size, available_cores())
        where = {
            name: (slice(None), *(index if isinstance(index, tuple) else (index,)))
            for name, index in places(scene).items()
        }
        self._fields = [[(self.batch.expand(name), where[name])] for name in fields]
        # The subtree of the object's body is the object.
        self._fields[fields.index("body_mass")].append((self.batch.expand("body_subtreemass"), where["body_mass"]))
        self.qpos, self.qvel = self.batch.bind("qpos"), self.batch.bind("qvel")
        self.warmstart = self.batch.bind("qacc_warmstart")
        self.torque, self.wrench = self.batch.bind("qfrc_applied"), self.batch.bind("xfrc_applied")
        self.sensors = self.batch.bind("sensordata").reshape(size, -1, 3)

    def configure(self, values: list[np.ndarray]) -> None:
        """Write the models' fields."""
        for targets, value in zip(self._fields, values, strict=True):
            for array, where in targets:
                array[where] = value


class HostEngine:
    """One scene. `tick` is what a compiled program calls."""

    def __init__(self, scene: PhysicsScene):
        """`scene` has a contact sensor for each fingertip."""
        self.scene = scene
        self._worlds: collections.OrderedDict[tuple[int, tuple[str, ...]], _Worlds] = collections.OrderedDict()
        self.diverged = 0
        """World-ticks so far that MuJoCo gave up: not a number, or out of bounds."""

    def _batch(self, size: int, fields: list[str]) -> _Worlds:
        """Worlds of their own for each set of fields: what one environment writes, another may leave as it is.

        Raises:
          RuntimeError: in a forked child, which has none of its parent's threads.
        """
        key = size, tuple(fields)
        if key not in self._worlds:
            self._worlds[key] = _Worlds(self.scene, size, fields)
            while len(self._worlds) > _SIZES_KEPT:
                self._worlds.popitem(last=False)
        self._worlds.move_to_end(key)
        if self._worlds[key].process != os.getpid():
            raise RuntimeError(
                "backend 'c' does not work in a forked process, which lacks its threads: "
                "start processes with multiprocessing.get_context('spawn')"
            )
        return self._worlds[key]

    def tick(self, fields: list[str], substeps: int, law: bytes, arguments: list[np.ndarray], out: list) -> None:
        """Some sub-steps for a batch; see `dexsim.physics.c_backend.CBackend` for what crosses."""
        shape = out[0].shape[:-1]
        rank, size = len(shape), math.prod(shape)
        given = [_flatten(x, shape, rank, size) for x in arguments]
        with _lock, _no_warnings():
            worlds = self._batch(size, fields)
            worlds.configure(given[: len(fields)])
            results = self._run(worlds, substeps, read_law(law), given[len(fields) :])
            for target, value in zip(out, results, strict=True):
                target[...] = value.reshape(target.shape)

    def _run(self, worlds: _Worlds, substeps: int, law: Law, given: list[np.ndarray]) -> list[np.ndarray]:
        """Positions, velocities, accelerations, and the fingers' forces [B, F, 3] N of the last sub-step."""
        scene, warning = self.scene, worlds.batch.warning[..., 1]
        qpos, qvel, warmstart, push, *constants = given
        worlds.qpos[:], worlds.qvel[:], worlds.warmstart[:] = qpos, qvel, warmstart
        worlds.wrench[:, scene.object_body, :3] = push
        warning[:] = 0
        for substep in range(substeps):
            position = worlds.qpos[:, scene.joint_qpos].astype(qpos.dtype)
            velocity = worlds.qvel[:, scene.joint_dof].astype(qvel.dtype)
            worlds.torque[:, scene.joint_dof] = law(constants, substep, position, velocity)
            worlds.batch.step()
        if warning[:, _FULL].any():
            raise MemoryError("C MuJoCo has no room for all contacts: raise <size memory> in the hand's MJCF")
        force = -worlds.sensors
        if (diverged := warning[:, _DIVERGED].any(1)).any():
            self.diverged += int(diverged.sum())
            force[diverged] = np.nan
        return [worlds.qpos, worlds.qvel, worlds.warmstart, force]


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


def _flatten(value: np.ndarray, shape: tuple[int, ...], rank: int, size: int) -> np.ndarray:
    """`value` with one batch axis, of length one if the whole batch shares it."""
    lead, own = value.shape[:rank], value.shape[rank:]
    if math.prod(lead) == 1 and size != 1:
        return value.reshape(1, *own)
    return np.broadcast_to(value, shape + own).reshape(size, *own)
