"""C MuJoCo on all cores: ticks of a batch of environments, each with a model of its own.

What goes in decides what comes out. Models and data stay from call to call, as a cache: rows whose parameters differ
from those written last are written again. Batches of several sizes have models of their own.
"""

import collections
import contextlib
import copy
import functools
import math
import os
import threading
from collections.abc import Iterator
from typing import Any

import mujoco
import numpy as np
from mujoco.rollout import Rollout

from dexsim.core.compilation import available_cores
from dexsim.physics.host.law import read_law
from dexsim.physics.interface import PhysicsScene
from dexsim.physics.parameters import places

_SIZES_KEPT = 8
_APPLIED = mujoco.mjtState.mjSTATE_QFRC_APPLIED.value | mujoco.mjtState.mjSTATE_XFRC_APPLIED.value
# s, time at the start of a sub-step. MuJoCo resets a world that diverges, its clock too: that is how it shows.
_CLOCK = 1.0


class _Pool:
    """One thread for each core that this process may use, shared by all engines. One call at a time."""

    def __init__(self):
        self.lock, self.process = threading.Lock(), os.getpid()
        self.threads = available_cores()
        self.rollout = Rollout(nthread=self.threads if self.threads > 1 else 0).rollout_


@functools.cache
def pool() -> _Pool:
    """The pool, started at its first use.

    Raises:
      RuntimeError: in a forked child, which has none of its parent's threads.
    """
    return _Pool()


class _Rows:
    """The models of a batch, and what was written into each of them last."""

    def __init__(self, template: mujoco.MjModel, size: int):
        self.size = size
        self.models = [copy.copy(template) for _ in range(size)]
        self._template = template
        self._given: dict[str, np.ndarray] = {}
        self._whole: dict[str, np.ndarray] = {}
        self._views: dict[str, list[np.ndarray]] = {}
        nstate = mujoco.mj_stateSize(template, mujoco.mjtState.mjSTATE_FULLPHYSICS.value)
        self.states = [np.zeros((size, nstate)) for _ in range(2)]
        self.applied = np.zeros((size, mujoco.mj_stateSize(template, _APPLIED)))
        self.warmstart, self.sensors = np.zeros((size, template.nv)), np.zeros((size, template.nsensordata))

    def write(self, name: str, index: Any, values: np.ndarray) -> None:
        """Set `field[index]` of every model, where it differs from what is there."""
        last = self._given.get(name)
        if last is None:
            self._given[name] = np.array(values)
            self._whole[name] = np.repeat(np.asarray(getattr(self._template, name), float)[None], self.size, 0)
            self._views[name] = [getattr(model, name) for model in self.models]
            rows = list(range(self.size))
        else:
            rows = np.flatnonzero((values != last).reshape(self.size, -1).any(1)).tolist()
            if not rows:
                return
            np.copyto(last, values)
        whole, views = self._whole[name], self._views[name]
        whole[(slice(None), *(index if isinstance(index, tuple) else (index,)))] = values
        for row in rows:
            np.copyto(views[row], whole[row])


