"""The kernel of a scene: its source, the motors' recorded law (`dexsim.physics.law`) among it, and NVRTC, its compiler.

NVRTC comes with JAX for CUDA (`nvidia-cuda-nvrtc`) and needs neither nvcc nor CUDA's headers.
"""

import contextlib
import ctypes
import dataclasses
import functools
import hashlib
import importlib.util
import math
import os
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from dexsim.core.assets import cache_path
from dexsim.core.files import write_atomic
from dexsim.core.install import install_line
from dexsim.errors import ConfigError
from dexsim.physics.cuda.scene import Buffer, buffers, declare_args, kernel_constants
from dexsim.physics.interface import PhysicsScene
from dexsim.physics.law import OPERATIONS, Recorded

WORLDS_PER_BLOCK = 8
"""Warps of a block, which pass through the kernel's code in step."""
ENTRY = "tick_kernel"
"""The kernel's name in `kernel/entry.cuh`."""
SHARED_BYTES = "shared_bytes"
"""The variable on the device that has the size of a world's shared memory."""
# Square roots, quotients and sines of fewer instructions: no force differs by more than other roundings make it.
OPTIONS = ("-std=c++17", "-use_fast_math", "-default-device")
_KERNEL = Path(__file__).parent / "kernel"
_CTYPES = {"float32": "float", "int32": "int", "bool": "bool"}


@dataclasses.dataclass(frozen=True)
class PrintedLaw:
    """A law as CUDA, and the buffers of its constants."""

    text: str
    buffers: tuple[Buffer, ...]


def print_law(law: Recorded, joints: int) -> PrintedLaw:
    """`DEV Motor motor_law(const Args &args, int world, int joint, int substep, float position, float velocity)`.

    `Motor` is torque, Nm, and inertia, kg m^2, at a joint angle, rad, and velocity, rad/s (`implicit`). The order of
    operations is the recorded one; the compiler may fuse a product and a sum, as XLA does.
    """
    names, buffers = dict[int, str](), []
    count = len(law.constants)
    for number, (vector, dtype) in enumerate(law.types[:count]):
        place = f"[world * {joints} + joint]" if vector else "[world]"
        names[number] = f"args.law_{number}{place}"
        buffers.append(Buffer(f"law_{number}", joints if vector else 1, ctype=_CTYPES[dtype]))
    names |= {count: "substep", count + 1: "position", count + 2: "velocity"}
    names |= {number: _literal(value, law.types[number][1]) for number, value in law.literals}
    lines = []
    for kind, operands, number in law.steps:
        names[number] = f"v{number}"
        _, expression = OPERATIONS.get(kind, (None, "{0}"))
        value = expression.format(*(names[operand] for operand in operands))
        lines.append(f"  const {_CTYPES[law.types[number][1]]} v{number} = {value};\n")
    return PrintedLaw(
        "DEV Motor motor_law(const Args &args, int world, int joint, int substep, float position, float velocity) {\n"
        f"{''.join(lines)}  return {{{names[law.torque]}, {names[law.inertia]}}};\n}}\n",
        tuple(buffers),
    )


def _literal(value: Any, dtype: str) -> str:
    if dtype != "float32":
        return f"({str(value).lower()})"
    if math.isfinite(value):
        return f"({np.float32(value):.8e}f)"
    return "(0.f / 0.f)" if math.isnan(value) else f"({'-' if value < 0 else ''}1.f / 0.f)"


def source(scene: PhysicsScene, law: PrintedLaw) -> str:
    """The kernel's source, which includes `headers`."""
    args, constants = declare_args(buffers(scene, law.buffers)), kernel_constants(scene)
    constants += f"constexpr int WORLDS_PER_BLOCK = {WORLDS_PER_BLOCK};"
    return "\n".join(['#include "warp.cuh"', args, constants, law.text, '#include "entry.cuh"', ""])


@functools.cache
def headers() -> Mapping[str, str]:
    """The files of `kernel/` by the names under which they include each other."""
    return {path.relative_to(_KERNEL).as_posix(): path.read_text() for path in sorted(_KERNEL.rglob("*.cuh"))}


