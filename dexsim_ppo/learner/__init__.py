"""PPO in pure JAX, for any environment with `reset`, `step`, `restart` and `stagger`."""

from dexsim_ppo.learner.config import PPOConfig
from dexsim_ppo.learner.curriculum import Curriculum
from dexsim_ppo.learner.ppo import Training, TrainState, make_train
from dexsim_ppo.learner.types import Environment

__all__ = ["Curriculum", "Environment", "PPOConfig", "TrainState", "Training", "make_train"]
