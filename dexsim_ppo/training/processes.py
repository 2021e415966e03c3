"""Several processes that train together: they join, agree on when to stop, and the first alone writes files."""

import contextlib
import functools
import os
import sys
import traceback
from collections.abc import Iterator
from pathlib import Path
from typing import Any, cast

import jax
import numpy as np
from jax.experimental import multihost_utils
from jax.sharding import Mesh, NamedSharding

from dexsim.errors import DexsimError
from dexsim_ppo import checkpoint
from dexsim_ppo.learner.sharding import copied
from dexsim_ppo.learner.types import TrainState

# Set in each process of a job of several: by Slurm's srun, Open MPI's mpirun, an indexed job of Kubernetes.
_JOBS = ("SLURM_STEP_NODELIST", "OMPI_COMM_WORLD_SIZE", "JOB_COMPLETION_INDEX")
_LOST_AFTER = 60  # s without a sign of life
_REPORT = 3600  # s that the others wait for the first, which evaluates and renders


def connect() -> None:
    """Join the other processes of a Slurm, Open MPI or Kubernetes job, where this is one. Call it before any device
    is used."""
    if jax.distributed.is_initialized() or not any(name in os.environ for name in _JOBS):
        return
    try:
        jax.distributed.initialize(heartbeat_timeout_seconds=_LOST_AFTER, shutdown_timeout_seconds=_REPORT)
        agree(0)  # The first exchange on CPUs waits 30 s at most: now, since later one may compile longer than another.
    except (RuntimeError, ValueError) as error:
        raise DexsimError(f"the other processes of this job cannot be reached: {error}") from None


def is_first() -> bool:
    """Whether this process writes files and prints."""
    return jax.process_index() == 0


def agree(number: int) -> int:
    """The largest number that any process gives. All must call it."""
    if jax.process_count() == 1:
        return number
    return int(np.max(multihost_utils.process_allgather(np.int32(number))))


def print_on_first(text: str) -> None:
    """Print a line, in the first process."""
    if is_first():
        print(text, flush=True)


def save(path: Path, *, tree: TrainState, **content: Any) -> None:
    """`checkpoint.save` of the global state, written by the first process. All must call it."""
    if jax.process_count() > 1:  # A process can read what every device has, and no other process's environments.
        mesh = cast(NamedSharding, tree.iteration.sharding).mesh
        tree = jax.jit(functools.partial(copied, mesh=cast(Mesh, mesh)))(tree)
    if is_first():
        checkpoint.save(path, tree=tree, **content)


@contextlib.contextmanager
def exit_on_error() -> Iterator[None]:
    """End this process at once after an error where there are others: JAX's own shutdown would wait for them, and they
    for this one."""
    try:
        yield
    except Exception as error:
        if not jax.distributed.is_initialized():
            raise
        if isinstance(error, (DexsimError, OSError)):
            print(f"error: {' '.join(str(error).split())}", file=sys.stderr)
        else:
            traceback.print_exc()
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(2)
