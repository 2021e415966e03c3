"""The arguments of the kernel as C++ has them, and each task's kernel through NVRTC: no GPU is needed."""

import ctypes
import shutil
import subprocess

import pytest
from cuda_kernel import cuda_scene, motor_law

import dexsim
from dexsim.core.errors import ConfigError
from dexsim.physics.cuda import program
from dexsim.physics.cuda.scene import Buffer, args_type, declare_args

BUFFERS = [
    Buffer("qpos", 4),
    Buffer("law_0", 2, ctype="int"),
    Buffer("law_1", 1, ctype="bool"),
    Buffer("qpos_out", 4, output=True),
]


@pytest.mark.skipif(shutil.which("g++") is None, reason="needs g++")
def test_the_struct_is_that_of_cpp(tmp_path):
    names = [buffer.name for buffer in BUFFERS] + [name for name, *_ in args_type(1)._fields_[1:]]
    offsets = ", ".join(f"offsetof(Args, {name})" for name in names)
    source = tmp_path / "args.cpp"
    source.write_text(
        f"#include <cstddef>\n#include <cstdio>\n{declare_args(BUFFERS)}\n"
        f'int main() {{ const size_t all[] = {{sizeof(Args), {offsets}}}; for (size_t x : all) printf("%zu ", x); }}'
    )
    subprocess.run(["g++", source, "-o", tmp_path / "args"], check=True)
    size, *there = map(int, subprocess.check_output(tmp_path / "args").split())
    args = args_type(len(BUFFERS))
    pointers = [8 * index for index in range(len(BUFFERS))]
    assert there == pointers + [getattr(args, name).offset for name, *_ in args._fields_[1:]]
    assert size == ctypes.sizeof(args)


# --- kernels compile with NVRTC ---


@pytest.fixture(scope="module")
def compiler():
    try:
        return program.find_compiler()
    except ConfigError as error:
        pytest.skip(str(error))


@pytest.mark.parametrize("task", ["rotate", "grasp"])
def test_tasks_compile(task, compiler):
    env = dexsim.make(task, backend="c")
    text = program.source(cuda_scene(env), motor_law(env))
    assert text == program.source(cuda_scene(env), motor_law(env)), "kernels are cached by their text"
    code = compiler.compile(text, program.headers(), (*program.OPTIONS, "--gpu-architecture=sm_90"))
    assert code[:4] == b"\x7fELF"
    for name in (program.ENTRY, program.SHARED_BYTES):
        assert name.encode() in code