def compile_kernel(text: str, architecture: str) -> bytes:
    """The machine code (cubin) of a `source` for an architecture such as sm_90, compiled or from the cache. Raises
    ConfigError: NVRTC is missing or fails."""
    options = (*OPTIONS, f"--gpu-architecture={architecture}")
    major, minor = ctypes.c_int(), ctypes.c_int()
    _nvrtc("Version", ctypes.byref(major), ctypes.byref(minor))
    version = major.value, minor.value
    digest = hashlib.sha256(repr((text, sorted(headers().items()), options, version)).encode())
    path = cache_path("cuda") / f"{digest.hexdigest()}.cubin"
    if path.exists():
        return path.read_bytes()
    code = compile_source(text, options)
    with contextlib.suppress(OSError):  # a disk without room or rights
        write_atomic(path, [code])
    return code


def compile_source(text: str, options: tuple[str, ...]) -> bytes:
    """A cubin of a source that includes `headers`; errors as in `compile_kernel`."""
    names, texts = _strings(headers().keys()), _strings(headers().values())
    program = ctypes.c_void_p()
    _nvrtc("CreateProgram", ctypes.byref(program), text.encode(), b"kernel.cu", len(names), texts, names)
    try:
        if find_compiler().nvrtcCompileProgram(program, len(options), _strings(options)):
            log = _read(program, "ProgramLog").decode(errors="replace").strip("\0\n")
            first = next((line for line in log.splitlines() if "error" in line), log)
            raise ConfigError(f"backend 'cuda': NVRTC: {first}")
        return _read(program, "CUBIN")
    finally:
        find_compiler().nvrtcDestroyProgram(ctypes.byref(program))


def _read(program: ctypes.c_void_p, what: str) -> bytes:
    size = ctypes.c_size_t()
    _nvrtc(f"Get{what}Size", program, ctypes.byref(size))
    content = ctypes.create_string_buffer(size.value)
    _nvrtc(f"Get{what}", program, content)
    return content.raw


def _nvrtc(name: str, *arguments: Any) -> None:
    """Call a function of NVRTC. Raises ConfigError: with its text for the error that it returns."""
    library = find_compiler()
    if code := getattr(library, f"nvrtc{name}")(*arguments):
        library.nvrtcGetErrorString.restype = ctypes.c_char_p
        raise ConfigError(f"backend 'cuda': NVRTC: {library.nvrtcGetErrorString(code).decode()}")


@functools.cache
def find_compiler() -> ctypes.CDLL:
    """NVRTC of the Python environment, of the CUDA toolkit or of the system, in this order. Raises ConfigError: there
    is none."""
    for path in _candidates():
        with contextlib.suppress(OSError):
            library = ctypes.CDLL(str(path))
            # NVRTC opens its builtins by their name alone, which finds them only once they are loaded.
            for builtins in Path(path).parent.glob("libnvrtc-builtins.so*") if isinstance(path, Path) else ():
                ctypes.CDLL(str(builtins))
            return library
    raise ConfigError(f"backend 'cuda' needs NVRTC, which comes with JAX for CUDA: {install_line('cuda')}")


def _candidates() -> Iterator[Path | str]:
    package = importlib.util.find_spec("nvidia")
    roots = [Path(place) for place in (package and package.submodule_search_locations) or ()]
    toolkit = Path(os.environ.get("CUDA_HOME", "/usr/local/cuda"))
    folders = [*(folder for root in roots for folder in sorted(root.glob("*/lib"), reverse=True)), toolkit / "lib64"]
    for folder in folders:
        # Beside it lie libnvrtc-builtins, and in some versions a variant for cross compilation.
        yield from sorted((path for path in folder.glob("libnvrtc.so*") if "alt" not in path.name), reverse=True)
    yield from ("libnvrtc.so.13", "libnvrtc.so.12")


def _strings(values: Iterable[str]) -> ctypes.Array[ctypes.c_char_p]:
    encoded = [value.encode() for value in values]
    return (ctypes.c_char_p * len(encoded))(*encoded)
