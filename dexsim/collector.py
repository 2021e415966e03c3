"""Python's garbage collector and Warp, which do not go together."""

import contextlib
import gc
from collections.abc import Iterator


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
