"""dexsim: force-aware, tactile dexterous hands in JAX, from simulation to the hand.

import dexsim
env = dexsim.make("grasp")
state = env.reset(jax.random.key(0))
state = env.step(state, action)
"""

from typing import Any

from dexsim.core.errors import AssetError, CheckpointError, ConfigError, DexsimError

__version__ = "0.1.0"
__all__ = ["AssetError", "CheckpointError", "ConfigError", "DexsimError", "load_hand", "make"]


def make(task: str, config: Any = None, **options: Any) -> Any:
    """An environment by name; see `dexsim.tasks.make`. MJX is imported only here."""
    from dexsim.tasks import make as make_task

    return make_task(task, config, **options)


def load_hand(path: Any = None) -> Any:
    """A hand from its TOML; see `dexsim.hand.load.load_hand`."""
    from dexsim.hand.load import load_hand as load

    return load(path)
