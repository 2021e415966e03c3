"""A control tick of physics as one CUDA kernel, a warp a world: the fastest engine on NVIDIA GPUs, without gradients.

The kernel is generated for the scene and for the motor law, which it evaluates at every sub-step, and compiled when a
program is traced. Its solver runs until it has converged, and its results repeat to the bit. XLA programs launch it by
the CUDA driver, through ctypes, behind a call that they know by name.
"""

import ctypes
import dataclasses
import functools
import hashlib
import math
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp

from dexsim.core.errors import ConfigError
from dexsim.physics import ffi
from dexsim.physics.cuda.program import (
    ENTRY,
    SHARED_BYTES,
    WORLDS_PER_BLOCK,
    PrintedLaw,
    compile_kernel,
    find_compiler,
    print_law,
    source,
)
from dexsim.physics.cuda.scene import Settings, args_type, buffers, kernel_constants
from dexsim.physics.interface import Fields, ImplicitLaw, PhysicsScene, PhysicsState, StepResult
from dexsim.physics.law import record

# Newton's method stops at this decrement at least, and its line search at this share of it: forces are then as near to
# C MuJoCo's as float32 allows.
_TOLERANCE, _LINE_SEARCH_TOLERANCE = 1e-5, 0.01
TARGET = "dexsim_cuda"
TRAITS = 1
"""`XLA_FFI_HANDLER_TRAITS_COMMAND_BUFFER_COMPATIBLE`: XLA records launches in CUDA graphs, and replays those."""
# Of the driver's enumerations.
_DYNAMIC_SHARED, _CARVEOUT, _MOST_SHARED = 8, 9, 97
_MAJOR, _MINOR = 75, 76
_DATA = ffi.Buffer.data.offset


class CudaBackend:
    """`dexsim.physics.interface.Backend` in CUDA."""

    def __init__(self, scene: PhysicsScene):
        """The kernel is compiled when a program is traced.

        Raises:
          AssetError: the scene has what the kernel lacks.
          ConfigError: the driver or the compiler is missing.
        """
        self.scene = scene
        kernel_constants(scene), find_compiler(), architecture()
        self._loaded: dict[PrintedLaw, str] = {}

    def advance(self, fields: Fields, state: PhysicsState, law: ImplicitLaw, push: jax.Array) -> StepResult:
        """One control tick in one launch."""
        joints = len(self.scene.joint_dof)
        recorded = record(law, jnp.zeros(joints))
        name, moving = self._load(print_law(recorded, joints)), (state.qpos, state.qvel, state.warmstart)
        arguments = [*moving, *self._inputs(fields, push), *map(jnp.asarray, recorded.constants)]
        shapes = [array.shape for array in moving] + [(self.scene.hand.num_fingers, 3), (4,)]
        results = [jax.ShapeDtypeStruct(shape, jnp.float32) for shape in shapes]
        qpos, qvel, warmstart, force, _ = call(name, results, *arguments)
        return StepResult(PhysicsState(qpos, qvel, warmstart), force)

    def _inputs(self, fields: Fields, push: jax.Array) -> list[jax.Array]:
        """What of a tick stays the same, in the order of the kernel's buffers."""
        inputs = fields | {"push": push, "pair_friction": fields["pair_friction"][:, 0]}
        names = [buffer.name for buffer in buffers(self.scene, ()) if not buffer.output][3:]
        return [jnp.asarray(inputs[name], jnp.float32) for name in names]

    def _load(self, law: PrintedLaw) -> str:
        """The name of the kernel with this law, compiled and loaded."""
        if law not in self._loaded:
            model, code = self.scene.model, compile_kernel(source(self.scene, law), architecture())
            # MuJoCo's tolerance is of the cost over (mean inertia) (degrees of freedom), of which Newton's decrement
            # p^T H p is twice what the next step would improve.
            tolerance = max(_TOLERANCE, 2 * float(model.opt.tolerance * model.stat.meaninertia * model.nv))
            settings = Settings(
                substeps=self.scene.config.substeps,
                iterations=int(model.opt.iterations),
                line_search=int(model.opt.ls_iterations),
                tolerance=tolerance,
                line_search_tolerance=_LINE_SEARCH_TOLERANCE,
            )
            self._loaded[law] = load(code, settings, len(buffers(self.scene, law.buffers)))
        return self._loaded[law]


# --- launches ---------------------------------------------------------------------------------------


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
