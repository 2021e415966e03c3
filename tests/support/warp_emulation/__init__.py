"""The `cuda` engine's kernel on a CPU: a warp of 32 coroutines, compiled by g++ and called by ctypes."""

import ctypes
import hashlib
import shutil
import subprocess
import tempfile
from pathlib import Path

import numpy as np

from dexsim.physics.cuda import scene as cuda_scene
from dexsim.physics.cuda.scene import Buffer, declare_args
from dexsim.physics.interface import PhysicsScene

_HERE = Path(__file__).parent
_KERNEL = Path(cuda_scene.__file__).parent / "kernel"
_CACHE = Path(tempfile.gettempdir()) / "dexsim_warp_emulation"
compiler = shutil.which("g++")

# `physics_states.pd_torque`, its targets as the law's only constant.
PD_LAW = """
DEV Motor motor_law(const Args &args, int world, int joint, int, float position, float velocity) {
  const float limit = 3.0f * fmaxf(1 - fabsf(velocity) / 20.0f, 0.0f);
  const float torque = 3.0f * (args.law_0[world * JOINTS + joint] - position) - 0.02f * velocity;
  return {fminf(fmaxf(torque, -limit), limit), 0.0f};
}
"""


class Emulation:
    """The kernel of one scene."""

    def __init__(self, scene: PhysicsScene, law: str | None = None, constants: list[Buffer] | None = None):
        """`law` is the text of `motor_law`, `constants` what it reads; default a PD law to targets `law_0` [J]."""
        joints = len(scene.joint_dof)
        if law is None:
            law, constants = PD_LAW.replace("JOINTS", str(joints)), [Buffer("law_0", joints)]
        self.buffers = cuda_scene.buffers(scene, constants or [])
        text = "\n".join([declare_args(self.buffers), cuda_scene.kernel_constants(scene), law])
        library = ctypes.CDLL(str(build(text)))
        self._run = library.run
        self._arguments = cuda_scene.args_type(len(self.buffers))

    def run(self, inputs, *, substeps, iterations=10, line_search=20, tolerance=1e-5, line_search_tolerance=0.01):
        """Outputs [N, ...] by name for inputs [N, ...]."""
        n = len(inputs["qpos"])
        arrays = {}
        for buffer in self.buffers:
            dtype = np.int32 if buffer.ctype == "int" else np.float32
            if buffer.output:
                arrays[buffer.name] = np.full((n, buffer.size), np.nan, dtype)
            else:
                value = np.asarray(inputs[buffer.name], dtype).reshape(n, -1)
                assert value.shape[1] == buffer.size, f"{buffer.name}: expected {buffer.size}, got {value.shape[1]}"
                arrays[buffer.name] = np.ascontiguousarray(value)
        pointers = (ctypes.c_void_p * len(arrays))(*(array.ctypes.data for array in arrays.values()))
        arguments = self._arguments(pointers, n, substeps, iterations, line_search, tolerance, line_search_tolerance)
        self._run(ctypes.byref(arguments))
        return {buffer.name: arrays[buffer.name] for buffer in self.buffers if buffer.output}


def build(text: str, main: str = "main.cpp") -> Path:
    """Compile `main` of this folder with a scene's text, or take what was compiled from the same sources."""
    sources = [*sorted(_KERNEL.rglob("*.cuh")), _HERE / "warp_emulation.h", _HERE / main]
    digest = hashlib.sha256(text.encode() + b"".join(path.read_bytes() for path in sources)).hexdigest()[:16]
    library = _CACHE / f"{digest}.so"
    if not library.exists():
        _CACHE.mkdir(exist_ok=True)
        with tempfile.TemporaryDirectory() as folder:
            (Path(folder) / "scene_text.h").write_text(text)
            made = Path(folder) / "kernel.so"
            command = [compiler, "-std=c++17", "-O2", "-w", "-shared", "-fPIC", "-U_FORTIFY_SOURCE", "-Wl,-z,defs"]
            command += [f"-I{folder}", f"-I{_HERE}", f"-I{_KERNEL}", str(_HERE / main), "-o", str(made)]
            subprocess.run(command, check=True)
            shutil.move(made, library)
    return library
