"""Calls of Python from a compiled XLA program on the CPU, with NumPy arrays.

`jax.pure_callback` hands over its arguments as JAX arrays. Reading one waits for a copy on the CPU client's own
threads, and with asynchronous dispatch on two cores these may all be waiting for the callback: a deadlock. It also
keeps programs out of JAX's compilation cache, since they hold an address of the process. An FFI call
(`dexsim.physics.ffi`) does neither. It gets XLA's buffers as NumPy arrays, without a copy, and programs name its
target.
"""

import ctypes
import functools
import math
from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np

from dexsim.physics import ffi

TARGET = "dexsim_host"
# XLA's numbers of the types that cross.
_DTYPES = {1: np.bool_, 4: np.int32, 5: np.int64, 8: np.uint32, 9: np.uint64, 11: np.float32, 12: np.float64}

Handler = Callable[[list[np.ndarray], list[np.ndarray], dict[str, bytes]], None]
"""(arguments, results to be filled in, attributes), all valid during the call only."""


def _array(address: int) -> np.ndarray:
    buffer = ffi.Buffer.from_address(address)
    shape, dtype = buffer.dims[: buffer.rank], np.dtype(_DTYPES[buffer.dtype])
    memory = (ctypes.c_char * (math.prod(shape) * dtype.itemsize)).from_address(buffer.data or 0)
    return np.ndarray(shape, dtype, memory)


def _arrays(buffers: Any) -> list[np.ndarray]:
    return [_array(address) for address in ffi.addresses(buffers)]


def _serve(handler: Handler, frame: Any) -> None:
    handler(_arrays(frame.arguments), _arrays(frame.results), ffi.attributes(frame))


@functools.cache
def register(handler: Handler) -> None:
    """Make `handler` what `call` calls; once in a process."""
    ffi.register(TARGET, "cpu", functools.partial(_serve, handler))


def call(results: Sequence[jax.ShapeDtypeStruct], *arguments: jax.Array, **attributes: str) -> list[jax.Array]:
    """Call the handler from a traced program. Under `vmap` a batch is one call.

    Batch axes come first in every array. An argument that is the same for the whole batch has axes of length one there.
    """
    return list(jax.ffi.ffi_call(TARGET, list(results), vmap_method="expand_dims")(*arguments, **attributes))
