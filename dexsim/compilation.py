"""How this library compiles its large programs."""

from collections.abc import Callable
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
