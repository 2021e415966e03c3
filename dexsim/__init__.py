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
    from dexsim.core.cli import enable_caches as enable_caches
    from dexsim.env.config import EnvConfig as EnvConfig
    from dexsim.env.env import Env as Env
    from dexsim.env.evaluation import Evaluation as Evaluation, take_snapshot as take_snapshot
    from dexsim.env.state import Start as Start, State as State
    from dexsim.env.task import GroundTruth as GroundTruth, Task as Task
    from dexsim.hand.description import Hand as Hand
    from dexsim.hand.load import load_hand as load_hand
    from dexsim.objects.config import ObjectConfig as ObjectConfig
    from dexsim.observation import Readings as Readings, observe as observe
    from dexsim.registry import make as make, register as register
    from dexsim.render.render import (
        draw_taxels as draw_taxels,
        render_episode as render_episode,
        render_frame as render_frame,
    )
    from dexsim.task_spec import TaskSpec as TaskSpec
    from dexsim.tasks.grasp.config import GraspConfig as GraspConfig, GraspReward as GraspReward
    from dexsim.tasks.rotate.config import RotateConfig as RotateConfig, RotateReward as RotateReward

__version__ = "0.1.0"
__all__, __getattr__, __dir__ = lazy_exports(__name__)