class HostEngine:
    """One scene. `tick` is what a compiled program calls."""

    def __init__(self, scene: PhysicsScene):
        """`scene` has a contact sensor for each fingertip."""
        self.scene, model = scene, scene.model
        self._places = places(scene)
        self._datas = [mujoco.MjData(model) for _ in range(pool().threads)]
        self._rows: collections.OrderedDict[tuple[int, tuple[str, ...]], _Rows] = collections.OrderedDict()
        self._push = model.nv + 6 * scene.object_body + np.arange(3)
        self.diverged = 0
        """World-ticks so far that MuJoCo gave up: not a number, or out of bounds."""

    def _batch(self, size: int, fields: list[str]) -> _Rows:
        """Models of their own for each set of fields: what one environment writes, another may leave as it is."""
        key = size, tuple(fields)
        if key not in self._rows:
            self._rows[key] = _Rows(self.scene.model, size)
            while len(self._rows) > _SIZES_KEPT:
                self._rows.popitem(last=False)
        self._rows.move_to_end(key)
        return self._rows[key]

    def tick(self, fields: list[str], substeps: int, law: bytes, arguments: list[np.ndarray], out: list) -> None:
        """Some sub-steps for a batch; see `dexsim.physics.c_backend.CBackend` for what crosses."""
        shape = out[0].shape[:-1]
        rank, size = len(shape), math.prod(shape)
        given = [_flatten(x, shape, rank, size) for x in arguments]
        workers = pool()
        if workers.process != os.getpid():
            raise RuntimeError(
                "backend 'c' does not work in a forked process, which lacks its threads: "
                "start processes with multiprocessing.get_context('spawn')"
            )
        with workers.lock, np.errstate(all="ignore"), _no_warnings():
            rows = self._batch(size, fields)
            for name, values in zip(fields, given, strict=False):
                values = np.broadcast_to(values, (size, *values.shape[1:]))
                rows.write(name, self._places[name], values)
                if name == "body_mass":
                    rows.write("body_subtreemass", self._places[name], values)
            results = self._run(workers, rows, substeps, law, given[len(fields) :])
        for target, value in zip(out, results, strict=True):
            target[...] = value.reshape(target.shape) if value.shape[0] == size else value

    def _run(self, workers: _Pool, rows: _Rows, substeps: int, law: bytes, given: list[np.ndarray]) -> list[np.ndarray]:
        model, scene, torque_law = self.scene.model, self.scene, read_law(law)
        qpos, qvel, warmstart, push, *rest = given
        memory_size = torque_law.outputs - 1
        constants, memory = rest[: len(rest) - memory_size], rest[len(rest) - memory_size :]
        before, after = rows.states
        joints, dofs = 1 + scene.joint_qpos, 1 + model.nq + scene.joint_dof
        speeds = slice(1 + model.nq, 1 + model.nq + model.nv)
        before[:, 0], before[:, 1 : 1 + model.nq], before[:, speeds] = _CLOCK, qpos, qvel
        rows.warmstart[:], rows.applied[:, self._push] = warmstart, push
        lost = np.zeros(rows.size, bool)
        for substep in range(substeps):
            position, velocity = (before[:, columns].astype(qpos.dtype) for columns in (joints, dofs))
            torque, memory = torque_law(constants, substep, position, velocity, memory)
            rows.applied[:, scene.joint_dof] = torque
            self._step(workers, rows, before, after)
            lost |= after[:, 0] < _CLOCK
            # The warm start is the acceleration, which semi-implicit Euler has added to the velocity.
            rows.warmstart[:] = (after[:, speeds] - before[:, speeds]) / model.opt.timestep
            after[:, 0] = _CLOCK
            before, after = after, before
        force = -rows.sensors.reshape(rows.size, -1, 3)
        if lost.any():
            self.diverged += int(lost.sum())
            force[lost] = np.nan
        return [before[:, 1 : 1 + model.nq], before[:, speeds], rows.warmstart, force, *memory]

    def _step(self, workers: _Pool, rows: _Rows, before: np.ndarray, after: np.ndarray) -> None:
        workers.rollout.rollout(
            rows.models,
            self._datas,
            1,
            _APPLIED,
            before,
            rows.warmstart,
            rows.applied,
            after,
            rows.sensors,
            max(1, rows.size // (10 * workers.threads)),
        )
        if any(data.maxuse_arena >= 0.9 * data.narena for data in self._datas):
            raise MemoryError("C MuJoCo has no room for all contacts: raise <size memory> in the hand's MJCF")


@contextlib.contextmanager
def _no_warnings() -> Iterator[None]:
    """MuJoCo writes warnings to the terminal and to a file in the working directory. Here its clock tells of them."""
    before = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(lambda message: None)
    try:
        yield
    finally:
        mujoco.set_mju_user_warning(before)


def _flatten(value: np.ndarray, shape: tuple[int, ...], rank: int, size: int) -> np.ndarray:
    """`value` with one batch axis, of length one if the whole batch shares it."""
    lead, own = value.shape[:rank], value.shape[rank:]
    if math.prod(lead) == 1 and size != 1:
        return value.reshape(1, *own)
    return np.broadcast_to(value, shape + own).reshape(size, *own)
