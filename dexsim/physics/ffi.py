"""Calls of Python from a compiled XLA program, through XLA's foreign function interface (FFI), by ctypes.

The structures are those of `xla/ffi/api/c_api.h`, a versioned interface: XLA refuses to register another major version.
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
from collections.abc import Callable
from typing import Any

import jax
import numpy as np

_MAJOR, _METADATA, _EXECUTE, _STRING = 0, 1, 3, 4
_INTERNAL = 13
# XLA's numbers of the types that cross as NumPy arrays.
_DTYPES = {1: np.bool_, 4: np.int32, 5: np.int64, 8: np.uint32, 9: np.uint64, 11: np.float32, 12: np.float64}
# What most structures begin with; the metadata's have the size alone.
_HEAD = ("struct_size", ctypes.c_size_t), ("extension", ctypes.c_void_p)


def _struct(name: str, *fields: tuple[str, Any], head: int = len(_HEAD)) -> Any:
    return type(name, (ctypes.Structure,), {"_fields_": [*_HEAD[:head], *fields]})


_POINTERS = ctypes.POINTER(ctypes.c_void_p)
_Version = _struct("_Version", ("major", ctypes.c_int), ("minor", ctypes.c_int))
_Api = _struct(
    "_Api",
    ("version", _Version),
    ("internal", ctypes.c_void_p),
    ("create_error", ctypes.c_void_p),
    ("get_message", ctypes.c_void_p),
    ("destroy_error", ctypes.c_void_p),
    ("register", ctypes.c_void_p),
    ("get_stream", ctypes.c_void_p),
)
_ErrorArguments = _struct("_ErrorArguments", ("message", ctypes.c_char_p), ("code", ctypes.c_int))
_StreamArguments = _struct("_StreamArguments", ("context", ctypes.c_void_p), ("stream", ctypes.c_void_p))
Buffer = _struct(
    "Buffer",
    ("dtype", ctypes.c_int),
    ("data", ctypes.c_void_p),
    ("rank", ctypes.c_int64),
    ("dims", ctypes.POINTER(ctypes.c_int64)),
)
Buffers = _struct("Buffers", ("size", ctypes.c_int64), ("types", ctypes.c_void_p), ("items", _POINTERS))
_Attributes = _struct(
    "_Attributes",
    ("size", ctypes.c_int64),
    ("types", ctypes.POINTER(ctypes.c_int)),
    ("names", _POINTERS),
    ("items", _POINTERS),
)
_Span = _struct("_Span", ("data", ctypes.c_void_p), ("size", ctypes.c_size_t), head=0)
_Metadata = _struct("_Metadata", ("version", _Version), ("traits", ctypes.c_uint32), head=1)
_MetadataRequest = _struct(
    "_MetadataRequest",
    ("type", ctypes.c_int),
    ("next", ctypes.c_void_p),
    ("metadata", ctypes.POINTER(_Metadata)),
    head=1,
)
Frame = _struct(
    "Frame",
    ("api", ctypes.POINTER(_Api)),
    ("context", ctypes.c_void_p),
    ("stage", ctypes.c_int),
    ("arguments", Buffers),
    ("results", Buffers),
    ("attributes", _Attributes),
)


def addresses(buffers: Any) -> list[int]:
    """Of the `Buffer` structures."""
    return buffers.items[: buffers.size]


def arrays(buffers: Any) -> list[np.ndarray]:
    """The buffers of a CPU as NumPy arrays, valid during the call only."""
    views = []
    for buffer in map(Buffer.from_address, addresses(buffers)):
        shape, dtype = buffer.dims[: buffer.rank], np.dtype(_DTYPES[buffer.dtype])
        memory = (ctypes.c_char * (math.prod(shape) * dtype.itemsize)).from_address(buffer.data or 0)
        views.append(np.ndarray(shape, dtype, memory))
    return views


def attributes(frame: Any) -> dict[str, bytes]:
    """The call's attributes that are strings."""
    fields, strings = frame.attributes, {}
    for index in range(fields.size):
        if fields.types[index] == _STRING:
            name, value = (_Span.from_address(place[index]) for place in (fields.names, fields.items))
            strings[ctypes.string_at(name.data, name.size).decode()] = ctypes.string_at(value.data, value.size)
    return strings


def stream(frame: Any) -> int:
    """The CUDA stream that the call belongs to."""
    arguments = _StreamArguments(ctypes.sizeof(_StreamArguments), None, frame.context, None)
    get = ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.c_void_p)(frame.api.contents.get_stream)
    if get(ctypes.addressof(arguments)):
        raise RuntimeError("XLA did not say on which stream")
    return arguments.stream or 0


def _error(frame: Any, message: str) -> int:
    create = ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.c_void_p)(frame.api.contents.create_error)
    arguments = _ErrorArguments(ctypes.sizeof(_ErrorArguments), None, message.encode(), _INTERNAL)
    return create(ctypes.addressof(arguments))


def _answer(handler: Callable[[Any], None], traits: int, address: int) -> int | None:
    """Serve one call of XLA's. An exception must not leave through C: it becomes XLA's error."""
    frame = Frame.from_address(address)
    try:
        if frame.extension:
            request = _MetadataRequest.from_address(frame.extension)
            if request.type == _METADATA:
                metadata, runtime = request.metadata.contents, frame.api.contents.version
                version, metadata.traits = metadata.version, traits
                version.major, version.minor = _MAJOR, runtime.minor if runtime.major == _MAJOR else 0
                return None
        if frame.stage == _EXECUTE:
            _calls.append(time.monotonic())
            if _ending.is_set():
                return _error(frame, "the interpreter is ending")
            handler(frame)
    except KeyboardInterrupt:
        # With synchronous dispatch this is the main thread. The program ends here, and Ctrl-C is raised again when
        # the interpreter has control.
        _thread.interrupt_main()
        return _error(frame, "interrupted")
    except BaseException as error:
        return _error(frame, f"{error}\n{traceback.format_exc()}")
    return None


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
def register(target: str, platform: str, handler: Callable[[Any], None], traits: int = 0) -> Any:
    """Make `handler`, which gets a `Frame`, what calls of `target` on a platform run; once in a process.

    `traits` is `XLA_FFI_Handler_TraitsBits`. The result, which C has the address of, stays in the cache.
    """
    function = ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.c_void_p)(functools.partial(_answer, handler, traits))
    atexit.register(_end)
    jax.ffi.register_ffi_target(target, jax.ffi.pycapsule(function), platform=platform)
    return function
