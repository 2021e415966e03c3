"""Compilation options for large programs, and the cores that they may use."""

import functools
import os
from collections.abc import Callable
from typing import Any

import jax

from dexsim.errors import ConfigError

# LLVM optimises less, and XLA's older emitters produce less code per fusion: faster to compile. Physics run as fast,
# networks take nearly twice as long with the older emitters.
EMITTERS = "xla_cpu_use_fusion_emitters"
LIGHT = (("xla_backend_optimization_level", 1), (EMITTERS, False))

_on_gpu: dict[str, Any] = {}  # compiler options, set by `make_deterministic`


def available_cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def jit(function: Callable, *, backend: str = "mjx", once: bool = False, **options: Any) -> Any:
    """`jax.jit` with less optimisation on a CPU, where that pays off.

    A physics step in JAX is one very large program: on two cores this halves its compilation time for a few per cent
    of speed. Programs that leave the physics to the host run a quarter faster when fully optimised. With an environment
    from elsewhere the learner may be most of the program, so only LLVM optimises less there.

    Args:
      backend: of the physics in it; "own" for an environment from elsewhere.
      once: the program runs only once, so that optimising it does not pay off.
    """
    if jax.default_backend() == "cpu" and (once or backend != "c"):
        light = _light() | ({"xla_backend_optimization_level": 0} if once else {})
        if backend == "own":
            light.pop(EMITTERS, None)
        options["compiler_options"] = light
    elif _on_gpu:
        options["compiler_options"] = dict(_on_gpu)
    return jax.jit(function, **options)


def check_float32() -> None:
    """Raises ConfigError: JAX computes in float64, but the states that compiled loops carry are float32."""
    if jax.config.read("jax_enable_x64"):
        raise ConfigError("jax_enable_x64 is on: training and evaluation are in float32; unset JAX_ENABLE_X64")


def make_deterministic() -> bool:
    """Have all GPU programs that this process makes from here on repeat to the last bit.

    XLA then neither times rival kernels to choose one nor adds in whatever order threads come. The `cuda` backend
    repeats anyway. Returns whether there is a GPU: programs on a CPU repeat anyway.
    """
    if jax.default_backend() not in ("gpu", "cuda"):
        return False
    _on_gpu["xla_gpu_deterministic_ops"] = True
    return True


@functools.cache
def _light() -> dict[str, Any]:
    """The options that this version of XLA knows."""
    accepted = {}
    for name, value in LIGHT:
        try:
            jax.jit(lambda x: x, compiler_options={name: value}).lower(0.0).compile()
        except Exception:  # XLA's own error types differ by version
            continue
        accepted[name] = value
    return accepted
