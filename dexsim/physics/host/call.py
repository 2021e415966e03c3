"""Calls of Python from a compiled XLA program on the CPU, through XLA's foreign function interface (FFI).

`jax.pure_callback` hands over its arguments as JAX arrays. Reading one waits for a copy on the CPU client's own
threads, and with asynchronous dispatch on two cores these may all be waiting for the callback: a deadlock. It also
keeps programs out of JAX's compilation cache, since they hold an address of the process. An FFI call does neither.
It gets XLA's buffers as NumPy arrays, without a copy, and programs name its target.

The structures are those of `xla/ffi/api/c_api.h`, which is an interface with a version: another major version is
refused by XLA when the target is registered.
"""

import _thread
import atexit
import collections
import contextlib
import ctypes
import functools
import math
import threading
import time
import traceback
from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np

TARGET = "dexsim_host"
_MAJOR, _METADATA, _EXECUTE, _STRING = 0, 1, 3, 4
_INTERNAL = 13
# XLA's numbers of the types that cross.
_DTYPES = {1: np.bool_, 4: np.int32, 5: np.int64, 8: np.uint32, 9: np.uint64, 11: np.float32, 12: np.float64}

Handler = Callable[[list[np.ndarray], list[np.ndarray], dict[str, bytes]], None]
"""(arguments, results to be filled in, attributes), all valid during the call only."""


def _struct(name: str, *fields: tuple[str, Any]) -> Any:
    head = [("struct_size", ctypes.c_size_t), ("extension", ctypes.c_void_p)]
    return type(name, (ctypes.Structure,), {"_fields_": [*head, *fields]})


_POINTERS = ctypes.POINTER(ctypes.c_void_p)
_Version = _struct("_Version", ("major", ctypes.c_int), ("minor", ctypes.c_int))
_Api = _struct("_Api", ("version", _Version), ("internal", ctypes.c_void_p), ("create_error", ctypes.c_void_p))
_ErrorArguments = _struct("_ErrorArguments", ("message", ctypes.c_char_p), ("code", ctypes.c_int))
_Buffer = _struct(
    "_Buffer",
    ("dtype", ctypes.c_int),
    ("data", ctypes.c_void_p),
    ("rank", ctypes.c_int64),
    ("dims", ctypes.POINTER(ctypes.c_int64)),
)
_Buffers = _struct("_Buffers", ("size", ctypes.c_int64), ("types", ctypes.c_void_p), ("items", _POINTERS))
_Attributes = _struct(
    "_Attributes",
    ("size", ctypes.c_int64),
    ("types", ctypes.POINTER(ctypes.c_int)),
    ("names", _POINTERS),
    ("items", _POINTERS),
)
_Frame = _struct(
    "_Frame",
    ("api", ctypes.POINTER(_Api)),
    ("context", ctypes.c_void_p),
    ("stage", ctypes.c_int),
    ("arguments", _Buffers),
    ("results", _Buffers),
    ("attributes", _Attributes),
)


class _Span(ctypes.Structure):
    _fields_ = [("data", ctypes.c_void_p), ("size", ctypes.c_size_t)]

    def read(self) -> bytes:
        return ctypes.string_at(self.data, self.size)


class _Metadata(ctypes.Structure):
    _fields_ = [("struct_size", ctypes.c_size_t), ("version", _Version), ("traits", ctypes.c_uint32)]


class _MetadataRequest(ctypes.Structure):
    _fields_ = [
        ("struct_size", ctypes.c_size_t),
        ("type", ctypes.c_int),
        ("next", ctypes.c_void_p),
        ("metadata", ctypes.POINTER(_Metadata)),
    ]


def _array(address: int) -> np.ndarray:
    buffer = _Buffer.from_address(address)
    shape, dtype = buffer.dims[: buffer.rank], np.dtype(_DTYPES[buffer.dtype])
    memory = (ctypes.c_char * (math.prod(shape) * dtype.itemsize)).from_address(buffer.data or 0)
    return np.ndarray(shape, dtype, memory)


def _arrays(buffers: Any) -> list[np.ndarray]:
    return [_array(address) for address in buffers.items[: buffers.size]]


def _attributes(given: Any) -> dict[str, bytes]:
    found = {}
    for index in range(given.size):
        if given.types[index] == _STRING:
            name = _Span.from_address(given.names[index]).read().decode()
            found[name] = _Span.from_address(given.items[index]).read()
    return found


def _error(frame: Any, message: str) -> int:
    create = ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.c_void_p)(frame.api.contents.create_error)
    arguments = _ErrorArguments(ctypes.sizeof(_ErrorArguments), None, message.encode(), _INTERNAL)
    return create(ctypes.addressof(arguments))


def _answer(handler: Handler, address: int) -> int | None:
    """Serve one call of XLA's. An exception must not leave through C: it becomes XLA's error."""
    frame = _Frame.from_address(address)
    try:
        if frame.extension:
            request = _MetadataRequest.from_address(frame.extension)
            if request.type == _METADATA:
                version, runtime = request.metadata.contents.version, frame.api.contents.version
                version.major, version.minor = _MAJOR, runtime.minor if runtime.major == _MAJOR else 0
                return None
        if frame.stage == _EXECUTE:
            _calls.append(time.monotonic())
            if _ending.is_set():
                return _error(frame, "the interpreter is ending")
            handler(_arrays(frame.arguments), _arrays(frame.results), _attributes(frame.attributes))
    except KeyboardInterrupt:
        # With synchronous dispatch this is the main thread. The program ends here, and Ctrl-C is raised again when
        # the interpreter has control.
        _thread.interrupt_main()
        return _error(frame, "interrupted")
    except BaseException as error:
        return _error(frame, f"{error}\n{traceback.format_exc()}")
    return None


_kept: list[Any] = []  # what C holds addresses of
_ending = threading.Event()
_calls: collections.deque[float] = collections.deque(maxlen=1)  # s, when the last call came
_QUIET, _PATIENCE = 0.3, 5.0  # s, without a call before the interpreter may end, and the longest wait for that


def _end() -> None:
    """Before the interpreter ends: a program that is still running must not call into it any more.

    Its next call fails, which ends the program; its results are waited for, and programs without results by silence.
    """
    _ending.set()
    until = time.monotonic() + _PATIENCE
    for array in jax.live_arrays():
        with contextlib.suppress(Exception):
            array.block_until_ready()
    while _calls and time.monotonic() < min(until, _calls[0] + _QUIET):
        time.sleep(0.01)


@functools.cache
def register(handler: Handler) -> None:
    """Make `handler` what `call` calls; once in a process."""
    function = ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.c_void_p)(functools.partial(_answer, handler))
    _kept.append(function)
    atexit.register(_end)
    jax.ffi.register_ffi_target(TARGET, jax.ffi.pycapsule(function), platform="cpu")


def call(results: Sequence[jax.ShapeDtypeStruct], *arguments: jax.Array, **attributes: str) -> list[jax.Array]:
    """Call the handler from a traced program. Under `vmap` a batch is one call.

    Batch axes come first in every array. An argument that is the same for the whole batch has axes of length one there.
    """
    return list(jax.ffi.ffi_call(TARGET, list(results), vmap_method="expand_dims")(*arguments, **attributes))
