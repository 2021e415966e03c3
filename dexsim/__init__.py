"""dexsim: force-aware, tactile dexterous hands in JAX, from simulation to the hand.

    import dexsim
    env = dexsim.make("grasp")
    state = env.reset(jax.random.key(0))
    state = env.step(state, action)

Names are imported at first use, so that a program that only runs a policy loads no physics.
"""

from typing import TYPE_CHECKING

from dexsim.core.door import open_door
from dexsim.core.errors import (
    AssetError,
    CalibrationError,
    CheckpointError,
    ConfigError,
    DexsimError,
    DexsimWarning,
    OldFileWarning,
    OtherEnvWarning,
)

if TYPE_CHECKING:
    from dexsim.env.config import EnvConfig
    from dexsim.env.env import Env
    from dexsim.env.state import State
    from dexsim.env.task import Task
    from dexsim.hand.kinematics import Hand
    from dexsim.hand.load import load_hand
    from dexsim.observation import Readings, observe
    from dexsim.registry import make, register
    from dexsim.task_spec import TaskSpec

__version__ = "0.1.0"
__all__ = [
    "AssetError",
    "CalibrationError",
    "CheckpointError",
    "ConfigError",
    "DexsimError",
    "DexsimWarning",
    "Env",
    "EnvConfig",
    "Hand",
    "OldFileWarning",
    "OtherEnvWarning",
    "Readings",
    "State",
    "Task",
    "TaskSpec",
    "load_hand",
    "make",
    "observe",
    "register",
]

__getattr__, __dir__ = open_door(
    __name__,
    __all__,
    {
        "Env": "dexsim.env.env",
        "EnvConfig": "dexsim.env.config",
        "Hand": "dexsim.hand.kinematics",
        "Readings": "dexsim.observation",
        "State": "dexsim.env.state",
        "Task": "dexsim.env.task",
        "TaskSpec": "dexsim.task_spec",
        "load_hand": "dexsim.hand.load",
        "make": "dexsim.registry",
        "observe": "dexsim.observation",
        "register": "dexsim.registry",
    },
)
