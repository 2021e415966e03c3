"""The CUDA kernel of each task compiles with NVRTC, for every GPU that it is meant for; no GPU is needed."""

import pytest
from cuda_kernel import cuda_scene, motor_law

import dexsim
from dexsim.core.errors import ConfigError
from dexsim.physics.cuda import program

TASKS = ["rotate", "grasp"]


@pytest.fixture(scope="module")
def compiler():
    try:
        return program.find_compiler()
    except ConfigError as error:
        pytest.skip(str(error))


@pytest.fixture(scope="module")
def sources():
    """The source of a task's kernel, made once."""
    found = {}

    def source(task):
        if task not in found:
            env = dexsim.make(task, backend="c")
            found[task] = program.source(cuda_scene(env), motor_law(env))
        return found[task]

    return source


@pytest.mark.parametrize("task", TASKS)
def test_tasks_compile(task, compiler, sources):
    code = compiler.compile(sources(task), program.headers(), (*program.OPTIONS, "--gpu-architecture=sm_90"))
    assert code[:4] == b"\x7fELF"
    for name in (program.ENTRY, program.SHARED_BYTES):
        assert name.encode() in code


@pytest.mark.slow
@pytest.mark.parametrize("architecture", ["sm_80", "sm_86", "sm_89", "sm_120"])
def test_other_gpus(architecture, compiler, sources):
    options = (*program.OPTIONS, f"--gpu-architecture={architecture}")
    assert compiler.compile(sources("rotate"), program.headers(), options)[:4] == b"\x7fELF"


def test_a_source_is_the_same_again():
    """Kernels are cached by their text: nothing in it may depend on the process."""
    env = dexsim.make("rotate", backend="c")
    assert program.source(cuda_scene(env), motor_law(env)) == program.source(cuda_scene(env), motor_law(env))


class CountingCompiler(program.Compiler):
    """A compiler that only counts."""

    def __init__(self, version=(13, 0)):
        self.version, self.calls = version, 0

    def compile(self, text, included, options):
        self.calls += 1
        return f"{self.version} {text} {options}".encode()


def test_compiled_code_is_kept(tmp_path, monkeypatch):
    monkeypatch.setenv("DEXSIM_CACHE", str(tmp_path))
    one, other = CountingCompiler(), CountingCompiler((13, 1))
    monkeypatch.setattr(program, "find_compiler", lambda: one)
    first = program.compile_kernel("a", "sm_90")
    assert program.compile_kernel("a", "sm_90") == first and one.calls == 1
    assert {first, *(program.compile_kernel(*given) for given in (("b", "sm_90"), ("a", "sm_80")))} != {first}
    assert one.calls == 3
    monkeypatch.setattr(program, "headers", lambda: {"tick.cuh": "changed"})
    program.compile_kernel("a", "sm_90")
    assert one.calls == 4
    monkeypatch.setattr(program, "find_compiler", lambda: other)
    program.compile_kernel("a", "sm_90")
    assert other.calls == 1


def test_code_that_others_may_have_written_is_not_loaded(tmp_path, monkeypatch):
    monkeypatch.setenv("DEXSIM_CACHE", str(tmp_path))
    compiler = CountingCompiler()
    monkeypatch.setattr(program, "find_compiler", lambda: compiler)
    program.compile_kernel("a", "sm_90")
    (tmp_path / "cuda").chmod(0o777)
    program.compile_kernel("a", "sm_90")
    assert compiler.calls == 2


def test_an_error_names_file_and_line(compiler):
    with pytest.raises(ConfigError, match=r"NVRTC \d+\.\d+: broken\.cuh\(2\): error: .*nothing") as caught:
        compiler.compile('#include "broken.cuh"', {"broken.cuh": "\nint x = nothing;"}, program.OPTIONS)
    assert "\n" not in str(caught.value)


def test_a_machine_without_nvrtc(monkeypatch):
    monkeypatch.setattr(program, "_candidates", lambda: iter(["libnvrtc-of-nobody.so"]))
    with pytest.raises(ConfigError, match=r"needs NVRTC.*pip install .*\[cuda\]"):
        program.find_compiler.__wrapped__()
