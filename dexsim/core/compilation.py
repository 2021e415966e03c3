"""How this library compiles its large programs."""

import contextlib
import functools
import gc
from collections.abc import Callable, Iterator
from typing import Any

import jax

# LLVM optimises less, and XLA's older emitters make less code of a fusion: programs compile faster and run as fast.
LIGHT = (("xla_backend_optimization_level", 1), ("xla_cpu_use_fusion_emitters", False))


def jit(function: Callable, *, once: bool = False, **options: Any) -> Any:
    """`jax.jit`, but on a CPU the compiler does less.

    A physics step is one very large program. On two cores its compilation takes half as long this
    way, for a few per cent of speed; a short training run is mostly compilation otherwise.

    Args:
      once: the program runs a single time, so that optimising it never pays.
    """
    if jax.default_backend() == "cpu":
        options["compiler_options"] = _light() | ({"xla_backend_optimization_level": 0} if once else {})
    return jax.jit(function, **options)


@functools.cache
def _light() -> dict[str, Any]:
    """Those of the options that this version of XLA knows."""
    known = {}
    for name, value in LIGHT:
        try:
            jax.jit(lambda x: x, compiler_options={name: value}).lower(0.0).compile()
        except Exception:  # XLA's own error types differ by version
            continue
        known[name] = value
    return known


@contextlib.contextmanager
def collector_paused() -> Iterator[None]:
    """No garbage collection inside.

    Warp registers JAX's stream for each graph that it captures. A collection in the midst of that may
    delete an earlier registration of the same stream, and the run ends with "unknown stream".
    """
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()
