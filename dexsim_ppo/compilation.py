"""How this library compiles and runs its large programs."""

import contextlib
import gc
from collections.abc import Callable, Iterator
from typing import Any

import jax


def jit(function: Callable, **options: Any) -> Any:
    """`jax.jit`, but on a CPU LLVM optimises less.

    A physics step is one very large program. On two cores its compilation takes half as long this
    way, for a few per cent of speed; a short training run is mostly compilation otherwise.
    """
    if jax.default_backend() == "cpu":
        options["compiler_options"] = {"xla_backend_optimization_level": 1}
    return jax.jit(function, **options)


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
