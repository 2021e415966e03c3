"""How this library compiles and runs its large programs."""

from dexsim.collector import collector_paused
from dexsim.compilation import jit

__all__ = ["collector_paused", "jit"]
