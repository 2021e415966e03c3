"""What reaches the CUDA driver, with a driver of our own, and each task's kernel through NVRTC: no GPU is needed."""

import ctypes
import shutil
import subprocess

import numpy as np
import pytest
from cuda_kernel import cuda_scene, motor_law

import dexsim
from dexsim.core.errors import ConfigError
from dexsim.physics.cuda import launch, program
from dexsim.physics.cuda.scene import Buffer, Settings, args_type, declare_args

SETTINGS = Settings(substeps=5, iterations=10, line_search=12, tolerance=1e-5, line_search_tolerance=0.25)
BUFFERS = [
    Buffer("qpos", 4),
    Buffer("law_0", 2, ctype="int"),
    Buffer("law_1", 1, ctype="bool"),
    Buffer("qpos_out", 4, output=True),
]
SHARED = 5000


class FakeDriver:
    """Two GPUs that take whatever they are given."""

    def __init__(self):
        self.launches, self.attributes, self.fails = [], {}, ""

    def call(self, name, *arguments):
        if name == self.fails:
            raise RuntimeError(f"backend 'cuda': {name}: out of luck (1)")
        if name == "cuMemcpyDtoH_v2":
            arguments[0]._obj.value = SHARED
        if name == "cuKernelSetAttribute":
            which, value, _, device = arguments
            self.attributes[device, which] = value
        if name == "cuLaunchKernel":
            _, *place, shared, stream, parameters, _ = arguments
            args = args_type(len(BUFFERS)).from_address(parameters[0])
            numbers = [getattr(args, name) for name, *_ in args._fields_[1:]]
            self.launches.append((place, shared, stream.value, list(args.pointers), numbers))

    def attribute(self, which, device):
        return {75: 9, 76: 0, 97: 227 * 1024}[which]


@pytest.fixture
def driver(monkeypatch):
    fake = FakeDriver()
    monkeypatch.setattr(launch, "driver", lambda: fake)
    monkeypatch.setattr(launch, "_local_devices", lambda: [0, 1])
    monkeypatch.setattr(launch, "_kernels", {})
    return fake


def test_a_launch(driver):
    kernel = launch.Kernel(b"code", SETTINGS, len(BUFFERS))
    assert {driver.attributes[device, 8] for device in (0, 1)} == {8 * SHARED}
    kernel.launch(77, 10, [1, 2, 3, 4])
    kernel.launch(77, 0, [1, 2, 3, 4])  # an empty batch is no launch
    ((place, shared, stream, pointers, numbers),) = driver.launches
    assert place == [2, 1, 1, 256, 1, 1] and shared == 8 * SHARED and stream == 77
    assert pointers == [1, 2, 3, 4] and numbers == [10, 5, 10, 12, np.float32(1e-5), 0.25]


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


class CountingCompiler(program.Compiler):
    """A compiler that only counts."""

    def __init__(self, version=(13, 0)):
        self.version, self.calls = version, 0

    def compile(self, text, included, options):
        self.calls += 1
        return f"{self.version} {text} {options}".encode()


def test_compiled_code_is_kept(tmp_path, monkeypatch):
    """By text, GPU, headers and compiler."""
    monkeypatch.setenv("DEXSIM_CACHE", str(tmp_path))
    one, other = CountingCompiler(), CountingCompiler((13, 1))
    monkeypatch.setattr(program, "find_compiler", lambda: one)
    for text, architecture in (("a", "sm_90"), ("a", "sm_90"), ("b", "sm_90"), ("a", "sm_80")):
        assert program.compile_kernel(text, architecture).startswith(f"(13, 0) {text}".encode())
    assert one.calls == 3
    monkeypatch.setattr(program, "headers", lambda: {"tick.cuh": "changed"})
    program.compile_kernel("a", "sm_90")
    assert one.calls == 4
    monkeypatch.setattr(program, "find_compiler", lambda: other)
    program.compile_kernel("a", "sm_90")
    assert other.calls == 1
