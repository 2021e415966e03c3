"""dexsim: force-aware, tactile dexterous hands in JAX, from simulation to the hand.

    import dexsim
    env = dexsim.make("grasp")
    state = env.reset(jax.random.key(0))
    state = env.step(state, action)

Names are imported at first use, so that a program that only runs a policy loads no physics.
"""

from typing import TYPE_CHECKING

from dexsim.core.lazy_loading import lazy_exports

if TYPE_CHECKING:
    from dexsim.core.cli import enable_caches
    from dexsim.env.config import EnvConfig
    from dexsim.env.env import Env
    from dexsim.env.evaluation import Evaluation, take_snapshot
    from dexsim.env.state import Start, State
    from dexsim.env.task import GroundTruth, Task
    from dexsim.hand.description import Hand
    from dexsim.hand.load import load_hand
    from dexsim.objects.config import ObjectConfig
    from dexsim.observation import Readings, observe
    from dexsim.registry import make, register
    from dexsim.render.render import draw_taxels, render_episode, render_frame
    from dexsim.task_spec import TaskSpec
    from dexsim.tasks.grasp.config import GraspConfig, GraspReward
    from dexsim.tasks.rotate.config import RotateConfig, RotateReward

__version__ = "0.1.0"
__all__ = [
    "Env",
    "EnvConfig",
    "Evaluation",
    "GraspConfig",
    "GraspReward",
    "GroundTruth",
    "Hand",
    "ObjectConfig",
    "Readings",
    "RotateConfig",
    "RotateReward",
    "Start",
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
    "take_snapshot",
]

__getattr__, __dir__ = lazy_exports(__name__, __all__)
