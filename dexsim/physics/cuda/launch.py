"""Launching compiled kernels from XLA programs: the CUDA driver by ctypes, behind a call that XLA knows by name."""

import ctypes
import dataclasses
import functools
import hashlib
import math
from collections.abc import Sequence
from typing import Any

import jax

from dexsim.errors import ConfigError
from dexsim.physics import ffi
from dexsim.physics.cuda.program import ENTRY, SHARED_BYTES, WORLDS_PER_BLOCK
from dexsim.physics.cuda.scene import Settings, args_type

TARGET = "dexsim_cuda"
TRAITS = 1
"""`XLA_FFI_HANDLER_TRAITS_COMMAND_BUFFER_COMPATIBLE`: XLA records launches in CUDA graphs, and replays those."""
# Of the driver's enumerations.
_DYNAMIC_SHARED, _CARVEOUT, _MOST_SHARED = 8, 9, 97
_MAJOR, _MINOR = 75, 76
_DATA = ffi.Buffer.data.offset


@functools.cache
def _library() -> ctypes.CDLL:
    try:
        library = ctypes.CDLL("libcuda.so.1")
    except OSError:
        raise ConfigError("backend 'cuda' needs NVIDIA's driver, with libcuda.so.1") from None
    library.cuInit(0)  # what fails here fails in every call
    return library


def driver(name: str, *arguments: Any) -> None:
    """Call a function of the CUDA driver.

    Raises:
      ConfigError: there is no driver.
      RuntimeError: with its text for the error that it returns.
    """
    if code := getattr(_library(), name)(*arguments):
        text = ctypes.c_char_p()
        _library().cuGetErrorString(code, ctypes.byref(text))
        raise RuntimeError(f"backend 'cuda': {name}: {(text.value or b'error').decode()} ({code})")


def _attribute(which: int, device: int) -> int:
    value = ctypes.c_int()
    driver("cuDeviceGetAttribute", ctypes.byref(value), which, device)
    return value.value


@functools.cache
def architecture() -> str:
    """Of this process's GPUs, such as sm_90. Raises ConfigError: they differ."""
    kinds = {f"sm_{_attribute(_MAJOR, device)}{_attribute(_MINOR, device)}" for device in _local_devices()}
    if len(kinds) != 1:
        raise ConfigError(
            f"backend 'cuda': expected GPUs of one kind, got {', '.join(sorted(kinds))}: set CUDA_VISIBLE_DEVICES"
        )
    return kinds.pop()


def _local_devices() -> list[int]:
    """Ordinals of the GPUs that JAX uses in this process."""
    return [device.local_hardware_id for device in jax.local_devices()]


class Kernel:
    """A compiled kernel, loaded on every GPU of this process."""

    def __init__(self, code: bytes, settings: Settings, buffers: int):
        """Load the machine code (cubin) of a kernel with so many buffers.

        Raises:
          ConfigError: a block needs more shared memory than the GPU has.
          RuntimeError: the driver refuses it.
        """
        self.settings, self._code, self._args = settings, code, args_type(buffers)
        self.library, self.function = ctypes.c_void_p(), ctypes.c_void_p()
        driver("cuLibraryLoadData", ctypes.byref(self.library), code, None, None, 0, None, None, 0)
        driver("cuLibraryGetKernel", ctypes.byref(self.function), self.library, ENTRY.encode())
        for device in _local_devices():
            self.shared = WORLDS_PER_BLOCK * self._load(device)
            if self.shared > (most := _attribute(_MOST_SHARED, device)):
                raise ConfigError(
                    f"backend 'cuda': {WORLDS_PER_BLOCK} worlds need {self.shared} bytes of shared memory, "
                    f"of which GPU {device} gives a block {most}"
                )
            for which, value in ((_DYNAMIC_SHARED, self.shared), (_CARVEOUT, 100)):
                driver("cuKernelSetAttribute", which, value, self.function, device)

    def _load(self, device: int) -> int:
        """Load the code on a GPU now, since it must not be during a capture. Returns a world's shared memory, bytes."""
        context, old, function = ctypes.c_void_p(), ctypes.c_void_p(), ctypes.c_void_p()
        address, size, shared = ctypes.c_uint64(), ctypes.c_size_t(), ctypes.c_uint()
        driver("cuDevicePrimaryCtxRetain", ctypes.byref(context), device)  # XLA's, which keeps it
        driver("cuCtxPushCurrent_v2", context)
        try:
            driver("cuKernelGetFunction", ctypes.byref(function), self.function)
            name = SHARED_BYTES.encode()
            driver("cuLibraryGetGlobal", ctypes.byref(address), ctypes.byref(size), self.library, name)
            driver("cuMemcpyDtoH_v2", ctypes.byref(shared), address, ctypes.c_size_t(ctypes.sizeof(shared)))
        finally:
            driver("cuCtxPopCurrent_v2", ctypes.byref(old))
        return shared.value

    def launch(self, stream: int, worlds: int, pointers: Sequence[int]) -> None:
        """Enqueue a tick of so many worlds on a stream; the stream's GPU runs it."""
        if not worlds:
            return
        args = self._args((ctypes.c_void_p * len(pointers))(*pointers), worlds, *dataclasses.astuple(self.settings))
        parameters = (ctypes.c_void_p * 1)(ctypes.addressof(args))
        blocks, threads = -(-worlds // WORLDS_PER_BLOCK), WORLDS_PER_BLOCK * 32
        grid, launch = (blocks, 1, 1, threads, 1, 1, self.shared, ctypes.c_void_p(stream)), (parameters, None)
        driver("cuLaunchKernel", self.function, *grid, *launch)


# By the names that programs have for them. They stay: a program may run when its environment is gone.
_kernels: dict[str, Kernel] = {}


def load(code: bytes, settings: Settings, buffers: int) -> str:
    """Load a kernel (`Kernel`) and return its name for `call`: the same in every process."""
    name = hashlib.sha256(repr((code, settings)).encode()).hexdigest()[:16]
    if name not in _kernels:
        _kernels[name] = Kernel(code, settings, buffers)
    return name


def call(name: str, results: Sequence[jax.ShapeDtypeStruct], *arguments: jax.Array) -> list[jax.Array]:
    """A launch from a traced program, with the arrays of one world. Under `vmap` a batch is one launch."""
    ffi.register(TARGET, "CUDA", _serve, TRAITS)
    return list(jax.ffi.ffi_call(TARGET, list(results), vmap_method="broadcast_all")(*arguments, kernel=name))


def _serve(frame: Any) -> None:
    kernel = _kernels.get(ffi.attributes(frame)["kernel"].decode())
    if kernel is None:
        raise RuntimeError("backend 'cuda': make the environment in the process that runs this program")
    arrays = [*ffi.addresses(frame.arguments), *ffi.addresses(frame.results)]
    first = ffi.Buffer.from_address(arrays[0])
    worlds = math.prod(first.dims[: first.rank - 1])
    kernel.launch(ffi.stream(frame), worlds, [ctypes.c_void_p.from_address(a + _DATA).value or 0 for a in arrays])
