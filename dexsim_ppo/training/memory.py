"""How much memory a training needs, known from its compiled program before the first step allocates it."""

import math
import os
from collections.abc import Callable
from typing import Any

import jax

from dexsim.core.errors import ConfigError


def needed(program: Any) -> int | None:
    """Bytes on a device of a compiled training step: its arguments, results and intermediate arrays; None where the
    runtime does not say. Of a step of several programs that of the largest. What Warp allocates for itself is not part
    of it."""
    if hasattr(program, "parts"):
        return max((size for part in program.parts if (size := needed(part)) is not None), default=None)
    analysis = getattr(program, "memory_analysis", lambda: None)()
    if analysis is None:
        return None
    # Results that take the place of arguments (`alias`) are counted with these.
    results = analysis.output_size_in_bytes - analysis.alias_size_in_bytes
    return int(analysis.argument_size_in_bytes + results + analysis.temp_size_in_bytes)


def available(device: jax.Device | None = None) -> int | None:
    """Bytes that programs may have on a device: on a GPU JAX's share of its memory, on a CPU the machine's; None where
    nothing tells."""
    device = device or jax.local_devices()[0]
    if device.platform == "cpu":
        try:
            return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
        except (AttributeError, ValueError, OSError):
            return None
    limit = (device.memory_stats() or {}).get("bytes_limit")
    return int(limit) if limit else None


def check(program: Any, num_envs: int, note: Callable[[str], None]) -> None:
    """Say what a training step needs, and refuse one that cannot fit.

    Args:
      program: the compiled step.
      num_envs: environments on one device.
      note: takes the line that says it.

    Raises:
      ConfigError: it needs more than the device has; names a number of environments that should fit.
    """
    need, limit = needed(program), available()
    if need is None:
        return
    kind = jax.local_devices()[0].device_kind
    if limit is None:
        return note(f"{num_envs} environments need {_text(need)}")
    if need > limit:
        fit = 2 ** int(math.log2(max(num_envs * limit / need, 1.0)))
        raise ConfigError(
            f"{num_envs} environments need {_text(need)}, and {kind} has {_text(limit)} for JAX: about "
            f"{fit} should fit (--ppo.num-envs {fit})"
        )
    note(f"{num_envs} environments need {_text(need)}, {kind} has {_text(limit)}")


def _text(size: int) -> str:
    return f"{size / 2**30:.3g} GiB" if size >= 2**28 else f"{size / 2**20:.3g} MiB"
