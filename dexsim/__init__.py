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
    OtherEnvWarning,
)

if TYPE_CHECKING:
    from dexsim.core.cli import enable_caches
    from dexsim.env.config import EnvConfig
    from dexsim.env.env import Env
    from dexsim.env.state import State
    from dexsim.env.task import Task
    from dexsim.hand.kinematics import Hand
    from dexsim.hand.load import load_hand
    from dexsim.observation import Readings, observe
    from dexsim.registry import make, register
    from dexsim.render.render import draw_taxels, render_episode, render_frame
    from dexsim.task_spec import TaskSpec
    from dexsim.tasks.grasp.config import GraspConfig
    from dexsim.tasks.rotate.config import RotateConfig

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
    "GraspConfig",
    "Hand",
    "OtherEnvWarning",
    "Readings",
    "RotateConfig",
    "State",
    "Task",
    "TaskSpec",
    "draw_taxels",
    "enable_caches",
    "load_hand",
    "make",
    "observe",
    "register",
    "render_episode",
    "render_frame",
]

__getattr__, __dir__ = open_door(
    __name__,
    __all__,
    {
        "Env": "dexsim.env.env",
        "EnvConfig": "dexsim.env.config",
        "GraspConfig": "dexsim.tasks.grasp.config",
        "Hand": "dexsim.hand.kinematics",
        "Readings": "dexsim.observation",
        "RotateConfig": "dexsim.tasks.rotate.config",
        "State": "dexsim.env.state",
        "Task": "dexsim.env.task",
        "TaskSpec": "dexsim.task_spec",
        "draw_taxels": "dexsim.render.render",
        "enable_caches": "dexsim.core.cli",
        "load_hand": "dexsim.hand.load",
        "make": "dexsim.registry",
        "observe": "dexsim.observation",
        "register": "dexsim.registry",
        "render_episode": "dexsim.render.render",
        "render_frame": "dexsim.render.render",
    },
)
