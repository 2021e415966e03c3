"""PPO in pure JAX: train an environment, save a policy, run it anywhere."""

from dexsim_ppo.learner.config import PPOConfig
from dexsim_ppo.learner.ppo import TrainState, make_train
from dexsim_ppo.policy import Policy, act, load_policy

__all__ = ["PPOConfig", "Policy", "TrainState", "act", "load_policy", "make_train"]
