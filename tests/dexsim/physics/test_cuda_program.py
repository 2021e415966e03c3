"""The CUDA kernel of each task compiles with NVRTC; no GPU is needed."""

import pytest
from cuda_kernel import cuda_scene, motor_law

import dexsim
from dexsim.core.errors import ConfigError
from dexsim.physics.cuda import program


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
    """By text, GPU, headers and compiler, in a folder that no one else may write to."""
    monkeypatch.setenv("DEXSIM_CACHE", str(tmp_path))
    one, other = CountingCompiler(), CountingCompiler((13, 1))
    monkeypatch.setattr(program, "find_compiler", lambda: one)
    for text, architecture in (("a", "sm_90"), ("a", "sm_90"), ("b", "sm_90"), ("a", "sm_80")):
        assert program.compile_kernel(text, architecture).startswith(f"(13, 0) {text}".encode())
    assert one.calls == 3
    (tmp_path / "cuda").chmod(0o777)
    program.compile_kernel("a", "sm_90")
    assert one.calls == 4
    (tmp_path / "cuda").chmod(0o700)
    monkeypatch.setattr(program, "headers", lambda: {"tick.cuh": "changed"})
    program.compile_kernel("a", "sm_90")
    assert one.calls == 5
    monkeypatch.setattr(program, "find_compiler", lambda: other)
    program.compile_kernel("a", "sm_90")
    assert other.calls == 1


def test_an_error_names_file_and_line(compiler):
    with pytest.raises(ConfigError, match=r"NVRTC \d+\.\d+: broken\.cuh\(2\): error: .*nothing") as caught:
        compiler.compile('#include "broken.cuh"', {"broken.cuh": "\nint x = nothing;"}, program.OPTIONS)
    assert "\n" not in str(caught.value)


def test_a_machine_without_nvrtc(monkeypatch):
    monkeypatch.setattr(program, "_candidates", lambda: iter(["libnvrtc-of-nobody.so"]))
    with pytest.raises(ConfigError, match=r"needs NVRTC.*pip install .*\[cuda\]"):
        program.find_compiler.__wrapped__()
