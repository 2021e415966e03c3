"""Which programs are compiled with less optimisation, and which on a GPU repeat to the bit."""

import jax
import pytest

from dexsim.core import compilation


@pytest.fixture
def options(monkeypatch):
    """`options(**given)`: the compiler options that `compilation.jit` chooses."""
    chosen = {}
    compilation._light()  # compiles, and is kept
    monkeypatch.setattr(compilation, "jit", compilation.jit.func)  # not as the suite has it
    monkeypatch.setattr(jax, "jit", lambda function, compiler_options=None: chosen.update(o=compiler_options))

    def choose(**given):
        compilation.jit(lambda x: x, **given)
        return chosen["o"] or {}

    return choose


def test_programs_on_a_gpu_are_made_deterministic_on_request(options, monkeypatch):
    assert not compilation.make_deterministic()  # on a CPU
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    monkeypatch.setattr(compilation, "_on_gpu", {})
    assert options(backend="mjx") == {}
    assert compilation.make_deterministic()
    for backend in ("mjx", "cuda", "own"):
        assert options(backend=backend) == {"xla_gpu_deterministic_ops": True}
    assert options(once=True) == {"xla_gpu_deterministic_ops": True}
